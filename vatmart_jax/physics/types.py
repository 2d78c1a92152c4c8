"""What every physics implementation offers."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Protocol

import jax
import jax.numpy as jnp
from flax import struct

from vatmart_jax.data.banks import SceneBank
from vatmart_jax.errors import UserError
from vatmart_jax.physics.scene_model import PhysicsConfig

IMPLS = ("c", "warp", "jax")


@struct.dataclass
class PhysicsState:
    """B simulations, each of its own Scene. qpos: part opening, hand x y z (start frame) rx ry rz, two fingers."""

    scene: jax.Array  # [B] int32, index into the SceneBank
    gripper_pose: jax.Array  # [B, 7] start pose of the hand: position, quaternion wxyz; object frame
    qpos: jax.Array  # [B, 9]
    qvel: jax.Array  # [B, 9]
    in_contact: jax.Array  # [B] bool, the gripper touches the object
    diverged: jax.Array  # [B] bool, MuJoCo warned or a number was not finite; the state stays the last good one
    exact: jax.Array  # [B, n] uint32, what the implementation keeps beyond float32 (bits of float64), n may be 0


def bits_of(x: jax.Array) -> jax.Array:
    """float32 as `PhysicsState.exact` keeps it."""
    return jax.lax.bitcast_convert_type(x, jnp.uint32)


class Physics(Protocol):
    """T physics steps of B simulations in one call."""

    config: PhysicsConfig

    def reset(self, scene: jax.Array, gripper_pose: jax.Array, qpos: jax.Array) -> PhysicsState:
        """Simulations at rest at qpos [B, 9], with contacts computed. scene: [B] int32, gripper_pose: [B, 7]."""
        ...

    def rollout(self, state: PhysicsState, ctrl: jax.Array, active: jax.Array) -> PhysicsState:
        """Apply ctrl [B, T, 8] (hand x y z rx ry rz, fingers), one row per step, where active [B]; others stay."""
        ...


def default_impl() -> str:
    """`warp` where JAX runs on an NVIDIA GPU and MuJoCo Warp is installed, else `c`."""
    return "warp" if jax.default_backend() == "gpu" and find_spec("mujoco_warp") else "c"


def make_physics(bank: SceneBank, impl: str = "c", config: PhysicsConfig | None = None) -> Physics:
    """The implementation named `impl` for a bank whose Scenes all have one joint type.

    Raises ValueError for an unknown name.
    """
    if impl == "c":
        from vatmart_jax.physics.backend_c import CPhysics

        return CPhysics(bank, config or PhysicsConfig())
    if impl == "jax":
        from vatmart_jax.physics.backend_mjx import MjxPhysics

        return MjxPhysics(bank, config or PhysicsConfig())
    if impl == "warp":
        try:
            from vatmart_jax.physics.backend_warp import WarpPhysics
        except ImportError as e:
            raise UserError(f"impl warp needs MuJoCo Warp ({e}); install it: pip install 'vatmart-jax[warp]'") from e

        return WarpPhysics(bank, config or PhysicsConfig())
    raise ValueError(f"impl {impl!r} is not one of {', '.join(IMPLS)}")
