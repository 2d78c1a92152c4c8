"""Which views show where a task can be done: geometry first, then, for grasps, whether the open hand fits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from vatmart_jax import rotations as rot
from vatmart_jax.data.banks import SceneBank, ViewBank
from vatmart_jax.envs.contact_candidates import Grasps, canonical_grasps
from vatmart_jax.envs.task import Task
from vatmart_jax.physics import Physics

MIN_PUSHABLE = 4  # of a view's contacts; with fewer, it hardly shows where to push
_FIT_DEPTH, _FIT_BATCH = 0.02, 1024  # unit lengths past the contact; poses tested at once


@dataclass(frozen=True, kw_only=True)
class FeasibleContacts:
    """Of V views with C contacts (host arrays)."""

    contact: np.ndarray  # [V, C] bool, the task may be done there
    grasps: Grasps | None  # canonical ones; None of a push

    @property
    def shown(self) -> np.ndarray:
        """[V] bool, the view shows enough of such contacts."""
        return self.contact.sum(1) >= (MIN_PUSHABLE if self.grasps is None else 1)

    def select(self, views: np.ndarray) -> FeasibleContacts:
        """Those of only these views (indices or boolean mask)."""
        grasps = self.grasps and Grasps(*(x[views] for x in self.grasps))
        return FeasibleContacts(contact=self.contact[views], grasps=grasps)


def feasible_contacts(
    physics: Physics, bank: SceneBank, views: ViewBank, task: Task, candidates: np.ndarray, standoff: float
) -> FeasibleContacts:
    """Of the candidates [V, C] those where the hand fits; only handles in views that show a handle where it fits.

    physics: of `bank`; standoff: unit lengths from which the fingertips advance.
    """
    if not task.grasps:
        return FeasibleContacts(contact=candidates, grasps=None)
    hand_fits = _hand_fits(physics, standoff)  # one program for every approach
    fits = np.zeros_like(candidates)
    grasps: Grasps | None = None
    for approach in task.handle_approach:
        option = canonical_grasps(bank, views, approach)
        found = _where_it_fits(hand_fits, views, candidates & ~fits, option)
        grasps = (
            option
            if grasps is None
            else Grasps(*(np.where(found[..., None], *pair) for pair in zip(option, grasps, strict=True)))
        )
        fits |= found
    handle = fits & views.contact_handle
    return FeasibleContacts(contact=np.where(handle.any(1, keepdims=True), handle, fits), grasps=grasps)


def _hand_fits(physics: Physics, standoff: float) -> Callable[..., jax.Array]:
    """A compiled test of _FIT_BATCH starts: is the open hand free before the grasp and when it has advanced?"""
    gripper, opening = physics.gripper, jnp.full((_FIT_BATCH,), physics.gripper.max_opening)

    def fits(scene: jax.Array, q: jax.Array, contact: jax.Array, rotation: jax.Array) -> jax.Array:
        def free(depth: float) -> jax.Array:
            pose = [gripper.hand_position(contact, rotation, depth), rot.quat_from_matrix(rotation)]
            state = physics.reset(scene, jnp.concatenate(pose, -1), gripper.rest_qpos(q, opening))
            return ~(state.in_contact | state.diverged)

        return free(-standoff) & free(_FIT_DEPTH)

    return jax.jit(fits)


def _where_it_fits(fits: Callable[..., jax.Array], views: ViewBank, tested: np.ndarray, grasps: Grasps) -> np.ndarray:
    """[V, C] bool, of the tested contacts those where the open hand fits for the canonical grasp."""
    rows = np.argwhere(tested)
    found = np.zeros_like(tested)
    for first in range(0, len(rows), _FIT_BATCH):
        # The last batch is filled up with the last row: one shape, one compilation.
        view, contact = rows[np.minimum(np.arange(first, first + _FIT_BATCH), len(rows) - 1)].T
        y, z = grasps.closing[view, contact], grasps.approach[view, contact]
        rotation = np.stack([np.cross(y, z), y, z], -1)
        found[view, contact] = fits(views.scene[view], views.joint_pos[view], views.contacts[view, contact], rotation)
    return found
