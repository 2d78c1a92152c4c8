"""Triangle soups of one rigid group -> few convex hulls that a gripper meets where it sees the surface.

Hull first: most semantic leaves of PartNet are boards, whose hull is already right. A concave leaf falls into
connected components, and those into flat patches that grow together again while their common hull stays out of free
space (bottom up, so no manifold is needed; CoACD wants one, and takes ten times as long for more pieces). Hulls of all
leaves are then merged in the same way, and on to the budget. Two distances decide everything: *phantom* (hull surface
in free space, its distance from the visual surface) and *gap* (visual surface outside all hulls).
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, KDTree, QhullError

from conversion.partnet import Hull, Visual, clean

MAX_DISTANCE = 0.1  # farther from the surface, how far no longer matters, and searching gets slow
_R2 = np.array([0.7548776662466927, 0.5698402909980532])
SHEET = 2e-4  # thickness of flat patches while they grow; what stays flat gets more in the end
MAX_ROUNDING = 0.003  # hulls merge freely only where the vertex limit costs no more surface than this


@dataclass(frozen=True)
class DecomposeConfig:
    """All lengths in unit lengths of the object (its extents are 1 to 2)."""

    decomposer: Literal["hulls", "coacd"] = "hulls"
    """How concave leaves are taken apart: hulls grown from their flat patches, or CoACD."""
    tolerance: float = 0.015
    """A leaf is one hull where that reaches no farther than this into free space."""
    handle_tolerance: float = 0.008
    """The same for handles, knobs and pulls."""
    merge_tolerance: float = 0.008
    """Hulls merge freely where the result reaches no farther than this into free space."""
    handle_merge_tolerance: float = 0.004
    """The same for handles, knobs and pulls."""
    max_vertices: int = 32
    """Vertices per hull."""
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


def decompose(surface: Surface, budget: int, config: DecomposeConfig) -> list[Hull]:
    """Convex hulls of one rigid group, at most `budget` of them. Handles are merged with handles only."""
    visuals = surface.visuals
    bars = [v for v in visuals if v.is_handle]
    # Fingers go between a handle and its board: what its hulls may fill is told from the handle alone, and finer.
    own = Surface(bars, finest=0.002) if bars else surface
    pieces: list[_Piece] = []
    for visual in visuals:
        if len(visuals) == 1 or not surface.hidden(visual):
            pieces += _leaf(visual, own if visual.is_handle else surface, config)
    kept = _within(pieces, surface, own, budget, config)
    return [Hull(_few_vertices(_thickened(p.points, config.thickness), config)[0], p.is_handle) for p in kept]


def merged(
    surface: Surface, hulls: Sequence[Hull], budget: int, config: DecomposeConfig
) -> tuple[list[int], list[Hull]]:
    """Hulls of several groups as at most `budget`: which of them stay as they are, and new ones for others.

    Those that nothing outside reaches are dropped.
    """
    pieces = [_Piece.of(h.vertices, config.thickness / 2, h.is_handle) for h in hulls]
    number = {id(p): i for i, p in enumerate(pieces)}
    kept, new = [], []
    for piece in _within(pieces, surface, surface, budget, config):
        if id(piece) in number:
            kept.append(number[id(piece)])
        else:
            new.append(Hull(_few_vertices(piece.points, config)[0], piece.is_handle))
    return sorted(kept), new


def _within(
    pieces: list[_Piece], surface: Surface, of_handles: Surface, budget: int, config: DecomposeConfig
) -> list[_Piece]:
    handles = [p for p in pieces if p.is_handle]
    others = _merge([p for p in pieces if not p.is_handle], surface, config.merge_tolerance, budget, config)
    room = max(4, budget // 2, budget - len(others))
    handles = _merge(handles, of_handles, config.handle_merge_tolerance, room, config)
    if len(others) + len(handles) > budget:
        others = _merge(others, surface, config.merge_tolerance, max(1, budget - len(handles)), config)
    return others + handles


class Surface:
    """The visual surface of one group, and which space around it can be reached from outside.

    Meshes of the dataset are open, doubled and of any winding, so inside and outside come from a flood fill of
    voxels: openings below about three voxels count as closed.
    """

    def __init__(self, visuals: Sequence[Visual], seed: int = 0, finest: float = 0.008):
        """finest: smallest voxel; larger objects have larger ones."""
        self.visuals = visuals
        self.rng = np.random.default_rng(seed)
        start = np.cumsum([0] + [len(v.vertices) for v in visuals])
        vertices = np.concatenate([v.vertices for v in visuals])
        self.triangles = np.concatenate([v.vertices[v.faces] for v in visuals])  # [m, 3, 3]
        area = float(_areas(self.triangles).sum())
        spacing = float(np.clip(np.sqrt(area / 20_000), 0.0015, 0.012))
        points, owner = self.sample(self.triangles, int(np.clip(area / spacing**2, 500, 150_000)))
        points = np.concatenate([points, self.triangles.mean(axis=1)])
        self.owner = np.concatenate([owner, np.arange(len(self.triangles))])
        self.tree = KDTree(points)
        handles = [vertices[start[i] : start[i + 1]] for i, v in enumerate(visuals) if v.is_handle]
        self.handles = KDTree(np.concatenate(handles)) if handles else None
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        self.voxel = max(finest, float((high - low).max()) / 160)
        self.low = low - 4 * self.voxel
        self.shape = np.ceil((high - low) / self.voxel).astype(int) + 9
        dense, _ = self.sample(self.triangles, int(np.clip(3 * area / self.voxel**2, 2000, 400_000)))
        occupied = np.zeros(self.shape, bool)
        occupied[tuple(self._cell(np.concatenate([dense, vertices])).T)] = True
        free = np.zeros(self.shape, np.int32)
        ndimage.label(~_dilated(occupied), output=free)
        reached = free == free[0, 0, 0]
        self.layer = np.full(self.shape, 4, np.uint8)  # voxels between a cell and the space outside, 4 = further in
        self.layer[reached] = 0
        for k in (1, 2, 3):
            wider = _dilated(reached)
            self.layer[wider & ~reached] = k
            reached = wider

    def sample(self, triangles: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
        """n points [n, 3] spread evenly over triangles [m, 3, 3], and the triangle [n] of each.

        Evenly also within a triangle (the R2 sequence, Roberts 2018): independent ones would leave holes.
        """
        area = np.cumsum(_areas(triangles))
        index = np.arange(n)
        owner = np.searchsorted(area, (index + self.rng.random()) / n * area[-1]).clip(0, len(triangles) - 1)
        uv = (self.rng.random(2) + index[:, None] * _R2) % 1
        folded = uv[:, 0] + uv[:, 1] > 1
        uv[folded] = 1 - uv[folded]
        a, b, c = triangles[owner].transpose(1, 0, 2)
        return a + uv[:, :1] * (b - a) + uv[:, 1:] * (c - a), owner

    def _cell(self, points: np.ndarray) -> np.ndarray:
        return np.clip(((points - self.low) / self.voxel).astype(int), 0, self.shape - 1)

    def layers(self, points: np.ndarray) -> np.ndarray:
        """Voxels [n] between points and the space that can be reached: 0 in it, 4 where it is further."""
        return self.layer[tuple(self._cell(points).T)]

    def hidden(self, visual: Visual) -> bool:
        """Nothing outside can touch this visual."""
        points, _ = self.sample(visual.vertices[visual.faces], 200)
        return bool((self.layers(np.concatenate([points, visual.vertices])) > 3).all())

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Distance [n] to the surface, at most MAX_DISTANCE; exact for the triangles of the four nearest samples."""
        return self._refined(points, *self._nearest(points, MAX_DISTANCE), 0.0, MAX_DISTANCE)

    def phantom(self, points: np.ndarray, most: float = MAX_DISTANCE) -> np.ndarray:
        """Distance [n] of points in reachable space to the surface, at most `most`, 0 for points inside."""
        near, index = self._nearest(points, most)
        near[(near > 1.8 * self.voxel) & (self.layers(points) > 0)] = 0
        return self._refined(points, near, index, 0.003, most)

    def _nearest(self, points: np.ndarray, most: float) -> tuple[np.ndarray, np.ndarray]:
        """Distance [n] to the nearest sample, and the triangles [n, 4] of the nearest four."""
        near, index = map(np.asarray, self.tree.query(points, k=4, distance_upper_bound=most))
        return np.minimum(near[:, 0], most), self.owner[np.minimum(index, len(self.owner) - 1)]

    def _refined(
        self, points: np.ndarray, near: np.ndarray, index: np.ndarray, above: float, below: float
    ) -> np.ndarray:
        rows = np.flatnonzero((near > above) & (near < below))
        exact = _point_triangle(np.repeat(points[rows], 4, axis=0), self.triangles[index[rows].ravel()])
        near[rows] = np.minimum(near[rows], exact.reshape(-1, 4).min(axis=1)) if len(rows) else near[rows]
        return near

    def worst(self, piece: _Piece, n: int, config: DecomposeConfig) -> float:
        """Largest phantom of n samples of a hull. Where it is not itself a handle's, free space beside a handle counts
        for more: fingers go there, and the tolerance is a handle's."""
        points = np.concatenate([self.sample(piece.triangles, n)[0], piece.triangles.mean(axis=1)])
        d = self.phantom(points)
        if self.handles is not None and not piece.is_handle:
            far = d > 0.003
            beside = self.handles.query(points[far], distance_upper_bound=0.05)[0] < 0.05
            d[far] *= np.where(beside, config.tolerance / config.handle_tolerance, 1)
        return float(d.max())

    def harm(self, piece: _Piece, free: float) -> float:
        """Hull area times how much farther than `free` it reaches into free space: what a forced merge costs."""
        points, _ = self.sample(piece.triangles, 100)
        reachable = points[self.layers(points) == 0]
        excess = np.maximum(self.phantom(reachable, MAX_DISTANCE / 2) - free, 0).sum() / len(points)
        # The longest way counts a little, so that of merges without harm the compact one comes first.
        return float(excess * _areas(piece.triangles).sum() + 1e-6 * np.ptp(piece.points, axis=0).max())

    def reachable(self, piece: _Piece) -> bool:
        points, _ = self.sample(piece.triangles, 100)
        return bool((self.layers(np.concatenate([points, piece.points])) <= 3).any())


