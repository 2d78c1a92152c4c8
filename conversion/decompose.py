"""Triangle soups of one rigid group -> few convex hulls that a gripper meets where it sees the surface.

Hull first: most semantic leaves of PartNet are boards, whose hull is already right. Concave leaves fall into
connected components, then are cut along their own large planes (the soup itself is cut: no manifold is needed), and
what planes do not cut well goes to CoACD. Hulls are then merged while that fills no free space, and on to the
budget. Two distances decide everything: *phantom* (hull surface in free space, its distance from the visual surface)
and *gap* (visual surface outside all hulls).
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, KDTree, QhullError

from conversion.partnet import Hull, Visual, clean


@dataclass(frozen=True)
class DecomposeConfig:
    """All lengths in unit lengths of the object (its extents are 1 to 2)."""

    decomposer: Literal["planes", "coacd"] = "planes"
    """How concave leaves are cut: along their planes (CoACD where that fails), or always by CoACD."""
    tolerance: float = 0.015
    """A leaf is one hull where that reaches no farther than this into free space."""
    handle_tolerance: float = 0.008
    """The same for handles, knobs and pulls."""
    merge_tolerance: float = 0.008
    """Hulls merge freely where the result reaches no farther than this into free space (half of it for handles)."""
    max_vertices: int = 32
    """Vertices per hull."""
    max_pieces: int = 32
    """Pieces one concave component may be cut into."""
    thickness: float = 0.003
    """Flat leaves are padded to this thickness: MuJoCo refuses coplanar meshes."""


@dataclass(frozen=True)
class Fidelity:
    """How hulls match the visual surface of one group; only surface that can be reached from outside counts."""

    gap_p95: float  # visual surface outside the hulls: how far
    gap_max: float
    phantom_p95: float  # hull surface in free space: how far from the visual surface
    phantom_max: float
    phantom_share: float  # share of the hull surface that lies farther than 0.02 from it


def decompose(visuals: Sequence[Visual], budget: int, config: DecomposeConfig, seed: int = 0) -> list[Hull]:
    """Convex hulls of one rigid group, at most `budget` where merging can reach it.

    visuals: all in one frame. Handles are merged with handles only. Same input, same hulls.
    """
    if not visuals:
        return []
    surface = Surface(visuals, seed)
    pieces: dict[bool, list[_Piece]] = {False: [], True: []}
    for visual in visuals:
        if len(visuals) > 1 and surface.hidden(visual):
            continue
        pieces[visual.is_handle] += _leaf(visual, surface, config)
    handles = _merge(pieces[True], surface, config.merge_tolerance / 2, max(4, budget // 2), config)
    others = _merge(pieces[False], surface, config.merge_tolerance, max(1, budget - len(handles)), config)
    return [Hull(_few_vertices(p.points, config)[0], False) for p in others] + [
        Hull(_few_vertices(p.points, config)[0], True) for p in handles
    ]


class Surface:
    """The visual surface of one group, and which space around it can be reached from outside.

    Meshes of the dataset are open, doubled and of any winding, so inside and outside come from a flood fill of
    voxels: openings below about three voxels count as closed.
    """

    def __init__(self, visuals: Sequence[Visual], seed: int = 0):
        self.rng = np.random.default_rng(seed)
        start = np.cumsum([0] + [len(v.vertices) for v in visuals])
        vertices = np.concatenate([v.vertices for v in visuals])
        self.triangles = np.concatenate([v.vertices[v.faces] for v in visuals])  # [m, 3, 3]
        area = float(_areas(self.triangles).sum())
        spacing = float(np.clip(np.sqrt(area / 20_000), 0.0015, 0.008))
        points, owner = self._sample(self.triangles, int(np.clip(area / spacing**2, 500, 150_000)))
        points = np.concatenate([points, self.triangles.mean(axis=1)])
        self.owner = np.concatenate([owner, np.arange(len(self.triangles))])
        self.tree = KDTree(points)
        handles = [vertices[start[i] : start[i + 1]] for i, v in enumerate(visuals) if v.is_handle]
        self.handles = KDTree(np.concatenate(handles)) if handles else None
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        self.voxel = max(0.008, float((high - low).max()) / 160)
        self.low = low - 4 * self.voxel
        self.shape = np.ceil((high - low) / self.voxel).astype(int) + 9
        dense, _ = self._sample(self.triangles, int(np.clip(4 * area / self.voxel**2, 2000, 600_000)))
        occupied = np.zeros(self.shape, bool)
        occupied[tuple(self._cell(np.concatenate([dense, vertices])).T)] = True
        free, _ = ndimage.label(~ndimage.binary_dilation(occupied))  # type: ignore[misc]
        outside = free == free[0, 0, 0]
        self.depth = ndimage.distance_transform_edt(~outside).astype(np.float32) * self.voxel  # type: ignore[union-attr]

    def _sample(self, triangles: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
        return sample(triangles, n, self.rng)

    def _cell(self, points: np.ndarray) -> np.ndarray:
        return np.clip(((points - self.low) / self.voxel).astype(int), 0, self.shape - 1)

    def outside_depth(self, points: np.ndarray) -> np.ndarray:
        """Distance [n] from points to the space that can be reached, 0 in it."""
        return self.depth[tuple(self._cell(points).T)]

    def hidden(self, visual: Visual) -> bool:
        """Nothing outside can touch this visual."""
        points, _ = self._sample(visual.vertices[visual.faces], 200)
        return bool((self.outside_depth(np.concatenate([points, visual.vertices])) > 3 * self.voxel).all())

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Distance [n] to the surface; exact for the triangles of the four nearest samples."""
        best, index = map(np.asarray, self.tree.query(points, k=4))
        best = best[:, 0]
        for column in index.T:
            best = np.minimum(best, _point_triangle(points, self.triangles[self.owner[column]]))
        return best

    def phantom(self, points: np.ndarray, refine_above: float = 0.003) -> np.ndarray:
        """Distance [n] of points in reachable space to the surface, 0 for points inside."""
        d = self.tree.query(points)[0]
        d[(d > 1.8 * self.voxel) & (self.outside_depth(points) > 0)] = 0
        far = d > refine_above
        if far.any():
            d[far] = self.distance(points[far])
        return d

    def worst(self, piece: _Piece, n: int) -> float:
        """Largest phantom of n samples of a hull. Where it is not itself a handle's, free space beside a handle counts
        double: fingers go there."""
        points = np.concatenate([self._sample(piece.triangles, n)[0], piece.triangles.mean(axis=1)])
        d = self.phantom(points)
        if self.handles is not None and not piece.is_handle:
            far = d > 0.003
            d[far] *= 1 + (self.handles.query(points[far], distance_upper_bound=0.05)[0] < 0.05)
        return float(d.max())


