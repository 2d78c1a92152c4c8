"""Where on a part a task may be done, and how a hand would grasp there: host arrays, from the banks alone."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from vatmart_jax.data.banks import HINGE, SLIDE, SceneBank, SceneTable, ViewBank
from vatmart_jax.envs.task import Task

_HANDLE_POINTS, _HAND_REACH = 200, 0.05  # per shape of a handle; unit lengths about the contact
_FACING, _ACROSS, _MIN_LEVER = 0.5, 0.4, 0.1  # cosines of normal and motion; unit lengths from a hinge's axis


class Grasps(NamedTuple):
    """The canonical grasp at every contact: float32 unit vectors, object frame."""

    approach: np.ndarray  # [V, C, 3]
    closing: np.ndarray  # [V, C, 3] along which the fingers close


def candidate_contacts(bank: SceneBank, views: ViewBank, task: Task) -> np.ndarray:
    """[V, C] bool: where the task may be done.

    Push: faces that look against the part's motion, off its axis; outside faces close a door, inside faces open it.
    Grasp: handles, and faces along the motion and off the axis, which two fingers may straddle.
    """
    motion, lever = _opening_motion(bank, views)
    along = task.direction * (views.contact_normals * motion).sum(-1)
    if not task.grasps:
        return (along < -_FACING) & (lever > _MIN_LEVER)
    return views.contact_handle | ((np.abs(along) < _ACROSS) & (lever > _MIN_LEVER))


def canonical_grasps(
    bank: SceneBank, views: ViewBank, handle_approach: Literal["motion", "normal"] = "motion"
) -> Grasps:
    """The canonical grasp at every contact.

    A handle is approached against the part's opening motion, or along the contact's inward normal; the fingers close
    across the thin side of what of the handle is within their reach. Elsewhere the hand comes along the inward normal
    and the fingers close along the motion: so they straddle a panel at its free edge.
    """
    motion, _ = _opening_motion(bank, views)
    approach = -views.contact_normals
    if handle_approach == "motion":
        approach = np.where(views.contact_handle[..., None], -motion, approach)
    closing = motion.copy()
    surfaces = {s: _handle_surface(bank, s) for s in np.unique(views.scene).tolist()}
    rotations, positions = _part_poses(bank, views)
    for view in np.flatnonzero(views.contact_handle.any(1)):
        surface = surfaces[int(views.scene[view])]
        rows = np.flatnonzero(views.contact_handle[view])
        # Contacts and directions in the part's frame, where its shapes are.
        rotation = rotations[view]
        contact = (views.contacts[view, rows] - positions[view]) @ rotation
        if len(surface):
            closing[view, rows] = _thin_axes(surface, contact, approach[view, rows] @ rotation) @ rotation.T
    closing -= (closing * approach).sum(-1, keepdims=True) * approach
    closing /= np.maximum(np.linalg.norm(closing, axis=-1, keepdims=True), 1e-6)
    return Grasps(approach.astype(np.float32), closing.astype(np.float32))


def _opening_motion(bank: SceneBank, views: ViewBank) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions [V, C, 3] in which contacts move as the part opens, and their distance to the axis [V, C]
    (slides: 1)."""
    table = SceneTable.from_bank(bank)
    axis = np.broadcast_to(np.asarray(table.axis)[views.scene][:, None], views.contacts.shape)
    if bank.joint_type[0] == SLIDE:
        return axis, np.ones(axis.shape[:2])
    motion = np.cross(axis, views.contacts - np.asarray(table.anchor)[views.scene][:, None])
    lever = np.linalg.norm(motion, axis=-1)
    return motion / np.maximum(lever, 1e-6)[..., None], lever


def _handle_surface(bank: SceneBank, scene: int) -> np.ndarray:
    """Points [n, 3] spread over the moving part's handle shapes, part frame."""
    rows = np.arange(bank.part_start[scene], bank.part_start[scene + 1])
    found = [np.zeros((0, 3))]
    for row in rows[bank.instance_handle[rows]]:
        shape = int(bank.instance_shape[row])
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        vertices = bank.hull(shape) if bank.collision == "hull" else corners * bank.box_size[shape]
        surface = trimesh.sample.sample_surface(trimesh.convex.convex_hull(vertices), _HANDLE_POINTS, seed=0)[0]
        rotation = Rotation.from_quat(bank.instance_quat[row], scalar_first=True)
        found.append(rotation.apply(surface) + bank.instance_pos[row])
    return np.concatenate(found)


def _part_poses(bank: SceneBank, views: ViewBank) -> tuple[np.ndarray, np.ndarray]:
    """Rotations [V, 3, 3] and positions [V, 3] of the part's frame in each view, object frame."""
    scene, q = views.scene, views.joint_pos.astype(float)[:, None]
    rotation = Rotation.from_quat(bank.part_quat[scene], scalar_first=True)
    axis, position = bank.axis[scene], bank.part_pos[scene]
    if bank.joint_type[0] == HINGE:
        return (rotation * Rotation.from_rotvec(axis * q)).as_matrix(), position
    return rotation.as_matrix(), position + rotation.apply(axis) * q


def _thin_axes(surface: np.ndarray, contacts: np.ndarray, approach: np.ndarray) -> np.ndarray:
    """[n, 3] for contacts [n, 3]: the direction across `approach` [n, 3] in which the surface near the contact is
    thin."""
    side = np.where(np.abs(approach[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[0.0, 1.0, 0.0]])
    x = np.cross(side, approach)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    angle = np.linspace(0, np.pi, 24, endpoint=False)[:, None, None]
    directions = np.cos(angle) * x + np.sin(angle) * np.cross(approach, x)  # [24, n, 3]
    offset = surface - contacts[:, None]  # [n, p, 3]
    distance = np.linalg.norm(offset, axis=-1)
    near = distance < np.maximum(_HAND_REACH, distance.min(-1, keepdims=True) + 0.01)
    along = np.einsum("anj,npj->anp", directions, offset)
    extent = np.where(near, along, -np.inf).max(-1) - np.where(near, along, np.inf).min(-1)
    return directions[extent.argmin(0), np.arange(len(contacts))]
