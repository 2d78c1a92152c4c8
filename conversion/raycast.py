"""Rays against loose triangles, by Embree."""

from __future__ import annotations

import numpy as np
import trimesh
from trimesh.ray.ray_pyembree import RayMeshIntersector


def _embree(triangles: np.ndarray) -> RayMeshIntersector:
    faces = np.arange(3 * len(triangles)).reshape(-1, 3)
    return RayMeshIntersector(trimesh.Trimesh(triangles.reshape(-1, 3), faces, process=False))


def first_triangle(triangles: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Index [n] of the first triangle [m, 3, 3] that each ray meets, -1 where it meets none. Single precision.

    origins, directions: [n, 3], or [3] for all rays.
    """
    shape = np.broadcast_shapes(origins.shape, directions.shape)
    if not len(triangles):
        return np.full(shape[0], -1)
    origins, directions = np.broadcast_to(origins, shape), np.broadcast_to(directions, shape)
    return np.asarray(_embree(triangles).intersects_first(origins, directions))


def meets_any(triangles: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Which rays [n] meet any of the triangles [m, 3, 3]."""
    if not (len(triangles) and len(origins)):
        return np.zeros(len(origins), bool)
    return np.asarray(_embree(triangles).intersects_any(origins, directions))
