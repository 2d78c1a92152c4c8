"""Batched physics of different Scenes: one interface, several implementations.

`make_physics(bank, impl)` returns an object whose `reset` and `rollout` are pure functions of device arrays, usable
inside `jit` and `scan`, and which never recompile when scenes, poses or controls change.
"""

from vatmart_jax.physics.config import PhysicsConfig
from vatmart_jax.physics.gripper import GRIPPERS, Gripper
from vatmart_jax.physics.registry import BACKENDS, default_impl, make_physics
from vatmart_jax.physics.types import Physics, PhysicsState

__all__ = [
    "BACKENDS",
    "GRIPPERS",
    "Gripper",
    "Physics",
    "PhysicsConfig",
    "PhysicsState",
    "default_impl",
    "make_physics",
]