def sample(triangles: np.ndarray, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """n points [n, 3] spread evenly over triangles [m, 3, 3], and the triangle [n] of each."""
    area = np.cumsum(_areas(triangles))
    owner = np.searchsorted(area, (np.arange(n) + rng.random()) / n * area[-1]).clip(0, len(triangles) - 1)
    uv = rng.random((n, 2))
    uv[uv.sum(axis=1) > 1] = 1 - uv[uv.sum(axis=1) > 1]
    a, b, c = triangles[owner].transpose(1, 0, 2)
    return a + uv[:, :1] * (b - a) + uv[:, 1:] * (c - a), owner


def _areas(triangles: np.ndarray) -> np.ndarray:
    a, b, c = triangles.transpose(1, 0, 2)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def _point_triangle(p: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Distance [n] of points [n, 3], each to its own triangle [n, 3, 3] (Ericson 2004, 5.1.5)."""
    a, b, c = triangles.transpose(1, 0, 2)
    dot = lambda x, y: np.einsum("ij,ij->i", x, y)  # noqa: E731
    ab, ac, ap, bp, cp = b - a, c - a, p - a, p - b, p - c
    d1, d2, d3, d4, d5, d6 = dot(ab, ap), dot(ac, ap), dot(ab, bp), dot(ac, bp), dot(ab, cp), dot(ac, cp)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    # Barycentric (v, w) of the nearest point; later rules win, corners over edges over the face.
    with np.errstate(all="ignore"):
        total = va + vb + vc
        v, w = vb / total, vc / total
        edge = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        for region, rv, rw in (
            ((va <= 0) & (d4 >= d3) & (d5 >= d6), 1 - edge, edge),
            ((vb <= 0) & (d2 >= 0) & (d6 <= 0), 0.0, d2 / (d2 - d6)),
            ((vc <= 0) & (d1 >= 0) & (d3 <= 0), d1 / (d1 - d3), 0.0),
            ((d6 >= 0) & (d5 <= d6), 0.0, 1.0),
            ((d3 >= 0) & (d4 <= d3), 1.0, 0.0),
            ((d1 <= 0) & (d2 <= 0), 0.0, 0.0),
        ):
            v, w = np.where(region, rv, v), np.where(region, rw, w)
    d = ap - v[:, None] * ab - w[:, None] * ac
    d = np.sqrt(dot(d, d))
    return np.where(np.isnan(d), np.inf, d)


@dataclass(frozen=True)
class _Piece:
    points: np.ndarray  # [n, 3] the hull's vertices
    triangles: np.ndarray  # [t, 3, 3] its surface
    volume: float
    is_handle: bool

    @cached_property
    def planes(self) -> np.ndarray:
        return np.unique(np.round(ConvexHull(self.points).equations, 7), axis=0)

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return self.points.min(axis=0), self.points.max(axis=0)

    @classmethod
    def of(cls, points: np.ndarray, thickness: float, is_handle: bool = False) -> _Piece:
        """Convex hull of points, padded where they are flat."""
        points = _thickened(points, thickness)
        try:
            hull = ConvexHull(points)
        except QhullError:  # rounding can still leave a sliver that Qhull calls flat
            hull = ConvexHull(points, qhull_options="QJ")
        return cls(points[hull.vertices], points[hull.simplices], float(hull.volume), is_handle)

    def outside(self, points: np.ndarray) -> np.ndarray:
        """Signed distance [n] to the planes: above 0 outside (a lower bound there), below 0 inside."""
        return (points @ self.planes[:, :3].T + self.planes[:, 3]).max(axis=1)

    def holds(self, other: _Piece, slack: float = 0.001) -> bool:
        (low, high), (other_low, other_high) = self.bounds, other.bounds
        if (other_low < low - slack).any() or (other_high > high + slack).any():
            return False
        return bool(self.outside(other.points).max() <= slack)


def _thickened(points: np.ndarray, thickness: float) -> np.ndarray:
    """Points padded to a thickness along their thin principal axes."""
    centre = points.mean(axis=0)
    axes = _axes(points - centre)
    q = (points - centre) @ axes.T
    extent = np.ptp(q, axis=0)
    if (extent >= thickness).all():
        return points
    for k in np.flatnonzero(extent < thickness):
        pad = np.zeros(3)
        pad[k] = (thickness - extent[k]) / 2
        q = np.concatenate([q + pad, q - pad])
    return centre + q @ axes


def _axes(centred: np.ndarray) -> np.ndarray:
    return np.linalg.eigh(centred.T @ centred)[1].T


def _few_vertices(points: np.ndarray, config: DecomposeConfig) -> tuple[np.ndarray, float]:
    """A subset of hull vertices within the limit, and how far the others stick out of it.

    Greedy: the vertex that sticks out most comes next.
    """
    if len(points) <= config.max_vertices:
        return points, 0.0
    directions = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [1, -1, 1], [1, 1, -1], [1, -1, -1]], np.float64)
    reach = points @ directions.T
    chosen = list(dict.fromkeys(np.concatenate([reach.argmax(axis=0), reach.argmin(axis=0)]).tolist()))
    while True:
        try:
            hull = ConvexHull(points[chosen])
        except QhullError:
            d = np.linalg.norm(points[:, None] - points[chosen], axis=2).min(axis=1)
            chosen.append(int(d.argmax()))
            continue
        d = (points @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1)
        if d.max() < 5e-4 or len(hull.vertices) >= config.max_vertices:
            return points[chosen][hull.vertices], float(max(d.max(), 0))
        chosen.append(int(d.argmax()))


def _leaf(visual: Visual, surface: Surface, config: DecomposeConfig) -> list[_Piece]:
    """One visual as hulls: its own, those of its components, or those of their cuts."""
    tolerance = config.handle_tolerance if visual.is_handle else config.tolerance
    whole = _Piece.of(visual.vertices, config.thickness, visual.is_handle)
    if surface.worst(whole, 300) <= tolerance:
        return [whole]
    if config.decomposer == "coacd":
        return _coacd(visual.vertices, visual.faces, visual.is_handle, config)
    out = []
    for vertices, faces in _components(visual.vertices, visual.faces):
        piece = _Piece.of(vertices, config.thickness, visual.is_handle)
        if surface.worst(piece, 300) <= tolerance:
            out.append(piece)
        else:
            out += _cut(*_coarse(vertices, faces, tolerance), surface, visual.is_handle, config)
    return out


def _components(vertices: np.ndarray, faces: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    n = len(vertices)
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_matrix((np.ones(len(edges)), tuple(edges.T)), shape=(n, n))
    count, label = connected_components(graph, directed=False)
    order = np.argsort(label[faces[:, 0]], kind="stable")
    bounds = np.searchsorted(label[faces[order, 0]], np.arange(count + 1))
    return [_used(vertices, faces[order[a:b]]) for a, b in itertools.pairwise(bounds) if b > a]


def _used(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    used, inverse = np.unique(faces, return_inverse=True)
    return vertices[used], inverse.reshape(-1, 3)


def _coarse(vertices: np.ndarray, faces: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Dense curved meshes by vertex clustering: cuts cost time per face, and need no more detail than the tolerance."""
    for cell in (tolerance / 4, tolerance / 2):
        if len(faces) <= 1500:
            break
        v, f = clean(vertices, faces, cell)
        if len(f):
            vertices, faces = v, f
    return vertices, faces


def _coacd(vertices: np.ndarray, faces: np.ndarray, is_handle: bool, config: DecomposeConfig) -> list[_Piece]:
    import coacd

    coacd.set_log_level("error")
    parts = coacd.run_coacd(
        coacd.Mesh(vertices, faces),
        threshold=0.03 if is_handle else 0.05,
        max_convex_hull=config.max_pieces,
        mcts_iterations=60,
        mcts_max_depth=3,
        mcts_nodes=10,
        resolution=1000,
        seed=0,
    )
    return [_Piece.of(np.asarray(v, np.float64), config.thickness, is_handle) for v, _ in parts if len(v)]


def _cut(
    vertices: np.ndarray, faces: np.ndarray, surface: Surface, is_handle: bool, config: DecomposeConfig
) -> list[_Piece]:
    """Cut a soup by planes until every piece's hull is within the tolerance, the worst piece first.

    A cut is judged by the triangle area of the sides that stay concave: judged by volume, peeling a wall off an open
    box would never pay.
    """
    tolerance = config.handle_tolerance if is_handle else config.tolerance
    queue: list[tuple[float, int, float, _Piece, np.ndarray, np.ndarray]] = []
    done: list[_Piece] = []
    count = 0

    def add(v: np.ndarray, f: np.ndarray) -> None:
        nonlocal count
        piece = _Piece.of(v, config.thickness, is_handle)
        worst = surface.worst(piece, 300)
        if worst <= tolerance:
            done.append(piece)
        else:
            heapq.heappush(queue, (-worst * max(piece.volume, 1e-9) ** (1 / 3), count, worst, piece, v, f))
            count += 1

    add(vertices, faces)
    while queue and len(queue) + len(done) < config.max_pieces:
        _, _, worst, piece, v, f = heapq.heappop(queue)
        halves = None
        if plane := _best_plane(v, f, worst, surface, tolerance, config):
            halves = _halves(v, f, *plane)
        if halves is None:
            done.append(piece)
        else:
            for half in halves:
                add(*half)
    return done + [entry[3] for entry in queue]


def _best_plane(
    v: np.ndarray, f: np.ndarray, worst: float, surface: Surface, tolerance: float, config: DecomposeConfig
) -> tuple[np.ndarray, float] | None:
    frames = [np.eye(3)]
    axes = _axes(v - v.mean(axis=0))
    if np.abs(axes).max(axis=1).min() < 0.995:
        frames.append(axes)
    triangles = v[f]
    centres, areas = triangles.mean(axis=1), _areas(triangles)
    best, best_cost = None, np.inf
    for normal, offset in _candidate_planes(v, triangles, frames):
        s = v @ normal - offset
        s[np.abs(s) < 1e-6] = 0
        below, above = _side_points(v, f, s)
        if not (len(below) and len(above)):
            continue
        side = centres @ normal - offset
        low, high = areas[side < -1e-6].sum(), areas[side > 1e-6].sum()
        flat = areas.sum() - low - high
        low, high = (flat, high) if low < 1e-9 else (low, flat) if high < 1e-9 else (low + flat / 2, high + flat / 2)
        cost = 0.02 * abs(low - high)
        for points, area in ((below, low), (above, high)):
            if cost >= best_cost:
                break
            concave = _quick_worst(points, surface, tolerance, config)
            if concave > tolerance:
                cost += area * (0.5 + 0.5 * min(1.0, concave / worst))
        if cost < best_cost:
            best, best_cost = (normal, offset), cost
    return best


def _candidate_planes(v: np.ndarray, triangles: np.ndarray, frames: list[np.ndarray]):
    """Planes of large coplanar faces, the extreme ones too (walls without thickness are peeled), and even cuts."""
    a, b, c = triangles.transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    area = np.linalg.norm(normals, axis=1)
    normals /= area[:, None] + 1e-30
    for axis in np.concatenate(frames):
        along = v @ axis
        low, high = along.min(), along.max()
        if high - low < 0.004:
            continue
        facing = np.abs(normals @ axis) > 0.98
        if facing.any():
            position = triangles[facing].mean(axis=1) @ axis
            _, group = np.unique(np.round(position / 0.002), return_inverse=True)
            weight = np.bincount(group.ravel(), area[facing])
            for k in np.argsort(-weight)[:8]:
                yield axis, float(np.clip(np.median(position[group.ravel() == k]), low, high))
        for share in (0.25, 0.5, 0.75):
            yield axis, float(low + share * (high - low))


def _side_points(v: np.ndarray, f: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What each side's hull is made of: its vertices and where edges cross the plane. s: [n] signed distance."""
    edges = np.concatenate([f[:, :2], f[:, 1:], f[:, ::2]])
    i, j = edges[s[edges[:, 0]] * s[edges[:, 1]] < 0].T
    crossing = v[i] + (s[i] / (s[i] - s[j]))[:, None] * (v[j] - v[i])
    low, high = np.unique(f[s[f].min(axis=1) < 0]), np.unique(f[s[f].max(axis=1) > 0])
    low, high = low[s[low] <= 0], high[s[high] >= 0]
    flat = v[np.unique(f[(s[f] == 0).all(axis=1)])]
    below = np.concatenate([v[low], crossing]) if len(low) else flat
    above = np.concatenate([v[high], crossing]) if len(high) else flat
    return below, above


_LATTICE = np.random.default_rng(1).random((64, 2))
_LATTICE[_LATTICE.sum(axis=1) > 1] = 1 - _LATTICE[_LATTICE.sum(axis=1) > 1]


def _quick_worst(points: np.ndarray, surface: Surface, tolerance: float, config: DecomposeConfig) -> float:
    """`Surface.worst` with few, fixed samples, exact only near the tolerance: thousands of planes are tried."""
    try:
        hull = ConvexHull(points)
        triangles = points[hull.simplices]
        if hull.volume < 1e-9:
            raise QhullError
    except (QhullError, ValueError):
        triangles = _Piece.of(points, config.thickness).triangles
    area = _areas(triangles)
    total = np.cumsum(area)
    n = len(_LATTICE)
    index = np.searchsorted(total, (np.arange(n) + 0.5) / n * total[-1]).clip(0, len(triangles) - 1)
    a, b, c = triangles[index].transpose(1, 0, 2)
    on = a + _LATTICE[:, :1] * (b - a) + _LATTICE[:, 1:] * (c - a)
    on = np.concatenate([on, triangles[np.argsort(-area)[:80]].mean(axis=1)])
    d = surface.tree.query(on)[0]
    d[(d > 1.8 * surface.voxel) & (surface.outside_depth(on) > 0)] = 0
    near = (d > tolerance / 2) & (d < tolerance + 0.03)
    if near.any():
        d[near] = surface.distance(on[near])
    return float(d.max())


def _halves(v: np.ndarray, f: np.ndarray, normal: np.ndarray, offset: float):
    """The soup below and above a plane, or None where one side has no face. Faces in the plane stay with both."""
    s = v @ normal - offset
    s[np.abs(s) < 1e-6] = 0
    flat = (s[f] == 0).all(axis=1)
    below, above = (s[f].max(axis=1) <= 0) & ~flat, (s[f].min(axis=1) >= 0) & ~flat
    new: list[np.ndarray] = []
    sides: dict[int, list[list[int]]] = {-1: [], 1: []}
    for face in f[~(below | above | flat)]:
        corners: dict[int, list[int]] = {-1: [], 1: []}
        for i, j in zip(face, np.roll(face, -1), strict=True):
            for sign, polygon in corners.items():
                if sign * s[i] >= 0:
                    polygon.append(int(i))
            if s[i] * s[j] < 0:
                new.append(v[i] + s[i] / (s[i] - s[j]) * (v[j] - v[i]))
                for polygon in corners.values():
                    polygon.append(len(v) + len(new) - 1)
        for sign, p in corners.items():
            sides[sign].extend([p[0], p[k], p[k + 1]] for k in range(1, len(p) - 1))
    low = np.concatenate([f[below], np.array(sides[-1], int).reshape(-1, 3)])
    high = np.concatenate([f[above], np.array(sides[1], int).reshape(-1, 3)])
    if flat.any():
        if len(low) and len(high):
            low, high = np.concatenate([low, f[flat]]), np.concatenate([high, f[flat]])
        elif len(low):
            high = f[flat]
        else:
            low = f[flat]
    if not (len(low) and len(high)):
        return None
    vertices = np.concatenate([v, np.array(new).reshape(-1, 3)])
    return _used(vertices, low), _used(vertices, high)


def _merge(pieces: list[_Piece], surface: Surface, free: float, budget: int, config: DecomposeConfig) -> list[_Piece]:
    """Drop hulls inside others, merge pairs while phantom stays below `free`, then the cheapest down to the budget."""
    kept: list[_Piece] = []
    for piece in sorted(pieces, key=lambda p: -p.volume):
        if not any(k.holds(piece) for k in kept):
            kept.append(piece)
    kept = _absorb(kept, surface, free, 3 * budget, config)
    active = dict(enumerate(kept))
    heap: list[tuple[float, int, int, float, _Piece]] = []

    def consider(i: int, j: int, reach: float) -> None:
        a, b = active[i], active[j]
        if np.maximum(a.bounds[0] - b.bounds[1], b.bounds[0] - a.bounds[1]).max() > reach:
            return
        merged = _Piece.of(np.concatenate([a.points, b.points]), config.thickness, a.is_handle)
        phantom = surface.worst(merged, 60)
        if phantom <= 1.5 * free:
            phantom = max(phantom, surface.worst(merged, 240))
        growth = max(0.0, merged.volume - a.volume - b.volume) ** (1 / 3)
        heapq.heappush(heap, (phantom + 1e-3 * growth, j, i, phantom, merged))

    def consider_all(reach: float) -> None:
        for i in list(active):
            for j in (j for j in active if j < i):
                consider(i, j, reach)

    reach, number = 0.04, len(kept)
    consider_all(reach)
    while True:
        if not heap:
            if len(active) <= budget or reach > 1:
                break
            reach = 9.0
            consider_all(reach)
            continue
        _, j, i, phantom, merged = heapq.heappop(heap)
        if i not in active or j not in active:
            continue
        if phantom > free and len(active) <= budget:
            break
        if len(active) <= budget and _few_vertices(merged.points, config)[1] > 0.003:
            continue  # free merges must not cost more surface than the vertex limit can give back
        del active[i], active[j]
        for k in [k for k, p in active.items() if merged.holds(p)]:
            del active[k]
        active[number] = merged
        for k in list(active):
            if k != number:
                consider(number, k, reach)
        number += 1
    return list(active.values())


def _absorb(pieces: list[_Piece], surface: Surface, free: float, target: int, config: DecomposeConfig) -> list[_Piece]:
    """Where there are far too many pieces for pairs of all: the smallest joins the best of its six nearest."""
    size = lambda p: float(np.linalg.norm(p.bounds[1] - p.bounds[0]))  # noqa: E731
    pieces = sorted(pieces, key=size)
    while len(pieces) > target:
        small, rest = pieces[0], pieces[1:]
        apart = [
            np.maximum(0, np.maximum(small.bounds[0] - p.bounds[1], p.bounds[0] - small.bounds[1])).max() for p in rest
        ]
        best = None
        for k in np.argsort(apart, kind="stable")[:6]:
            merged = _Piece.of(np.concatenate([small.points, rest[k].points]), config.thickness, small.is_handle)
            phantom = surface.worst(merged, 60)
            if best is None or phantom < best[0]:
                best = (phantom, k, merged)
            if phantom <= free:
                break
        assert best is not None
        _, k, merged = best
        rest[k] = merged
        pieces = sorted((p for p in rest if p is merged or not merged.holds(p)), key=size)
    return pieces


def fidelity(visuals: Sequence[Visual], hulls: Sequence[Hull], seed: int = 0) -> Fidelity:
    """Gap and phantom of the hulls of one group; visuals and hulls in one frame."""
    surface = Surface(visuals, seed + 1)
    pieces = [_Piece.of(h.vertices, 1e-6) for h in hulls]
    points, _ = sample(surface.triangles, 20_000, surface.rng)
    points = points[surface.outside_depth(points) <= 2.5 * surface.voxel]
    gap = np.full(len(points), np.inf)
    for piece in pieces:
        gap = np.minimum(gap, piece.outside(points))
    gap = np.maximum(gap, 0) if len(gap) else np.zeros(1)
    area = np.array([_areas(p.triangles).sum() for p in pieces])
    skin = []
    for i, piece in enumerate(pieces):
        on, _ = sample(piece.triangles, int(np.clip(12_000 * area[i] / area.sum(), 60, 6000)), surface.rng)
        for k, other in enumerate(pieces):
            if k != i and (other.bounds[0] < piece.bounds[1]).all() and (other.bounds[1] > piece.bounds[0]).all():
                on = on[other.outside(on) > -1e-4]
        skin.append(on)
    on = np.concatenate(skin) if skin else np.zeros((0, 3))
    on = on[surface.outside_depth(on) <= 2.5 * surface.voxel]
    phantom = surface.phantom(on, 0.0) if len(on) else np.zeros(1)
    return Fidelity(
        float(np.percentile(gap, 95)),
        float(gap.max()),
        float(np.percentile(phantom, 95)),
        float(phantom.max()),
        float((phantom > 0.02).mean()),
    )
