"""The privileged observation: the paper's state (section 4.1), in the joint-local frame."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from vatmart_jax.physics.gripper import Gripper

DISPLACEMENT, GOAL, REMAINING = 0, 1, 2
_FINGER_SCALE = 10.0  # brings openings of a few hundredths to the size of the other entries


def observation_entries(gripper: Gripper) -> dict[str, slice]:
    """Where each named entry is. Lengths in units, angles in rad, positions relative to the contact at the start."""
    sizes = {
        "displacement": 1,  # of the part since the start, in the task's direction
        "goal": 1,
        "remaining": 1,  # goal - displacement
        "start_position": 3,  # hand's origin at the start pose
        "start_rotation": 6,  # hand's 6D rotation at the start pose
        "tip": 3,  # point between the fingertips
        "rotation": 3,  # hand's rotation vector since the start pose
        "fingers": gripper.num_fingers,  # openings, times 10
        "contact": 3,  # the contact point, moved with the part
        "axis": 3,  # of the joint, positive motion is the task's
        "axis_point": 3,  # the point of the axis nearest to the contact
        "lever": 1,  # distance from there to the contact
        "lever_direction": 3,  # unit, from the axis to the contact
    }
    ends, entries = 0, {}
    for name, size in sizes.items():
        entries[name] = slice(ends, ends + size)
        ends += size
    return entries


def observation_size(gripper: Gripper) -> int:
    """33 for two fingers."""
    return observation_entries(gripper)["lever_direction"].stop


def build_observation(gripper: Gripper, values: dict[str, jax.Array]) -> jax.Array:
    """[B, 33] from the entries [B, size] by name; `fingers` in unit lengths, `remaining` is filled in."""
    values = {
        **values,
        "remaining": values["goal"] - values["displacement"],
        "fingers": _FINGER_SCALE * values["fingers"],
    }
    return jnp.concatenate([values[name] for name in observation_entries(gripper)], -1)


def relabel(obs: jax.Array, goal: jax.Array, displacement: jax.Array) -> jax.Array:
    """Observations [..., 33] of the same states under other goals [...]; displacement: [...] of the part in them."""
    return obs.at[..., GOAL].set(goal).at[..., REMAINING].set(goal - displacement)