def _dilated(cells: np.ndarray) -> np.ndarray:
    """Cells [x, y, z] bool and those that share a face with one."""
    out = cells.copy()
    for axis in range(3):
        a, b = np.moveaxis(out, axis, 0), np.moveaxis(cells, axis, 0)
        a[1:] |= b[:-1]
        a[:-1] |= b[1:]
    return out


def _areas(triangles: np.ndarray) -> np.ndarray:
    u, v = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    uu, vv, uv = (np.einsum("ij,ij->i", x, y) for x, y in ((u, u), (v, v), (u, v)))
    return np.sqrt(np.maximum(uu * vv - uv**2, 0)) / 2


def _point_triangle(p: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Distance [n] of points [n, 3], each to its own triangle [n, 3, 3] (Ericson 2004, 5.1.5)."""
    a, b, c = triangles.transpose(1, 0, 2)
    dot = lambda x, y: np.einsum("ij,ij->i", x, y)
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
        return cls._hull(_thickened(points, thickness), is_handle)

    @classmethod
    def _hull(cls, points: np.ndarray, is_handle: bool) -> _Piece:
        try:
            hull = ConvexHull(points)
        except QhullError:  # rounding can still leave a sliver that Qhull calls flat
            hull = ConvexHull(points, qhull_options="QJ")
        return cls(points[hull.vertices], points[hull.simplices], float(hull.volume), is_handle)

    def outside(self, points: np.ndarray) -> np.ndarray:
        """Signed distance [n] to the planes: above 0 outside (a lower bound there), below 0 inside."""
        return (points @ self.planes[:, :3].T + self.planes[:, 3]).max(axis=1)

    def joined(self, other: _Piece) -> _Piece:
        return _Piece._hull(np.concatenate([self.points, other.points]), self.is_handle)

    def rounding(self, config: DecomposeConfig) -> float:
        """How far vertices stick out of the hull of as many as are allowed."""
        return _few_vertices(self.points, config)[1] if len(self.points) > config.max_vertices else 0.0

    def holds(self, others: Sequence[_Piece], bounds: np.ndarray, slack: float = 0.001) -> list[int]:
        """Which of the others, with bounds [n, 2, 3], lie inside this one."""
        low, high = self.bounds
        within = (bounds[:, 0] >= low - slack).all(axis=1) & (bounds[:, 1] <= high + slack).all(axis=1)
        return [k for k in np.flatnonzero(within).tolist() if self.outside(others[k].points).max() <= slack]


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
    """One visual as hulls: its own, those of its components, or those that its patches grow into."""
    tolerance = config.handle_tolerance if visual.is_handle else config.tolerance
    whole = _Piece.of(visual.vertices, SHEET, visual.is_handle)
    if surface.worst(whole, 300, config) <= tolerance:
        return [whole]
    if config.decomposer == "coacd":
        return _coacd(visual, config)
    out = []
    for vertices, faces in _components(visual.vertices, visual.faces):
        piece = _Piece.of(vertices, SHEET, visual.is_handle)
        if surface.worst(piece, 300, config) <= tolerance:
            out.append(piece)
        else:
            patches = _patches(*_coarse(vertices, faces, tolerance), surface, tolerance, visual.is_handle, config)
            out += _grow(patches, surface, tolerance, config)
    return out


def _components(vertices: np.ndarray, faces: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    label = _connected(len(vertices), edges)[faces[:, 0]]
    return [_used(vertices, faces[rows]) for rows in _rows_by(label)]


def _connected(n: int, edges: np.ndarray) -> np.ndarray:
    """Component [n] of each node. edges: [e, 2]."""
    graph = coo_matrix((np.ones(len(edges)), tuple(edges.T)), shape=(n, n))
    return connected_components(graph, directed=False)[1]


def _rows_by(label: np.ndarray) -> list[np.ndarray]:
    order = np.argsort(label, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(label[order])) + 1)


def _used(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    used, inverse = np.unique(faces, return_inverse=True)
    return vertices[used], inverse.reshape(-1, 3)


def _coarse(vertices: np.ndarray, faces: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Dense curved meshes by vertex clustering: growing costs time per face, and needs no more detail than this."""
    for cell in (tolerance / 4, tolerance / 2):
        if len(faces) <= 600:
            break
        v, f = clean(vertices, faces, cell)
        if len(f):
            vertices, faces = v, f
    return vertices, faces


def _patches(
    vertices: np.ndarray,
    faces: np.ndarray,
    surface: Surface,
    tolerance: float,
    is_handle: bool,
    config: DecomposeConfig,
) -> list[_Piece]:
    """Connected coplanar faces as flat pieces; a patch that spans free space (a frame) as its single triangles."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    edges = np.sort(np.concatenate([faces[:, :2], faces[:, 1:], faces[:, ::2]]), axis=1)
    owner = np.tile(np.arange(len(faces)), 3)
    order = np.lexsort(edges.T)
    edges, owner = edges[order], owner[order]
    shared = (edges[1:] == edges[:-1]).all(axis=1)
    pairs = np.stack([owner[:-1][shared], owner[1:][shared]], axis=1)
    flat = np.abs((normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(axis=1)) > 0.9995
    patch = _connected(len(faces), pairs[flat])
    # Curved surfaces are many small patches. Those within one cell reach less than the tolerance into free space
    # together, and growing takes time per piece.
    cell = 0.6 * tolerance
    small = np.array([np.ptp(vertices[faces[rows]].reshape(-1, 3), axis=0).max() < cell for rows in _rows_by(patch)])
    middle = np.array([vertices[faces[rows]].reshape(-1, 3).mean(axis=0) for rows in _rows_by(patch)])
    _, box = np.unique(np.floor(middle / cell), axis=0, return_inverse=True)
    patch = np.where(small, box.ravel(), len(small) + np.arange(len(small)))[patch]
    out = []
    for rows in _rows_by(patch):
        piece = _Piece.of(vertices[np.unique(faces[rows])], SHEET, is_handle)
        if len(rows) == 1 or surface.worst(piece, 60, config) <= tolerance:
            out.append(piece)
        else:
            out += [_Piece.of(vertices[face], SHEET, is_handle) for face in faces[rows]]
    return out


def _coacd(visual: Visual, config: DecomposeConfig) -> list[_Piece]:
    import coacd

    coacd.set_log_level("error")
    parts = coacd.run_coacd(
        coacd.Mesh(visual.vertices, visual.faces),
        threshold=0.03 if visual.is_handle else 0.05,
        mcts_iterations=60,
        mcts_nodes=10,
        resolution=1000,
        seed=0,
    )
    return [_Piece.of(np.asarray(v, np.float64), SHEET, visual.is_handle) for v, _ in parts if len(v)]


def _grow(pieces: list[_Piece], surface: Surface, tolerance: float, config: DecomposeConfig) -> list[_Piece]:
    """Merge neighbours while phantom stays below the tolerance, what makes the smallest piece first."""
    active = dict(enumerate(pieces))
    bounds = _bounds(pieces)
    heap: list[tuple[float, int, int]] = []

    def meet(i: int, others: np.ndarray) -> None:
        near = (bounds[others, 0] <= bounds[i, 1] + tolerance) & (bounds[others, 1] >= bounds[i, 0] - tolerance)
        others = others[near.all(axis=1)]
        low, high = np.minimum(bounds[others, 0], bounds[i, 0]), np.maximum(bounds[others, 1], bounds[i, 1])
        for size, j in zip(np.linalg.norm(high - low, axis=1).tolist(), others.tolist(), strict=True):
            heapq.heappush(heap, (size, i, j))

    for i in range(1, len(pieces)):
        meet(i, np.arange(i))
    while heap:
        _, i, j = heapq.heappop(heap)
        if i not in active or j not in active:
            continue
        merged = active[i].joined(active[j])
        # Few samples first: most pairs fail by much.
        if any(surface.worst(merged, n, config) > tolerance for n in (40, 160)):
            continue
        if merged.rounding(config) > MAX_ROUNDING:
            continue
        del active[i], active[j]
        others = np.fromiter(active, int, len(active))
        for k in merged.holds(list(active.values()), bounds[others]):
            del active[int(others[k])]
        new = len(bounds)
        bounds = np.concatenate([bounds, [merged.bounds]])
        others = np.fromiter(active, int, len(active))
        active[new] = merged
        meet(new, others)
    return list(active.values())


def _merge(pieces: list[_Piece], surface: Surface, free: float, budget: int, config: DecomposeConfig) -> list[_Piece]:
    """Drop hulls that are inside others or out of reach, merge those that may, then the cheapest down to the budget."""
    kept: list[_Piece] = []
    rest = sorted(pieces, key=lambda p: -p.volume)
    while rest:
        first, *rest = rest
        kept.append(first)
        inside = set(first.holds(rest, _bounds(rest)))
        rest = [p for k, p in enumerate(rest) if k not in inside]
    if len(kept) > 1:
        kept = [p for p in kept if surface.reachable(p)] or kept[:1]
    kept = _absorb(_grow(kept, surface, free, config), surface, 3 * budget, config)
    if len(kept) <= budget:
        return kept
    active = dict(enumerate(kept))
    heap: list[tuple[float, int, int, _Piece]] = []

    def meet(i: int, others: list[int]) -> None:
        low, high = active[i].bounds
        apart = [np.maximum(active[j].bounds[0] - high, low - active[j].bounds[1]).max() for j in others]
        for k in np.argsort(apart, kind="stable")[:12].tolist():
            merged = active[i].joined(active[others[k]])
            heapq.heappush(heap, (surface.harm(merged, free), i, others[k], merged))

    for i in active:
        meet(i, list(range(i)))
    number = len(kept)
    while len(active) > budget:
        _, i, j, merged = heapq.heappop(heap)
        if i not in active or j not in active:
            continue
        del active[i], active[j]
        others = list(active)
        for k in merged.holds(list(active.values()), _bounds(active.values())):
            del active[others[k]]
        others = list(active)
        active[number] = merged
        meet(number, others)
        number += 1
    return list(active.values())


def _absorb(pieces: list[_Piece], surface: Surface, target: int, config: DecomposeConfig) -> list[_Piece]:
    """Where there are far too many pieces for all pairs: the smallest joins the best of its six nearest."""
    size = lambda p: float(np.linalg.norm(p.bounds[1] - p.bounds[0]))
    pieces = sorted(pieces, key=size)
    while len(pieces) > target:
        small, rest = pieces[0], pieces[1:]
        apart = [
            np.maximum(0, np.maximum(small.bounds[0] - p.bounds[1], p.bounds[0] - small.bounds[1])).max() for p in rest
        ]
        near = np.argsort(apart, kind="stable")[:6].tolist()
        merged = {k: small.joined(rest[k]) for k in near}
        best = min(near, key=lambda k: surface.harm(merged[k], config.merge_tolerance))
        rest[best] = merged[best]
        rest.append(rest.pop(best))
        inside = set(merged[best].holds(rest[:-1], _bounds(rest[:-1])))
        pieces = sorted((p for k, p in enumerate(rest) if k not in inside), key=size)
    return pieces


def _bounds(pieces: Iterable[_Piece]) -> np.ndarray:
    """[n, 2, 3]"""
    return np.array([p.bounds for p in pieces]).reshape(-1, 2, 3)


def fidelity(surface: Surface, hulls: Sequence[Hull]) -> Fidelity:
    """Gap and phantom of the hulls of one group, by samples of their own."""
    pieces = [_Piece.of(h.vertices, 1e-6) for h in hulls]
    points, _ = surface.sample(surface.triangles, 20_000)
    points = points[surface.layers(points) <= 2]
    gap = np.full(len(points), np.inf)
    for piece in pieces:
        gap = np.minimum(gap, piece.outside(points))
    gap = np.maximum(gap, 0) if len(gap) else np.zeros(1)
    area = np.array([_areas(p.triangles).sum() for p in pieces])
    skin = []
    for i, piece in enumerate(pieces):
        on, _ = surface.sample(piece.triangles, int(np.clip(12_000 * area[i] / area.sum(), 60, 6000)))
        for k, other in enumerate(pieces):
            if k != i and (other.bounds[0] < piece.bounds[1]).all() and (other.bounds[1] > piece.bounds[0]).all():
                on = on[other.outside(on) > -1e-4]
        skin.append(on)
    on = np.concatenate(skin) if skin else np.zeros((0, 3))
    on = on[surface.layers(on) <= 2]
    phantom = surface.phantom(on) if len(on) else np.zeros(1)
    return Fidelity(
        float(np.percentile(gap, 95)),
        float(gap.max()),
        float(np.percentile(phantom, 95)),
        float(phantom.max()),
        float((phantom > 0.02).mean()),
    )
