"""Triangle soups of one rigid group -> few convex hulls that a gripper meets where it sees the surface.

Hull first: most semantic leaves of PartNet are boards, whose hull is already right. A concave leaf falls into
connected components, and those into flat patches that grow together again while their common hull stays out of free
space (bottom up, so no manifold is needed; CoACD wants one, and takes ten times as long for more pieces). Hulls of all
leaves are then merged in the same way, and on to the budget. Two distances decide everything: *phantom* (hull surface
in free space, its distance from the visual surface) and *gap* (visual surface outside all hulls).
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from conversion.config import DecomposeConfig
from conversion.convex_piece import ConvexPiece, few_vertices, piece_bounds, thickened
from conversion.model import ConvexShape, Visual
from conversion.readers.mesh_reader import clean
from conversion.surface import Surface

SHEET = 2e-4  # thickness of flat patches while they grow; what stays flat gets more in the end
MAX_ROUNDING = 0.003  # hulls merge freely only where the vertex limit costs no more surface than this


def decompose(surface: Surface, budget: int, config: DecomposeConfig) -> list[ConvexShape]:
    """Convex hulls of one rigid group, at most `budget` of them. Handles are merged with handles only."""
    visuals = surface.visuals
    bars = [v for v in visuals if v.is_handle]
    # Fingers go between a handle and its board: what its hulls may fill is told from the handle alone, and finer.
    own = Surface(bars, finest=0.002) if bars else surface
    pieces: list[ConvexPiece] = []
    for visual in visuals:
        if len(visuals) == 1 or not surface.hidden(visual):
            pieces += _leaf(visual, own if visual.is_handle else surface, config)
    kept = _within(pieces, surface, own, budget, config)
    return [
        ConvexShape(vertices=few_vertices(thickened(p.points, config.thickness), config)[0], is_handle=p.is_handle)
        for p in kept
    ]


def merge_hulls(
    surface: Surface, hulls: Sequence[ConvexShape], budget: int, config: DecomposeConfig
) -> tuple[list[int], list[ConvexShape]]:
    """Hulls of several groups as at most `budget`: which of them stay as they are, and new ones for others.

    Those that nothing outside reaches are dropped.
    """
    pieces = [ConvexPiece.from_points(h.vertices, config.thickness / 2, h.is_handle) for h in hulls]
    number = {id(p): i for i, p in enumerate(pieces)}
    kept, new = [], []
    for piece in _within(pieces, surface, surface, budget, config):
        if id(piece) in number:
            kept.append(number[id(piece)])
        else:
            new.append(ConvexShape(vertices=few_vertices(piece.points, config)[0], is_handle=piece.is_handle))
    return sorted(kept), new


def _within(
    pieces: list[ConvexPiece], surface: Surface, of_handles: Surface, budget: int, config: DecomposeConfig
) -> list[ConvexPiece]:
    handles = [p for p in pieces if p.is_handle]
    others = _merge([p for p in pieces if not p.is_handle], surface, config.merge_tolerance, budget, config)
    room = max(4, budget // 2, budget - len(others))
    handles = _merge(handles, of_handles, config.handle_merge_tolerance, room, config)
    if len(others) + len(handles) > budget:
        others = _merge(others, surface, config.merge_tolerance, max(1, budget - len(handles)), config)
    return others + handles


def _leaf(visual: Visual, surface: Surface, config: DecomposeConfig) -> list[ConvexPiece]:
    """One visual as hulls: its own, those of its components, or those that its patches grow into."""
    tolerance = config.handle_tolerance if visual.is_handle else config.tolerance
    whole = ConvexPiece.from_points(visual.vertices, SHEET, visual.is_handle)
    if surface.worst(whole, 300, config) <= tolerance:
        return [whole]
    if config.decomposer == "coacd":
        return _coacd(visual, config)
    out = []
    for vertices, faces in _components(visual.vertices, visual.faces):
        piece = ConvexPiece.from_points(vertices, SHEET, visual.is_handle)
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
) -> list[ConvexPiece]:
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
        piece = ConvexPiece.from_points(vertices[np.unique(faces[rows])], SHEET, is_handle)
        if len(rows) == 1 or surface.worst(piece, 60, config) <= tolerance:
            out.append(piece)
        else:
            out += [ConvexPiece.from_points(vertices[face], SHEET, is_handle) for face in faces[rows]]
    return out


def _coacd(visual: Visual, config: DecomposeConfig) -> list[ConvexPiece]:
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
    return [ConvexPiece.from_points(np.asarray(v, np.float64), SHEET, visual.is_handle) for v, _ in parts if len(v)]


def _grow(pieces: list[ConvexPiece], surface: Surface, tolerance: float, config: DecomposeConfig) -> list[ConvexPiece]:
    """Merge neighbours while phantom stays below the tolerance, what makes the smallest piece first."""
    active = dict(enumerate(pieces))
    bounds = piece_bounds(pieces)
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
        merged = active[i].merged_with(active[j])
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


def _merge(
    pieces: list[ConvexPiece], surface: Surface, free: float, budget: int, config: DecomposeConfig
) -> list[ConvexPiece]:
    """Drop hulls that are inside others or out of reach, merge those that may, then the cheapest down to the budget."""
    kept: list[ConvexPiece] = []
    rest = sorted(pieces, key=lambda p: -p.volume)
    while rest:
        first, *rest = rest
        kept.append(first)
        inside = set(first.holds(rest, piece_bounds(rest)))
        rest = [p for k, p in enumerate(rest) if k not in inside]
    if len(kept) > 1:
        kept = [p for p in kept if surface.reachable(p)] or kept[:1]
    kept = _absorb(_grow(kept, surface, free, config), surface, 3 * budget, config)
    if len(kept) <= budget:
        return kept
    active = dict(enumerate(kept))
    heap: list[tuple[float, int, int, ConvexPiece]] = []

    def meet(i: int, others: list[int]) -> None:
        low, high = active[i].bounds
        apart = [np.maximum(active[j].bounds[0] - high, low - active[j].bounds[1]).max() for j in others]
        for k in np.argsort(apart, kind="stable")[:12].tolist():
            merged = active[i].merged_with(active[others[k]])
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
        for k in merged.holds(list(active.values()), piece_bounds(active.values())):
            del active[others[k]]
        others = list(active)
        active[number] = merged
        meet(number, others)
        number += 1
    return list(active.values())


def _absorb(pieces: list[ConvexPiece], surface: Surface, target: int, config: DecomposeConfig) -> list[ConvexPiece]:
    """Where there are far too many pieces for all pairs: the smallest joins the best of its six nearest."""
    pieces = sorted(pieces, key=_diagonal)
    while len(pieces) > target:
        small, rest = pieces[0], pieces[1:]
        apart = [
            np.maximum(0, np.maximum(small.bounds[0] - p.bounds[1], p.bounds[0] - small.bounds[1])).max() for p in rest
        ]
        near = np.argsort(apart, kind="stable")[:6].tolist()
        merged = {k: small.merged_with(rest[k]) for k in near}
        best = min(near, key=lambda k: surface.harm(merged[k], config.merge_tolerance))
        rest[best] = merged[best]
        rest.append(rest.pop(best))
        inside = set(merged[best].holds(rest[:-1], piece_bounds(rest[:-1])))
        pieces = sorted((p for k, p in enumerate(rest) if k not in inside), key=_diagonal)
    return pieces


def _diagonal(piece: ConvexPiece) -> float:
    low, high = piece.bounds
    return float(np.linalg.norm(high - low))
