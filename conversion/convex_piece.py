"""Convex hulls while they grow and merge."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from conversion.config import DecomposeConfig


@dataclass(frozen=True, kw_only=True)
class ConvexPiece:
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
    def from_points(cls, points: np.ndarray, thickness: float, is_handle: bool = False) -> ConvexPiece:
        """Convex hull of points, padded where they are flat."""
        return cls._hull(thickened(points, thickness), is_handle)

    @classmethod
    def _hull(cls, points: np.ndarray, is_handle: bool) -> ConvexPiece:
        try:
            hull = ConvexHull(points)
        except QhullError:  # rounding can still leave a sliver that Qhull calls flat
            hull = ConvexHull(points, qhull_options="QJ")
        return cls(
            points=points[hull.vertices],
            triangles=points[hull.simplices],
            volume=float(hull.volume),
            is_handle=is_handle,
        )

    def outside(self, points: np.ndarray) -> np.ndarray:
        """Signed distance [n] to the planes: above 0 outside (a lower bound there), below 0 inside."""
        return (points @ self.planes[:, :3].T + self.planes[:, 3]).max(axis=1)

    def merged_with(self, other: ConvexPiece) -> ConvexPiece:
        return ConvexPiece._hull(np.concatenate([self.points, other.points]), self.is_handle)

    def rounding(self, config: DecomposeConfig) -> float:
        """How far vertices stick out of the hull of as many as are allowed."""
        return few_vertices(self.points, config)[1] if len(self.points) > config.max_vertices else 0.0

    def holds(self, others: Sequence[ConvexPiece], bounds: np.ndarray, slack: float = 0.001) -> list[int]:
        """Which of the others, with bounds [n, 2, 3], lie inside this one."""
        low, high = self.bounds
        within = (bounds[:, 0] >= low - slack).all(axis=1) & (bounds[:, 1] <= high + slack).all(axis=1)
        return [k for k in np.flatnonzero(within).tolist() if self.outside(others[k].points).max() <= slack]


def thickened(points: np.ndarray, thickness: float) -> np.ndarray:
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


def few_vertices(points: np.ndarray, config: DecomposeConfig) -> tuple[np.ndarray, float]:
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


def piece_bounds(pieces: Iterable[ConvexPiece]) -> np.ndarray:
    """Lower and upper corners [n, 2, 3]."""
    return np.array([p.bounds for p in pieces]).reshape(-1, 2, 3)


def areas(triangles: np.ndarray) -> np.ndarray:
    """[m] of triangles [m, 3, 3]."""
    u, v = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    uu, vv, uv = (np.einsum("ij,ij->i", x, y) for x, y in ((u, u), (v, v), (u, v)))
    return np.sqrt(np.maximum(uu * vv - uv**2, 0)) / 2
