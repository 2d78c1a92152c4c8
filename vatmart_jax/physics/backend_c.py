# MuJoCo's compiled names are invisible to pyright.
# pyright: reportAttributeAccessIssue=false

"""Physics on CPU threads: `mujoco.batch.Batch` behind `jax.pure_callback`."""

from __future__ import annotations

import threading
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.batch import Batch

from vatmart_jax.data.banks import SceneBank
from vatmart_jax.host_threads import allow_callbacks
from vatmart_jax.physics.config import PhysicsConfig
from vatmart_jax.physics.gripper import GRIPPERS
from vatmart_jax.physics.scene_model import SCENE_FIELDS, template
from vatmart_jax.physics.types import PhysicsState, recorded_rollout

# float64 numbers a simulation carries between calls: position, velocity and the solver's warm start.
_EXACT = ("qpos", "qvel", "qacc_warmstart")


class CPhysics:
    """Bit-identical to plain `mujoco.mj_step` on each Scene's own model, whatever the batch and the threads.

    Float64 state travels through JAX as its bits, so 32-bit JAX loses nothing between calls. `vmap` adds
    simulations to the batch.
    """

    def __init__(self, bank: SceneBank, config: PhysicsConfig, threads: int = 0):
        allow_callbacks()
        self.config, self.gripper = config, GRIPPERS.get(config.gripper)
        self._template = template(bank, config)
        self._threads = threads  # 0: all cores
        self._pools: dict[int, _Pool] = {}  # by number of simulations
        self._lock = threading.Lock()  # a Batch serves one caller at a time

    def reset(self, scene: jax.Array, gripper_pose: jax.Array, qpos: jax.Array) -> PhysicsState:
        result = self._result(scene.shape)
        outputs = jax.pure_callback(self._reset, result, scene, gripper_pose, qpos, vmap_method="broadcast_all")
        return _state(scene, gripper_pose, outputs)

    def rollout(
        self, state: PhysicsState, ctrl: jax.Array, active: jax.Array, *, record_every: int | None = None
    ) -> Any:
        if record_every is not None:
            return recorded_rollout(self, state, ctrl, active, record_every)
        outputs = jax.pure_callback(
            self._rollout, self._result(state.scene.shape), state, ctrl, active, vmap_method="broadcast_all"
        )
        return _state(state.scene, state.gripper_pose, outputs)

    def _result(self, batch: tuple[int, ...]):
        shape, nq = jax.ShapeDtypeStruct, self.gripper.num_qpos
        return (
            shape((*batch, nq), jnp.float32),
            shape((*batch, nq), jnp.float32),
            shape(batch, jnp.bool_),
            shape(batch, jnp.bool_),
            shape((*batch, 2 * len(_EXACT) * nq), jnp.uint32),
        )

    def _reset(self, scene, gripper_pose, qpos):
        batch, nq = np.shape(scene), self.gripper.num_qpos
        scene, pose = np.asarray(scene).reshape(-1), np.asarray(gripper_pose, np.float64).reshape(-1, 7)
        exact = np.zeros((len(scene), len(_EXACT) * nq))
        exact[:, :nq] = np.asarray(qpos).reshape(-1, nq)
        with self._lock:
            pool = self._pool(len(scene))
            pool.load(np.arange(len(scene)), scene, pose, exact)
            with _silent():
                pool.batch.forward(stage=mujoco.mjtStage.mjSTAGE_POS.value)
            contact = pool.contacts > 0
        finite = np.isfinite(exact).all(1) & np.isfinite(pose).all(1)
        return self._pack(batch, exact, contact, ~finite)

    def _rollout(self, state, ctrl, active):
        batch = np.shape(state.scene)
        scene = np.asarray(state.scene).reshape(-1)
        pose = np.asarray(state.gripper_pose, np.float64).reshape(-1, 7)
        exact = np.ascontiguousarray(np.asarray(state.backend_state)).reshape(len(scene), -1).view(np.float64).copy()
        ctrl = np.asarray(ctrl, np.float64).reshape(len(scene), -1, self.gripper.num_ctrl)
        diverged = np.array(state.diverged).reshape(-1)
        contact = np.array(state.in_contact).reshape(-1)
        finite = np.isfinite(ctrl).all((1, 2))
        diverged |= np.asarray(active).reshape(-1) & ~finite
        ids = np.flatnonzero(np.asarray(active).reshape(-1) & ~diverged)
        if len(ids):
            with self._lock:
                pool = self._pool(len(scene))
                pool.load(ids, scene, pose, exact)
                after, good = pool.run(ids, ctrl[ids])
                exact[ids[good]] = after[good]
                diverged[ids[~good]] = True
                contact[ids] = pool.contacts[ids] > 0
        return self._pack(batch, exact, contact, diverged)

    def _pack(self, batch, exact, contact, diverged):
        nq = self.gripper.num_qpos
        qpos, qvel = exact[:, :nq].astype(np.float32), exact[:, nq : 2 * nq].astype(np.float32)
        rows = (qpos, qvel, contact, diverged, np.ascontiguousarray(exact).view(np.uint32))
        return tuple(a.reshape(*batch, *a.shape[1:]) for a in rows)

    def _pool(self, n: int) -> _Pool:
        if n not in self._pools:
            self._pools[n] = _Pool(self._template, n, self._threads)
        return self._pools[n]


