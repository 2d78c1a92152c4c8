"""Contacts of boxes against MuJoCo's own."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from vatmart_jax.physics.mjx_boxes import Boxes, box_contacts, choose, gaps, nearest_pairs

PAIRS = 300
OVERLAP = 1e-3  # about as deep as contacts get, unit lengths along a random direction


def boxes(pos: np.ndarray, rotation: Rotation, half: np.ndarray) -> Boxes:
    return Boxes(*(jnp.asarray(x, jnp.float32) for x in (pos, rotation.as_matrix(), half)))


def touching_pairs(seed: int) -> tuple[Boxes, Boxes]:
    """Boards and finger-sized boxes that overlap a little: half of them nearly parallel, half anyhow."""
    rng = np.random.default_rng(seed)
    half = rng.uniform(0.01, 0.5, (PAIRS, 3)), rng.uniform(0.005, 0.04, (PAIRS, 3))
    board = Rotation.random(PAIRS, rng=rng)
    nearly = (board * Rotation.from_rotvec(rng.normal(0, 0.05, (PAIRS, 3)))).as_matrix()
    anyhow = Rotation.random(PAIRS, rng=rng).as_matrix()
    finger = Rotation.from_matrix(np.where(np.arange(PAIRS)[:, None, None] % 2, nearly, anyhow))
    first = boxes(rng.normal(0, 0.1, (PAIRS, 3)), board, half[0])
    direction = rng.normal(size=(PAIRS, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    inside = np.asarray(first.pos) + board.apply(rng.uniform(-0.6, 0.6, (PAIRS, 3)) * half[0])
    near, far = np.zeros(PAIRS), np.full(PAIRS, 2.0)
    for _ in range(30):  # where they begin to touch
        middle = 0.5 * (near + far)
        touch = np.asarray(
            box_contacts(first, boxes(inside + middle[:, None] * direction, finger, half[1]))[0].min(0) < 0
        )
        near, far = np.where(touch, middle, near), np.where(touch, far, middle)
    return first, boxes(inside + (near - OVERLAP)[:, None] * direction, finger, half[1])


def mujoco_contacts(first: Boxes, second: Boxes, k: int) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Distance, position and normal of every contact that C finds."""
    spec = mujoco.MjSpec()
    for box, mocap in ((first, True), (second, False)):
        quat = Rotation.from_matrix(np.asarray(box.mat[k], float)).as_quat(scalar_first=True)
        body = spec.worldbody.add_body(pos=np.asarray(box.pos[k], float), quat=quat, mocap=mocap)
        if not mocap:
            body.add_freejoint()
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=np.asarray(box.half[k], float))
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    return [(c.dist, c.pos.copy(), c.frame[:3].copy()) for c in data.contact]


def test_contacts_are_those_of_mujoco():
    first, second = touching_pairs(0)
    dist, pos, normal = map(np.asarray, box_contacts(first, second))
    counts, same = [], []
    for k in range(PAIRS):
        theirs = mujoco_contacts(first, second, k)
        mine = dist[:, k] < 0
        assert mine.any() == bool(theirs), k
        if not theirs:
            continue
        deepest = min(theirs, key=lambda c: c[0])
        i = dist[:, k].argmin()
        np.testing.assert_allclose(dist[i, k], deepest[0], atol=1e-5)
        nearest = max(min(np.linalg.norm(p - pos[j, k]) for _, p, _ in theirs) for j in np.flatnonzero(mine))
        same.append(normal[i, k] @ deepest[2] > 0.999 and nearest < 1e-4)
        counts.append((mine.sum(), len(theirs)))
    assert np.mean(same) > 0.99  # where two faces or edges are as deep, rounding decides
    mine, theirs = np.mean(counts, 0)
    assert theirs - 0.1 < mine <= theirs  # C keeps up to eight, here four


def test_boxes_apart_do_not_touch():
    first, second = touching_pairs(1)
    away = second._replace(pos=second.pos + 3.0)
    assert (np.asarray(box_contacts(first, away)[0]) > 0).all()
    assert (np.asarray(gaps(first, away)) > 0).all()


def test_the_nearest_pairs_are_chosen_of_all():
    first, second = touching_pairs(2)
    gripper = jax.tree.map(lambda x: x[:3], second)
    static, part = (jax.tree.map(lambda x, rows=rows: x[rows], first) for rows in (slice(0, 40), slice(40, 60)))
    shift = jnp.array([0.1, 0.0, -0.2])
    pairs = nearest_pairs(static, part, (shift, jnp.eye(3)), gripper, 8)
    apart = np.asarray(gaps(static, gripper)), np.asarray(gaps(part.moved(shift, jnp.eye(3)), gripper))
    placed = choose(pairs.on_part, pairs.box.moved(shift, jnp.eye(3)), pairs.box)
    chosen = jax.tree.map(lambda x: x[pairs.gripper], gripper)
    found = np.diagonal(np.asarray(gaps(placed, chosen)))
    np.testing.assert_allclose(np.sort(found), np.sort(np.concatenate(apart).ravel())[:8], atol=1e-6)
