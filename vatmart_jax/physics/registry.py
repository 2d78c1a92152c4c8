"""The physics implementations by name."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec

import jax

from vatmart_jax.data.banks import SceneBank
from vatmart_jax.errors import UserError
from vatmart_jax.host_threads import allow_callbacks
from vatmart_jax.physics.config import PhysicsConfig
from vatmart_jax.physics.types import Physics
from vatmart_jax.registry import Registry

BACKENDS: Registry[Callable[[SceneBank, PhysicsConfig], Physics]] = Registry("impl")
BACKENDS.register("c", "vatmart_jax.physics.backend_c:CPhysics")
BACKENDS.register("warp", "vatmart_jax.physics.backend_warp:WarpPhysics")
BACKENDS.register("jax", "vatmart_jax.physics.backend_mjx:MjxPhysics")


def default_impl() -> str:
    """`warp` where JAX runs on an NVIDIA GPU and MuJoCo Warp is installed, else `c`."""
    allow_callbacks()  # the next line starts JAX
    return "warp" if jax.default_backend() == "gpu" and find_spec("mujoco_warp") else "c"


def make_physics(bank: SceneBank, impl: str = "c", config: PhysicsConfig | None = None) -> Physics:
    """The implementation named `impl` for a bank whose Scenes all have one joint type.

    Raises UserError for an unknown name, and where the implementation's packages are not installed.
    """
    try:
        backend = BACKENDS.get(impl)
    except ImportError as e:
        if impl != "warp":
            raise
        raise UserError(f"impl warp needs MuJoCo Warp ({e}); install it: pip install 'vatmart-jax[warp]'") from e
    return backend(bank, config or PhysicsConfig())
