"""VAT-Mart in MuJoCo/MJX, JAX and Flax: actionable visual priors for 3D articulated objects."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vatmart_jax.data.banks import SceneBank, ViewBank
    from vatmart_jax.envs import TASKS, Env, EnvConfig, get_task, make_env, register_task
    from vatmart_jax.priors import Priors, load_priors

__version__ = "0.1.0"

__all__ = [
    "TASKS", "Env", "EnvConfig", "Priors", "SceneBank", "ViewBank", "__version__", "get_task", "load_priors",
    "make_env", "register_task",
]  # fmt: skip

_HOMES = {
    **dict.fromkeys(("SceneBank", "ViewBank"), "vatmart_jax.data.banks"),
    **dict.fromkeys(("TASKS", "Env", "EnvConfig", "get_task", "make_env", "register_task"), "vatmart_jax.envs"),
    **dict.fromkeys(("Priors", "load_priors"), "vatmart_jax.priors"),
}


def __getattr__(name: str) -> Any:
    """What users call, imported when it is first used: the command line answers `--help` without JAX."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
