"""Batched physics of different Scenes: one interface, several implementations.

`make_physics(bank, impl)` returns an object whose `reset` and `rollout` are pure functions of device arrays, usable
inside `jit` and `scan`, and which never recompile when scenes, poses or controls change.
"""

from vatmart_jax.physics.scene_model import PhysicsConfig
from vatmart_jax.physics.types import Physics, PhysicsState, make_physics

__all__ = ["Physics", "PhysicsConfig", "PhysicsState", "make_physics"]
