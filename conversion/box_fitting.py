"""Oriented boxes in place of convex hulls: all boxes share one collision kernel, which MJX is fast with."""

from __future__ import annotations

import heapq
from collections.abc import Sequence

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from conversion.config import DecomposeConfig
from conversion.model import ConvexShape
from conversion.surface import Surface

# Corners in units of the half extents, and the 12 triangles between them.
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
_FACES = ConvexHull(CORNERS).simplices


def fit_boxes(surface: Surface, hulls: Sequence[ConvexShape], limit: int, config: DecomposeConfig) -> list[ConvexShape]:
    """A box around each hull, where it reaches too far into free space around each of its halves, and so on.

    Ends when all boxes are within the tolerance, or there are `limit` of them.
    """
    queue: list[tuple[float, int, np.ndarray, ConvexShape]] = []
    count = 0

    def add(points: np.ndarray, is_handle: bool) -> None:
        nonlocal count
        box = fit_box(points, is_handle, config.thickness)
        tolerance = config.handle_tolerance if is_handle else config.tolerance
        samples, _ = surface.sample(box.vertices[_FACES], 200)
        excess = float(surface.phantom(samples).max()) / tolerance
        if box.box_size is not None and box.box_size.max() < tolerance:
            excess = 0.0  # too small to matter
        heapq.heappush(queue, (-excess, count, points, box))
        count += 1

    for hull in hulls:
        add(hull.vertices, hull.is_handle)
    while queue and -queue[0][0] > 1 and len(queue) < limit:
        _, _, points, box = heapq.heappop(queue)
        for half in _halves(points, box):
            add(half, box.is_handle)
    return [entry[3] for entry in sorted(queue, key=lambda entry: entry[1])]


def fit_box(points: np.ndarray, is_handle: bool, thickness: float) -> ConvexShape:
    """The smallest box around points [n, 3] that has a side in a face of their hull."""
    try:
        hull = ConvexHull(points)
        normals = np.unique(np.round(hull.equations[:, :3], 3), axis=0)
        points = points[hull.vertices]
    except QhullError:
        normals = np.zeros((0, 3))
    # Rounded hulls have a face for every direction; the axes of the link and these will do.
    normals = np.concatenate([np.eye(3), normals[:: max(1, len(normals) // 24)]])
    best, frame = np.inf, np.eye(3)
    for normal in normals[(normals @ normals.T).diagonal() > 0.5]:
        plane = np.linalg.svd(normal[None])[2]
        flat = points @ plane[1:].T
        try:
            ring = flat[ConvexHull(flat).vertices]
        except QhullError:
            ring = flat
        edges = np.roll(ring, -1, axis=0) - ring
        angles = np.unique(np.round(np.arctan2(edges[:, 1], edges[:, 0]) % (np.pi / 2), 4))
        c, s = np.cos(angles), np.sin(angles)
        turn = np.stack([np.stack([c, s], -1), np.stack([-s, c], -1)], axis=1)  # [k, 2, 2]
        extent = np.ptp(np.einsum("kij,nj->kni", turn, ring), axis=1)
        height = max(float(np.ptp(points @ plane[0])), thickness)
        volume = np.maximum(extent, thickness).prod(axis=1) * height
        k = int(volume.argmin())
        if volume[k] < best * (1 - 1e-6):
            best, frame = float(volume[k]), np.concatenate([plane[:1], turn[k] @ plane[1:]])
    if np.linalg.det(frame) < 0:
        frame[2] *= -1
    low, high = (points @ frame.T).min(axis=0), (points @ frame.T).max(axis=0)
    size = np.maximum((high - low) / 2, thickness / 2)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = frame.T, (low + high) / 2 @ frame
    corners = (CORNERS * size) @ frame + pose[:3, 3]
    return ConvexShape(vertices=corners, is_handle=is_handle, box_pose=pose, box_size=size)


def _halves(points: np.ndarray, box: ConvexShape) -> list[np.ndarray]:
    """Convex points cut through the middle of their box, across its longest side."""
    assert box.box_pose is not None and box.box_size is not None
    k = int(box.box_size.argmax())
    s = (points - box.box_pose[:3, 3]) @ box.box_pose[:3, k]
    try:
        simplices = ConvexHull(points).simplices
        edges = np.concatenate([simplices[:, :2], simplices[:, 1:], simplices[:, ::2]])
    except QhullError:
        edges = np.stack(np.triu_indices(len(points), 1), axis=1)
    i, j = edges[s[edges[:, 0]] * s[edges[:, 1]] < 0].T
    crossing = points[i] + (s[i] / (s[i] - s[j]))[:, None] * (points[j] - points[i])
    return [np.concatenate([points[s <= 0], crossing]), np.concatenate([points[s >= 0], crossing])]
