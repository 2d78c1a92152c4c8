"""What the environment is configured with, and the states of its trials."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import numpy as np
from flax import struct

from vatmart_jax.envs.rewards import RewardConfig
from vatmart_jax.physics import PhysicsState
from vatmart_jax.trajectory import pack_trajectory


@dataclass(frozen=True)
class EnvConfig:
    """Sizes and limits of a trial. Lengths in units, angles in rad."""

    num_envs: int = 256
    """trials that run at once"""
    max_translation: float = 0.35
    """largest move of the fingertips per waypoint and axis"""
    max_rotation: float = float(np.radians(45))
    """largest turn of the hand per waypoint, about each axis"""
    max_total_rotation: float = float(np.radians(80))
    """largest turn from the start pose: Euler angles stay regular"""
    standoff: float = 0.02
    """fingertips start this far from the contact point"""
    approach_cone: float = float(np.radians(30))
    """the hand approaches within this angle of the inward normal"""
    grasp_depth: float = 0.04
    """grasps: the open fingers advance this far past the contact point before they close"""
    grasp_min: float = 0.01
    """opening between closed fingers from which on something is held, as in the released code; at less, four in five
    pulls slip"""
    guided_fraction: float = 0.9
    """share of starts at candidate contacts. Push: the contact's face points against the motion. Grasp: a handle from
    the front across its thin side, or an edge of the part straddled along the motion"""
    grasp_approach_cone: float = float(np.radians(20))
    """a guided grasp approaches within this angle of the canonical one, and its roll is off by about half of it"""
    tolerance: float = 0.15
    """success: the part moved by the goal within this share of it"""
    reward: RewardConfig = field(default_factory=RewardConfig)


class ViewTable(struct.PyTreeNode, kw_only=True):
    """What trials need of V views with C contacts each, on device; object frame."""

    scene: jax.Array  # [V] int32, index into the SceneBank
    joint_pos: jax.Array  # [V] of the part, rad or unit lengths away from closed
    contacts: jax.Array  # [V, C, 3]
    normals: jax.Array  # [V, C, 3] unit, outward


class TrialStart(struct.PyTreeNode, kw_only=True):
    """Where B trials begin."""

    view: jax.Array  # [B] int32, index into the environment's views
    contact: jax.Array  # [B] int32, index into that view's contacts
    goal: jax.Array  # [B] positive displacement of the part, rad or unit lengths
    rotation: jax.Array  # [B, 3, 3] hand frame, object frame


class EnvState(struct.PyTreeNode, kw_only=True):
    """B trials, K = 4 waypoints."""

    start: TrialStart
    point: jax.Array  # [B, 3] contact point at the start, object frame
    frame: jax.Array  # [B, 3, 3] joint-local frame, object frame
    q0: jax.Array  # [B] joint position at the start
    physics: PhysicsState
    ctrl: jax.Array  # [B, nu] actuator targets in force
    tip: jax.Array  # [B, 3] commanded move of the fingertips since the start pose, object frame
    euler: jax.Array  # [B, 3] commanded hand angles, start frame
    waypoint: jax.Array  # [] int32, waypoints done
    residuals: jax.Array  # [B, K, 6] commanded residuals so far, zeros after the end
    progress: jax.Array  # [B, K] displacement of the part after each waypoint
    in_collision: jax.Array  # [B] bool, the start pose touches the object
    grasp_held: jax.Array  # [B] bool, the part is held (of a push: the start is free)
    valid: jax.Array  # [B] bool, free start, grasp made if one is needed, physics sound
    obs: jax.Array  # [B, 33]
    reward: jax.Array  # [B]
    done: jax.Array  # [B] bool
    success: jax.Array  # [B] bool, now within tolerance (and still held)
    metrics: dict[str, jax.Array]  # reward terms, raw, [B] each
    info: dict[str, jax.Array]  # displacement and tip_distance, [B] each

    @property
    def displacement(self) -> jax.Array:
        """[B] how far the part has moved in the task's direction, rad or unit lengths."""
        return self.info["displacement"]

    @property
    def trajectory(self) -> jax.Array:
        """[B, 30] the commanded trajectory, zero padded."""
        return pack_trajectory(self.start.rotation, self.residuals)
