"""Contacts of the gripper's boxes with the boxes of a Scene, for MJX.

MJX tests every pair of geoms of a model, near or not, and the pairs are fixed when it is compiled. Here a simulation
has its own list of pairs, chosen anew every few steps: the nearest of all. Their contacts follow MuJoCo's: where two
edges overlap less than any face does, these touch; else the face that overlaps least is the reference, the other box's
face most opposed to it is clipped by it, and up to four corners of what is left touch.

A number of every pair is an array of its own here, and no array has an axis of three: so it vectorises on CPUs, where
arrays of vectors do not.
"""

from __future__ import annotations

from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from mujoco.mjx._src import math  # no public names for these; mujoco-mjx is pinned to one minor version

MANIFOLD = 4  # contacts of a pair, at most
NOTHING = -1e9

Scalars = list[jax.Array]  # of a vector; one array each
Matrix = list[list[jax.Array]]  # rows


class Boxes(NamedTuple):
    """N oriented boxes."""

    pos: jax.Array  # [..., N, 3] centres
    mat: jax.Array  # [..., N, 3, 3]
    half: jax.Array  # [..., N, 3] half extents

    def moved(self, pos: jax.Array, mat: jax.Array) -> Boxes:
        """From the frame of a body at pos [3], mat [3, 3] into the world."""
        return Boxes(pos + self.pos @ mat.T, mat @ self.mat, self.half)


class Pairs(NamedTuple):
    """P pairs of a box of the Scene and one of the gripper."""

    box: Boxes  # [P] in the frame of its body
    on_part: jax.Array  # [P] bool: of the part, else of what does not move
    gripper: jax.Array  # [P] int32, which of the gripper's boxes


class Contacts(NamedTuple):
    """C contacts; those with a positive distance are none."""

    dist: jax.Array  # [C]
    pos: jax.Array  # [C, 3]
    frame: jax.Array  # [C, 3, 3] rows: normal from the Scene to the gripper, tangents
    pair: jax.Array  # [C] int32


class _Relation(NamedTuple):
    """How a second box lies in the frame of a first one."""

    turn: Matrix  # its axes, as columns
    shift: Scalars  # its centre
    first: Scalars  # half extents
    second: Scalars

    def face_gaps(self) -> Scalars:
        """Six: along the first box's axes, then the second's; negative where they overlap."""
        bent = [[jnp.abs(x) for x in row] for row in self.turn]
        own = [jnp.abs(self.shift[i]) - self.first[i] - _dot(bent[i], self.second) for i in range(3)]
        columns = list(zip(*self.turn, strict=True)), list(zip(*bent, strict=True))
        other = [
            jnp.abs(_dot(columns[0][j], self.shift)) - self.second[j] - _dot(columns[1][j], self.first)
            for j in range(3)
        ]
        return own + other


def choose(condition: jax.Array, yes: Boxes, no: Boxes) -> Boxes:
    """[N] of either."""
    of = lambda x: jnp.expand_dims(condition, tuple(range(condition.ndim, x.ndim)))
    return jax.tree.map(lambda x, y: jnp.where(of(x), x, y), yes, no)


def gaps(boxes: Boxes, others: Boxes) -> jax.Array:
    """[N, K] the widest gap of N and K boxes along the six face axes of each two; negative where they overlap."""
    one = jax.tree.map(lambda x: x[:, None], boxes)
    return reduce(jnp.maximum, _relation(one, others).face_gaps())


def nearest_pairs(
    static: Boxes, part: Boxes, part_pose: tuple[jax.Array, jax.Array], gripper: Boxes, count: int
) -> Pairs:
    """The `count` nearest pairs. static, part: in their bodies' frames; gripper: in the world."""
    apart = jnp.concatenate([gaps(static, gripper), gaps(part.moved(*part_pose), gripper)])
    chosen = jax.lax.top_k(-apart.ravel(), count)[1]
    row, finger = chosen // apart.shape[1], chosen % apart.shape[1]
    boxes = jax.tree.map(lambda *x: jnp.concatenate(x)[row], static, part)
    return Pairs(boxes, row >= len(static.pos), finger.astype(jnp.int32))


