"""Where on a part a trial may begin, and how a hand would grasp there: host arrays, from the banks alone."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import trimesh

from vatmart_jax import rotations as rot
from vatmart_jax.data.banks import HINGE, SLIDE, SceneBank, SceneTable, ViewBank

_HANDLE_POINTS, _HAND_REACH = 200, 0.05  # per shape of a handle; unit lengths about the contact


def candidate_contacts(bank: SceneBank, views: ViewBank, opening: bool) -> np.ndarray:
    """[V, C] bool: where the task may be done.

    Push: faces that look against the part's motion, off its axis. Pull: handles, and faces along the motion and off the
    axis, which two fingers may straddle; an environment keeps those where the hand fits, handles first.
    """
    motion, arm = _motion(bank, views)
    along = (views.contact_normals * motion).sum(-1)
    if not opening:
        return (along > 0.5) & (arm > 0.1)
    return views.contact_handle | ((np.abs(along) < 0.4) & (arm > 0.1))


def canonical_grasps(bank: SceneBank, views: ViewBank) -> tuple[np.ndarray, np.ndarray]:
    """The straight grasp at every contact: approach direction [V, C, 3] and the axis along which the fingers close
    [V, C, 3], float32 unit, object frame.

    A handle is approached against the opening motion, the fingers closing across the thin side of what of the handle
    is within their reach. Elsewhere the hand comes along the inward normal and the fingers close along the motion.
    """
    motion, _ = _motion(bank, views)
    up = np.where(views.contact_handle[..., None], -motion, -views.contact_normals)
    across = motion.copy()
    surfaces = {s: _handle_surface(bank, s) for s in np.unique(views.scene).tolist()}
    for view in np.flatnonzero(views.contact_handle.any(1)):
        scene = int(views.scene[view])
        rows = np.flatnonzero(views.contact_handle[view])
        # Contacts and directions in the part's frame, where its shapes are.
        rotation, position = _part_pose(bank, scene, float(views.joint_pos[view]))
        contact = (views.contacts[view, rows] - position) @ rotation
        if len(surfaces[scene]):
            local = _thin_axes(surfaces[scene], contact, up[view, rows] @ rotation)
            across[view, rows] = local @ rotation.T
    across -= (across * up).sum(-1, keepdims=True) * up
    across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-6)
    return up.astype(np.float32), across.astype(np.float32)


def _motion(bank: SceneBank, views: ViewBank) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions [V, C, 3] in which contacts move as the part opens, and their distance to the axis [V, C]
    (slides: 1)."""
    scenes = SceneTable.from_bank(bank)
    axis = np.broadcast_to(np.asarray(scenes.axis)[views.scene][:, None], views.contacts.shape)
    if bank.joint_type[0] == SLIDE:
        return axis, np.ones(axis.shape[:2])
    motion = np.cross(axis, views.contacts - np.asarray(scenes.anchor)[views.scene][:, None])
    arm = np.linalg.norm(motion, axis=-1)
    return motion / np.maximum(arm, 1e-6)[..., None], arm


def _handle_surface(bank: SceneBank, scene: int) -> np.ndarray:
    """Points [n, 3] spread over the moving part's handle shapes, part frame."""
    rows = np.arange(bank.part_start[scene], bank.part_start[scene + 1])
    found = [np.zeros((0, 3))]
    for row in rows[bank.instance_handle[rows]]:
        shape = int(bank.instance_shape[row])
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        vertices = bank.hull(shape) if bank.collision == "hull" else corners * bank.box_size[shape]
        surface = trimesh.sample.sample_surface(trimesh.convex.convex_hull(vertices), _HANDLE_POINTS, seed=0)[0]
        rotation = np.asarray(rot.matrix_from_quat(jnp.asarray(bank.instance_quat[row], jnp.float32)))
        found.append(surface @ rotation.T + bank.instance_pos[row])
    return np.concatenate(found)


def _part_pose(bank: SceneBank, scene: int, q: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotation [3, 3] and position [3] of the part's frame at opening q, object frame."""
    rotation = np.asarray(rot.matrix_from_quat(jnp.asarray(bank.part_quat[scene], jnp.float32)))
    axis, position = bank.axis[scene], bank.part_pos[scene]
    if bank.joint_type[scene] == HINGE:
        return rotation @ np.asarray(rot.matrix_from_rotvec(jnp.asarray(axis * q, jnp.float32))), position
    return rotation, position + rotation @ axis * q


def _thin_axes(surface: np.ndarray, contacts: np.ndarray, up: np.ndarray) -> np.ndarray:
    """[n, 3] for contacts [n, 3]: the direction across `up` [n, 3] in which the surface near the contact is thin."""
    side = np.where(np.abs(up[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[0.0, 1.0, 0.0]])
    x = np.cross(side, up)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    angle = np.linspace(0, np.pi, 24, endpoint=False)[:, None, None]
    directions = np.cos(angle) * x + np.sin(angle) * np.cross(up, x)  # [24, n, 3]
    offset = surface - contacts[:, None]  # [n, p, 3]
    distance = np.linalg.norm(offset, axis=-1)
    near = distance < np.maximum(_HAND_REACH, distance.min(-1, keepdims=True) + 0.01)
    along = np.einsum("anj,npj->anp", directions, offset)
    extent = np.where(near, along, -np.inf).max(-1) - np.where(near, along, np.inf).min(-1)
    return directions[extent.argmin(0), np.arange(len(contacts))]