def _state(scene: jax.Array, gripper_pose: jax.Array, outputs) -> PhysicsState:
    names = ("qpos", "qvel", "in_contact", "diverged", "backend_state")
    return PhysicsState(scene=scene, gripper_pose=gripper_pose, **dict(zip(names, outputs, strict=True)))


class _Pool:
    """A Batch of n simulations and which Scene each holds now."""

    def __init__(self, template, n: int, threads: int):
        self.batch = Batch(template.model, nsim=n, nthread=threads)
        self._values = template.fields
        self._expanded = {name: self.batch.expand(name) for name in SCENE_FIELDS}
        self._scene = np.full(n, -1)
        self._state = [self.batch.bind(name) for name in _EXACT]
        self._pos, self._quat = self.batch.bind("mocap_pos"), self.batch.bind("mocap_quat")
        self.contacts = self.batch.bind("ncon")

    def load(self, ids: np.ndarray, scene: np.ndarray, pose: np.ndarray, exact: np.ndarray) -> None:
        """Make simulations `ids` those of `scene`, `pose` and `exact` (rows of the whole batch)."""
        changed = ids[self._scene[ids] != scene[ids]]
        for name, rows in self._expanded.items():
            rows[changed] = self._values[name][scene[changed]].reshape(len(changed), *rows.shape[1:])
        self._scene[changed] = scene[changed]
        for field, value in zip(self._state, np.split(exact, len(_EXACT), axis=1), strict=True):
            field[ids] = value[ids]
        # Mocap bodies: 0 is the object, at the origin; 1 is the gripper's base.
        self._pos[ids, 1], self._quat[ids, 1] = pose[ids, :3], pose[ids, 3:]

    def run(self, ids: np.ndarray, ctrl: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Step; returns the exact state [n, 3 * nq] of `ids` and which of them stayed good [n] bool."""
        # A reset after divergence sets MuJoCo's counters back, so a rise is seen only from zero.
        self.batch.warning[ids] = 0
        with _silent():
            self.batch.rollout(ctrl.shape[1], control=ctrl, record=(), ids=ids)
        after = np.concatenate([field[ids] for field in self._state], axis=1)
        # Whatever MuJoCo warns of, it stops the simulation there.
        good = ~self.batch.warning[ids].any((1, 2)) & np.isfinite(after).all(1)
        return after, good


@contextmanager
def _silent():
    """Divergence is reported in `PhysicsState`, not on standard error and in a MUJOCO_LOG.TXT."""
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(handler)
