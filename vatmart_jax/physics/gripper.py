"""Two-finger grippers: their MJCF, dimensions and actuators, and the registry of those that PhysicsConfig may name.

Every gripper is a free-flying hand: six joints carry its body, one slide per finger opens it. qpos is the part's joint,
the hand's x y z rx ry rz in its start frame, then the fingers; actuators drive all but the part, in the same order.
A gripper frame's columns are (forward, left, up): fingers open along left, the gripper approaches along up.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from mjcf_assets import gripper_mjcf
from vatmart_jax import rotations as rot
from vatmart_jax.registry import Registry

PART = 0  # qpos index of the part's joint
HAND_JOINTS = ("hand_x", "hand_y", "hand_z", "hand_rx", "hand_ry", "hand_rz")


@dataclass(frozen=True)
class Gains:
    """A force-limited position actuator with damping."""

    kp: float  # N/m, or Nm/rad
    kv: float  # Ns/m, or Nms/rad
    limit: float  # N, or Nm


@dataclass(frozen=True, kw_only=True)
class Gripper:
    """One gripper. SI units; one unit length is one metre. Defaults are chosen by experiment (docs/physics.md)."""

    name: str
    mjcf: str  # a file of mjcf_assets/grippers/, or MJCF text: one body whose geoms are boxes
    tip_offset: float  # from the hand's origin to the point between the fingertips, along the approach axis
    max_opening: float  # of each finger
    finger_joints: tuple[str, ...] = ("left_finger", "right_finger")
    geoms: tuple[str, ...] = ("hand", "left_finger", "right_finger")
    slide_gains: Gains = Gains(5000.0, 160.0, 60.0)  # hand: under 0.5 mm tracking error in free motion
    hinge_gains: Gains = Gains(500.0, 8.0, 30.0)  # hand
    finger_gains: Gains = Gains(600.0, 30.0, 30.0)
    hand_mass: float = 1.0
    hand_inertia: float = 0.01
    hand_armature: float = 0.02  # of the hinges
    finger_mass: float = 0.05
    finger_inertia: float = 2e-5
    finger_armature: float = 0.1

    @property
    def hand_joints(self) -> tuple[str, ...]:
        return HAND_JOINTS

    @property
    def actuators(self) -> tuple[tuple[str, Gains], ...]:
        """Joint and gains of every actuator, in the order of ctrl."""
        hand = zip(self.hand_joints, 3 * (self.slide_gains,) + 3 * (self.hinge_gains,), strict=True)
        return (*hand, *((joint, self.finger_gains) for joint in self.finger_joints))

    @property
    def num_fingers(self) -> int:
        return len(self.finger_joints)

    @property
    def num_qpos(self) -> int:
        return 1 + self.num_ctrl

    @property
    def num_ctrl(self) -> int:
        return len(self.hand_joints) + self.num_fingers

    @property
    def hand_qpos(self) -> slice:
        return slice(1, 1 + len(self.hand_joints))

    @property
    def finger_qpos(self) -> slice:
        return slice(1 + len(self.hand_joints), self.num_qpos)

    def mjcf_text(self) -> str:
        return self.mjcf if self.mjcf.lstrip().startswith("<") else gripper_mjcf(self.mjcf)

    def targets(self, tip: jax.Array, euler: jax.Array, start: jax.Array, opening: jax.Array) -> jax.Array:
        """[B, num_ctrl] actuator targets with the fingertip centre at `tip` from where it started, the hand rotated.

        tip: [B, 3] object frame; euler: [B, 3] the hand's intrinsic XYZ angles in its start frame; start: [B, 3, 3]
        that frame; opening: [B] of each finger.
        """
        # The slides carry the hand's origin, which is tip_offset behind the fingertips.
        approach = rot.matrix_from_euler(euler)[..., :, 2]
        slides = rot.unrotate(start, tip) - self.tip_offset * (approach - jnp.array([0.0, 0.0, 1.0]))
        return jnp.concatenate([slides, euler, *[opening[:, None]] * self.num_fingers], -1)

    def hand_position(self, contact: jax.Array, rotation: jax.Array, depth: float) -> jax.Array:
        """[B, 3] the hand's origin with the fingertips `depth` past contacts [B, 3]; rotation: [B, 3, 3]."""
        return contact + (depth - self.tip_offset) * rotation[:, :, 2]

    def rest_qpos(self, joint_pos: jax.Array, opening: jax.Array) -> jax.Array:
        """[B, num_qpos] the hand at its start pose, with the part at joint_pos [B] and each finger at opening [B]."""
        hand = jnp.zeros((len(joint_pos), len(self.hand_joints)))
        return jnp.concatenate([joint_pos[:, None], hand, *[opening[:, None]] * self.num_fingers], -1)


GRIPPERS: Registry[Gripper] = Registry("gripper")
GRIPPERS.register("panda", Gripper(name="panda", mjcf="panda_hand.xml", tip_offset=0.1122, max_opening=0.04))
GRIPPERS.register(
    "robotiq_2f85", Gripper(name="robotiq_2f85", mjcf="robotiq_2f85.xml", tip_offset=0.151, max_opening=0.0425)
)
