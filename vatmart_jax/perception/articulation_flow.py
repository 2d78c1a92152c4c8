"""Articulation flow: what becomes of a contact point while its part is moved by the goal.

15 numbers: the point's displacement after each quarter of the motion, and the part's rotation vector at the end, each
scaled to the order of 1. FlowBot3D (Eisner et al. 2022) predicts the first of them for every point of a part.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from vatmart_jax.perception.layers import flatten_last_two
from vatmart_jax.rotations import apply_joint_motion
from vatmart_jax.trajectory import WAYPOINTS

POSITION_SCALE = 5.0  # residual moves are 0.05 to 0.3 unit lengths
EULER_SCALE = 2.0  # Euler residuals are 0.1 to 0.5 rad
FLOW = 3 * WAYPOINTS + 3
AXIS_AND_ARM = 6


def unpack_flow(flow: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Displacements [..., 4, 3] (unit lengths) and rotation vector [..., 3] (rad) of a flow [..., 15]."""
    displacements = flow[..., : 3 * WAYPOINTS] / POSITION_SCALE
    return displacements.reshape(*displacements.shape[:-1], WAYPOINTS, 3), flow[..., 3 * WAYPOINTS :] / EULER_SCALE


def pack_flow(displacements: jax.Array, rotation: jax.Array) -> jax.Array:
    """The inverse of `unpack_flow`."""
    return jnp.concatenate([POSITION_SCALE * flatten_last_two(displacements), EULER_SCALE * rotation], -1)


def articulation_flow(axis: jax.Array, arm: jax.Array, goal: jax.Array, hinge: bool) -> jax.Array:
    """The flow [..., 15] of points whose part turns about an axis (`hinge`) or slides along it by goal [...].

    axis: [..., 3] unit; arm: [..., 3] from the point to any point on a hinge's axis.
    """
    amount = goal[..., None] * jnp.arange(1, WAYPOINTS + 1) / WAYPOINTS
    arm = arm[..., None, :]
    displacements = apply_joint_motion(jnp.zeros_like(arm), axis[..., None, :], arm, amount, hinge)
    rotation = axis * goal[..., None]
    return pack_flow(displacements, rotation if hinge else jnp.zeros_like(rotation))


def flow_target(contact: jax.Array, axis: jax.Array, anchor: jax.Array, goal: jax.Array, *, hinge: bool) -> jax.Array:
    """[V, Q, 15] the true flow of contacts [V, Q, 3] under goals [V, Q] where the joints are axis and anchor [V, 3]."""
    return articulation_flow(axis[:, None], anchor[:, None] - contact, goal, hinge)


def axis_target(contact: jax.Array, axis: jax.Array, anchor: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The truth for `Networks.joint_axis` at contacts [V, Q, 3] where the hinges are axis and anchor [V, 3]: the axis
    [V, 1, 3], and the vector [V, Q, 3] from the contact to the nearest point on it."""
    axis, arm = axis[:, None], anchor[:, None] - contact
    return axis, arm - axis * jnp.sum(axis * arm, -1, keepdims=True)


def perturb_flow(key: jax.Array, flow: jax.Array, noise: float) -> jax.Array:
    """Flows [V, Q, 15] with length, lateral direction and rotation off by about the fraction `noise`. Consumes the
    key."""
    k_length, k_side, k_rotation = jax.random.split(key, 3)
    displacements, rotation = unpack_flow(flow)
    length = jnp.linalg.norm(displacements[..., -1:, :], axis=-1, keepdims=True)
    lateral = jnp.arange(1, WAYPOINTS + 1)[:, None] / WAYPOINTS * length
    normal = lambda key, of: jax.random.normal(key, of.shape)
    stretched = displacements * jnp.exp(noise * normal(k_length, length))
    displacements = stretched + noise * lateral * normal(k_side, displacements[..., :1, :])
    angle = jnp.linalg.norm(rotation, axis=-1, keepdims=True)
    return pack_flow(displacements, rotation + noise * angle * normal(k_rotation, rotation))
