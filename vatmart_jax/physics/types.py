"""What every physics implementation offers."""

from __future__ import annotations

from typing import Protocol, overload

import jax
import jax.numpy as jnp
from flax import struct

from vatmart_jax.physics.config import PhysicsConfig
from vatmart_jax.physics.gripper import PART, Gripper


class PhysicsState(struct.PyTreeNode, kw_only=True):
    """B simulations, each of its own Scene. qpos: see `vatmart_jax.physics.gripper`."""

    scene: jax.Array  # [B] int32, index into the SceneBank
    gripper_pose: jax.Array  # [B, 7] start pose of the hand: position, quaternion wxyz; object frame
    qpos: jax.Array  # [B, nq]
    qvel: jax.Array  # [B, nq]
    in_contact: jax.Array  # [B] bool, the gripper touches the object
    diverged: jax.Array  # [B] bool, MuJoCo warned or a number was not finite; the state stays the last good one
    backend_state: jax.Array  # [B, n] uint32, what the implementation keeps beyond float32 (bits of float64); n >= 0

    @property
    def joint_pos(self) -> jax.Array:
        """[B] the part's joint, rad or unit lengths away from closed."""
        return self.qpos[..., PART]


class Physics(Protocol):
    """T physics steps of B simulations in one call. The functions are pure, and usable inside `jit`, `scan`, `vmap`."""

    config: PhysicsConfig
    gripper: Gripper

    def reset(self, scene: jax.Array, gripper_pose: jax.Array, qpos: jax.Array) -> PhysicsState:
        """Simulations at rest at qpos [B, nq], with contacts computed. scene: [B] int32, gripper_pose: [B, 7]."""
        ...

    @overload
    def rollout(
        self, state: PhysicsState, ctrl: jax.Array, active: jax.Array, *, record_every: None = None
    ) -> PhysicsState: ...
    @overload
    def rollout(
        self, state: PhysicsState, ctrl: jax.Array, active: jax.Array, *, record_every: int
    ) -> tuple[PhysicsState, jax.Array]: ...
    def rollout(
        self, state: PhysicsState, ctrl: jax.Array, active: jax.Array, *, record_every: int | None = None
    ) -> PhysicsState | tuple[PhysicsState, jax.Array]:
        """Apply ctrl [B, T, nu], one row per physics step, where active [B]; other simulations stay as they are.

        With `record_every`, a divisor of T, also qpos [T / record_every, B, nq] after each so many steps.
        """
        ...


def bits_of(x: jax.Array) -> jax.Array:
    """float32 as `PhysicsState.backend_state` keeps it."""
    return jax.lax.bitcast_convert_type(x, jnp.uint32)


def recorded_rollout(
    physics: Physics, state: PhysicsState, ctrl: jax.Array, active: jax.Array, record_every: int
) -> tuple[PhysicsState, jax.Array]:
    """`Physics.rollout` in pieces of `record_every` steps, with qpos after each. Raises ValueError for no divisor."""
    batch, steps, num_ctrl = ctrl.shape
    if record_every < 1 or steps % record_every:
        raise ValueError(f"record_every {record_every}: not a divisor of the {steps} steps")

    def piece(state: PhysicsState, ctrl: jax.Array) -> tuple[PhysicsState, jax.Array]:
        state = physics.rollout(state, ctrl, active)
        return state, state.qpos

    return jax.lax.scan(piece, state, jnp.asarray(ctrl).reshape(batch, -1, record_every, num_ctrl).swapaxes(0, 1))