def contacts(pairs: Pairs, part_pose: tuple[jax.Array, jax.Array], gripper: Boxes, count: int) -> Contacts:
    """The `count` deepest contacts of P pairs, up to MANIFOLD of each."""
    first = choose(pairs.on_part, pairs.box.moved(*part_pose), pairs.box)
    second = jax.tree.map(lambda x: x[pairs.gripper], gripper)
    dist, pos, normal = box_contacts(first, second)
    number = jnp.tile(jnp.arange(dist.shape[1], dtype=jnp.int32), len(dist))
    found = dist.ravel(), pos.reshape(-1, 3), normal.reshape(-1, 3), number
    if len(number) > count:
        deepest = jax.lax.top_k(-found[0], count)[1]
        found = tuple(x[deepest] for x in found)
    return Contacts(found[0], found[1], jax.vmap(math.make_frame)(found[2]), found[3])


def box_contacts(first: Boxes, second: Boxes) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Distances [4, P], positions and normals [4, P, 3] of P pairs of boxes; a distance of 1 is no contact.

    Positions are half-way between the surfaces, normals point from the first box to the second.
    """
    relation = _computed_once(_relation(first, second))
    faces = _computed_once(relation.face_gaps())
    face_gap = reduce(jnp.maximum, faces)
    edge_gap, edge = _computed_once(_edge_gap(relation))
    overlap = jnp.maximum(face_gap, edge_gap) < 0
    is_edge = overlap & (edge_gap > face_gap + 1e-6)
    dist, pos, normal = _face_contacts(first, second, relation, faces)
    edge_pos, edge_normal = _edge_contact(first, second, edge)
    dist = jnp.where(is_edge, jnp.stack([edge_gap, *[jnp.ones_like(edge_gap)] * (MANIFOLD - 1)]), dist)
    pos = jnp.where(is_edge[:, None], edge_pos, pos)
    normal = jnp.where(is_edge[:, None], edge_normal, normal)
    return jnp.where(overlap, dist, 1.0), pos, jnp.broadcast_to(normal, pos.shape)


def _computed_once(tree: Any) -> Any:
    """The same numbers, arrays of one shape. XLA fuses what is elementwise into everything that reads it, and computes
    it there anew, over and over. It does not reach through a product of matrices, nor keep to
    `optimization_barrier` on CPUs (jax 0.10)."""
    leaves, treedef = jax.tree.flatten(tree)
    flat = jnp.stack([x.ravel() for x in leaves])
    same = jnp.matmul(jnp.eye(len(leaves)), flat, precision=jax.lax.Precision.HIGHEST)
    return jax.tree.unflatten(treedef, [x.reshape(leaves[0].shape) for x in same])


def _dot(a, b) -> jax.Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _pick(index: jax.Array, options) -> jax.Array:
    """options[index], of three."""
    return jnp.where(index == 0, options[0], jnp.where(index == 1, options[1], options[2]))


def _relation(first: Boxes, second: Boxes) -> _Relation:
    column = lambda box, j: [box.mat[..., i, j] for i in range(3)]
    apart = [second.pos[..., i] - first.pos[..., i] for i in range(3)]
    own = [column(first, i) for i in range(3)]
    turn = [[_dot(own[i], column(second, j)) for j in range(3)] for i in range(3)]
    half = lambda box: [box.half[..., i] for i in range(3)]
    return _Relation(turn, [_dot(own[i], apart) for i in range(3)], half(first), half(second))


def _edge_gap(relation: _Relation) -> tuple[jax.Array, jax.Array]:
    """The widest gap along the cross products of two edges, and of which: 3 times the first box's axis plus the
    second's."""
    turn, shift, first, second = relation
    best, which = jnp.full_like(shift[0], NOTHING), jnp.zeros_like(shift[0])
    for i in range(3):
        for j in range(3):
            i1, i2, j1, j2 = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
            square = 1 - turn[i][j] ** 2  # of the cross product's length
            reach = first[i1] * jnp.abs(turn[i2][j]) + first[i2] * jnp.abs(turn[i1][j])
            reach += second[j1] * jnp.abs(turn[i][j2]) + second[j2] * jnp.abs(turn[i][j1])
            gap = jnp.abs(shift[i2] * turn[i1][j] - shift[i1] * turn[i2][j]) - reach
            gap = jnp.where(square > 1e-6, gap * jax.lax.rsqrt(jnp.maximum(square, 1e-6)), NOTHING)
            which = jnp.where(gap > best, 3 * i + j, which)
            best = jnp.maximum(gap, best)
    return best, which


