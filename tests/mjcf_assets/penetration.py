"""How deep one part of an object reaches into another."""

from __future__ import annotations

import numpy as np
import trimesh

from mjcf_assets.procedural.solids import Mesh


def posed(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Points [n, 3] moved by a pose [4, 4]."""
    return points @ pose[:3, :3].T + pose[:3, 3]


def penetration_depth(points: np.ndarray, mesh: Mesh) -> float:
    """How far the deepest of the points [n, 3] lies inside a mesh."""
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    near = points[((points > solid.bounds[0]) & (points < solid.bounds[1])).all(1)]
    inside = near[solid.contains(near)] if len(near) else near
    return trimesh.proximity.closest_point(solid, inside)[1].max() if len(inside) else 0.0
