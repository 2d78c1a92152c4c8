"""How faithful hulls are to the visual surface: *gap* (surface outside all hulls) and *phantom* (hull surface in free
space, its distance from the visual surface)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from conversion.convex_piece import ConvexPiece, areas
from conversion.model import ConvexShape
from conversion.surface import Surface


@dataclass(frozen=True, kw_only=True)
class Fidelity:
    """How hulls match the visual surface of one group; only surface that can be reached from outside counts."""

    gap_p95: float  # visual surface outside the hulls: how far
    gap_max: float
    phantom_p95: float  # hull surface in free space: how far from the visual surface
    phantom_max: float
    phantom_share: float  # share of the hull surface that lies farther than 0.02 from it


def measure_fidelity(surface: Surface, hulls: Sequence[ConvexShape]) -> Fidelity:
    """Gap and phantom of the hulls of one group, by samples of their own."""
    pieces = [ConvexPiece.from_points(h.vertices, 1e-6) for h in hulls]
    points, _ = surface.sample(surface.triangles, 20_000)
    points = points[surface.layers(points) <= 2]
    gap = np.full(len(points), np.inf)
    for piece in pieces:
        gap = np.minimum(gap, piece.outside(points))
    gap = np.maximum(gap, 0) if len(gap) else np.zeros(1)
    area = np.array([areas(p.triangles).sum() for p in pieces])
    outer = []
    for i, piece in enumerate(pieces):
        on, _ = surface.sample(piece.triangles, int(np.clip(12_000 * area[i] / area.sum(), 60, 6000)))
        for k, other in enumerate(pieces):
            if k != i and (other.bounds[0] < piece.bounds[1]).all() and (other.bounds[1] > piece.bounds[0]).all():
                on = on[other.outside(on) > -1e-4]
        outer.append(on)
    on = np.concatenate(outer) if outer else np.zeros((0, 3))
    on = on[surface.layers(on) <= 2]
    phantom = surface.phantom(on) if len(on) else np.zeros(1)
    return Fidelity(
        gap_p95=float(np.percentile(gap, 95)),
        gap_max=float(gap.max()),
        phantom_p95=float(np.percentile(phantom, 95)),
        phantom_max=float(phantom.max()),
        phantom_share=float((phantom > 0.02).mean()),
    )