def _edge_contact(first: Boxes, second: Boxes, edge: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Position [P, 3] half-way between the two edges, and normal [P, 3]."""
    boxes = (first, second)
    columns = [[[box.mat[..., i, j] for i in range(3)] for j in range(3)] for box in boxes]
    halves = [[box.half[..., i] for i in range(3)] for box in boxes]
    centres = [[box.pos[..., i] for i in range(3)] for box in boxes]
    index = jnp.floor(edge / 3), edge % 3
    way = [[_pick(index[b], [columns[b][j][i] for j in range(3)]) for i in range(3)] for b in range(2)]
    a, c = way = _computed_once(way)
    normal = [a[1] * c[2] - a[2] * c[1], a[2] * c[0] - a[0] * c[2], a[0] * c[1] - a[1] * c[0]]
    apart = [centres[1][i] - centres[0][i] for i in range(3)]
    scale = jax.lax.rsqrt(jnp.maximum(_dot(normal, normal), 1e-12)) * jnp.where(_dot(normal, apart) < 0, -1.0, 1.0)
    normal = _computed_once([x * scale for x in normal])
    ends, limits = [], []
    for b, outward in ((0, 1.0), (1, -1.0)):
        end = list(centres[b])
        for j in range(3):
            sign = outward * jnp.sign(_dot(columns[b][j], normal)) * halves[b][j] * (index[b] != j)
            end = [end[i] + sign * columns[b][j][i] for i in range(3)]
        ends.append(end)
        limits.append(_pick(index[b], halves[b]))
    ends = _computed_once(ends)
    between = [ends[0][i] - ends[1][i] for i in range(3)]
    cosine, d, e = _dot(a, c), _dot(a, between), _dot(c, between)
    sine = jnp.maximum(1 - cosine**2, 1e-6)
    s = jnp.clip((cosine * e - d) / sine, -limits[0], limits[0])
    t = jnp.clip((e - cosine * d) / sine, -limits[1], limits[1])
    pos = [0.5 * (ends[0][i] + s * a[i] + ends[1][i] + t * c[i]) for i in range(3)]
    return jnp.stack(pos, -1), jnp.stack(normal, -1)


def _face_contacts(
    first: Boxes, second: Boxes, relation: _Relation, faces: Scalars
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Distances [4, P], positions [4, P, 3] and the normal [P, 3] of the face that overlaps least."""
    best, face = faces[0], jnp.zeros_like(faces[0])
    for number in range(1, 6):
        face = jnp.where(faces[number] > best, number, face)
        best = jnp.maximum(faces[number], best)
    # The box with the reference face in the place of the first.
    swapped, axis = face >= 3, face % 3
    either = lambda x, y: jnp.where(swapped, y, x)
    turn, shift, own, other = relation
    back = [-_dot([turn[i][j] for i in range(3)], shift) for j in range(3)]
    turn = [[either(turn[i][j], turn[j][i]) for j in range(3)] for i in range(3)]
    shift = [either(shift[i], back[i]) for i in range(3)]
    own, other = [either(own[i], other[i]) for i in range(3)], [either(other[i], own[i]) for i in range(3)]
    turn, shift, own, other = _computed_once((turn, shift, own, other))
    # Axes u, v and w of the reference box, w out of the face.
    place = lambda x: [_pick(axis, [x[(k + 1 + n) % 3] for k in range(3)]) for n in range(3)]
    half_u, half_v, half_w = place(own)
    u, v, w = place(shift)
    rows = [[_pick(axis, [turn[(k + 1 + n) % 3][j] for k in range(3)]) for j in range(3)] for n in range(3)]
    up = jnp.where(w < 0, -1.0, 1.0)
    w, rows[2] = w * up, [x * up for x in rows[2]]
    half_u, half_v, half_w, u, v, w, up, rows = _computed_once((half_u, half_v, half_w, u, v, w, up, rows))
    # The other box's face: its centre, and from there to the middles of two of its sides.
    steep = [jnp.abs(x) for x in rows[2]]
    facing = jnp.where(steep[0] >= jnp.maximum(steep[1], steep[2]), 0, jnp.where(steep[1] >= steep[2], 1, 2))
    arms = []
    for n in range(3):
        size = _pick(facing, [other[(k + n) % 3] for k in range(3)])
        arms.append([size * _pick(facing, [row[(k + n) % 3] for k in range(3)]) for row in rows])
    inward = jnp.where(arms[0][2] > 0, -1.0, 1.0)
    centre = [x + inward * y for x, y in zip((u, v, w), arms[0], strict=True)]
    centre, arms = _computed_once((centre, arms))
    dist, u, v, w = _spread(_clipped(centre, arms[1], arms[2], half_u, half_v), half_w)
    # Back into the world.
    reference = choose(swapped, second, first)
    columns = [[reference.mat[..., i, j] for j in range(3)] for i in range(3)]
    axes = [place(row) for row in columns]  # [i][u, v, w]
    pos = [reference.pos[..., i] + u * axes[i][0] + v * axes[i][1] + w * up * axes[i][2] for i in range(3)]
    outward = up * jnp.where(swapped, -1.0, 1.0)
    return dist, jnp.stack(pos, -1), jnp.stack([outward * axes[i][2] for i in range(3)], -1)


_SIGNS = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]], np.float32)


