"""Hands that push the fronts of parts, by any implementation of the physics."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from boxes import as_boxes

from vatmart_jax import rotations as rot
from vatmart_jax.data.banks import SceneBank, ViewBank
from vatmart_jax.physics import GRIPPERS, Physics, PhysicsState, make_physics
from vatmart_jax.physics.gripper import PART

BATCH, STEPS = 8, 60
EVERYONE = np.ones(BATCH, bool)
GRIPPER = GRIPPERS.get("panda")
APPROACH = 2  # the hand's z in ctrl


class Pushes:
    """Jitted physics of a bank's Scenes of one joint type, and hands that push their fronts."""

    def __init__(self, cabinets: tuple[SceneBank, ViewBank], kind: int, collision: str = "hull", impl: str = "c"):
        bank, views = cabinets
        scenes = np.flatnonzero(bank.joint_type == kind)
        self.bank, self.views = bank.select(scenes), views.of_scenes(scenes)
        if collision == "box":
            self.bank = as_boxes(self.bank)
        self.use(make_physics(self.bank, impl))

    def use(self, physics: Physics) -> None:
        self.physics = physics
        self.reset, self.rollout = jax.jit(physics.reset), jax.jit(physics.rollout)

    def starts(self, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Scenes, hand poses and qpos of BATCH simulations, the fingertips 0.03 before contacts of random views."""
        rng = np.random.default_rng(seed)
        scene = rng.permuted(np.resize(np.arange(len(self.bank)), BATCH))
        view = np.array([rng.choice(np.flatnonzero(self.views.scene == s)) for s in scene])
        contact = rng.integers(0, 8, BATCH)
        up = -self.views.contact_normals[view, contact]
        frame = rot.gripper_frame(jnp.asarray(up), jnp.asarray(rng.normal(size=(BATCH, 3)), jnp.float32))
        position = self.views.contacts[view, contact] - (GRIPPER.tip_offset + 0.03) * up
        qpos = np.zeros((BATCH, GRIPPER.num_qpos), np.float32)
        qpos[:, PART] = self.views.joint_pos[view]
        return scene.astype(np.int32), np.concatenate([position, rot.quat_from_matrix(frame)], -1), qpos

    def controls(self, seed: int = 0) -> np.ndarray:
        """[BATCH, STEPS, 8]: forwards by 0.03 to 0.2, with noise on everything."""
        rng = np.random.default_rng(100 + seed)
        ctrl = 0.02 * np.cumsum(rng.normal(size=(BATCH, STEPS, GRIPPER.num_ctrl)), 1) / np.sqrt(STEPS)
        ctrl[..., 6:] = 0
        ctrl[..., APPROACH] += rng.uniform(0.03, 0.2, (BATCH, 1)) * np.linspace(0, 1, STEPS)
        return ctrl.astype(np.float32)

    def pushed(self, seed: int = 0, rollouts: int = 1) -> PhysicsState:
        state = self.reset(*self.starts(seed))
        for k in range(rollouts):
            state = self.rollout(state, self.controls(seed + k), EVERYONE)
        return state


def rows(state: PhysicsState, chosen) -> list[np.ndarray]:
    return [np.asarray(leaf)[chosen] for leaf in jax.tree.leaves(state)]


def assert_bitwise(a: PhysicsState, b: PhysicsState, chosen=slice(None)):
    for x, y in zip(rows(a, chosen), rows(b, chosen), strict=True):
        np.testing.assert_array_equal(x.view(np.uint8), y.view(np.uint8))