class _Corners(NamedTuple):
    u: jax.Array  # [24, P]
    v: jax.Array
    w: jax.Array
    inside: jax.Array  # bool, it is one


def _clipped(centre: Scalars, a: Scalars, b: Scalars, half_u: jax.Array, half_v: jax.Array) -> _Corners:
    """All that may be a corner of a parallelogram within a rectangle."""
    side = lambda n: jnp.asarray(_SIGNS[:, n].reshape(4, *[1] * half_u.ndim))
    s, t = side(0), side(1)
    # Corners of the parallelogram.
    found = [[centre[i] + s * a[i] + t * b[i] for i in range(3)]]
    inside = [(jnp.abs(found[0][0]) <= half_u) & (jnp.abs(found[0][1]) <= half_v)]
    # Corners of the rectangle.
    area = a[0] * b[1] - a[1] * b[0]
    inverse = 1 / jnp.where(jnp.abs(area) < 1e-12, 1e-12, area)
    du, dv = s * half_u - centre[0], t * half_v - centre[1]
    x, y = (du * b[1] - dv * b[0]) * inverse, (a[0] * dv - a[1] * du) * inverse
    found.append([s * half_u, t * half_v, centre[2] + x * a[2] + y * b[2]])
    inside.append((jnp.abs(x) < 1) & (jnp.abs(y) < 1))
    # Where sides of the two cross.
    for along, fixed in ((a, b), (b, a)):
        for axis, half, limit in ((0, half_u, half_v), (1, half_v, half_u)):
            begin = [centre[i] + t * fixed[i] for i in range(3)]
            rate = along[axis]
            x = (s * half - begin[axis]) / jnp.where(jnp.abs(rate) < 1e-9, 1e-9, rate)
            point = [begin[i] + x * along[i] for i in range(3)]
            found.append(point)
            inside.append((jnp.abs(x) < 1) & (jnp.abs(point[1 - axis]) < limit))
    u, v, w = (jnp.concatenate([point[i] for point in found]) for i in range(3))
    return _Corners(u, v, w, jnp.concatenate(inside))


def _spread(corners: _Corners, half_w: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Four of them, the farthest along the diagonals: distances, u, v and w, [4, P] each. w is half-way."""
    u, v, w, inside = corners
    u, v, w, inside = _computed_once((u, v, w, 1.0 * (inside & (w < half_w))))
    inside = inside > 0.5
    # So that no two are equally far.
    order = 1e-6 * np.arange(len(u), dtype=np.float32).reshape(-1, *[1] * half_w.ndim)
    picked = []
    for s, t in _SIGNS:
        reach = jnp.where(inside, s * u + t * v + order, NOTHING)
        farthest = reach.max(0)
        chosen = (reach == farthest) & inside
        at = [jnp.where(chosen, x, 0).sum(0) for x in (u, v, w)]
        # A point that is there already would be another spring.
        again = [(jnp.abs(at[0] - p[0]) < 1e-5) & (jnp.abs(at[1] - p[1]) < 1e-5) & (p[3] < 0) for p in picked]
        there = farthest > 0.5 * NOTHING
        for other in again:
            there &= ~other
        picked.append((*at, jnp.where(there, at[2] - half_w, 1.0)))
    u, v, w, dist = (jnp.stack(x) for x in zip(*picked, strict=True))
    return dist, u, v, 0.5 * (w + half_w)
