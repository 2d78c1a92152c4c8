"""Room for a finger behind handles: what a gripper needs to pull, and what hulls swallow first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull

from conversion.model import ArticulatedObject, ConvexShape, Part, Visual
from conversion.raycast import first_triangle

FINGER = 0.012  # thickness and width of the finger that must pass, unit lengths
SPACING = 0.003  # of the rays


@dataclass(frozen=True, kw_only=True)
class Handle:
    link: str
    name: str  # of its first visual
    clear_in_mesh: bool  # a finger passes behind it in the visual mesh
    clear_in_hulls: bool  # and behind its hulls


def check_finger_clearance(obj: ArticulatedObject, part: Part, hulls: Sequence[ConvexShape]) -> list[Handle]:
    """Every handle of a moving part with these hulls. Bars only count where a finger passes across them."""
    out = []
    visuals = obj.group_visuals(part.link)
    seen = _triangles([v for v in visuals if not v.is_handle])
    solid = {k: [h.vertices for h in hulls if h.is_handle == k] for k in (False, True)}
    for group in _clusters([v for v in visuals if v.is_handle]):
        bar = _triangles(group)
        behind = _behind(obj, part, bar, seen)
        low, high = bar.reshape(-1, 3).min(axis=0) - 0.01, bar.reshape(-1, 3).max(axis=0) + 0.01
        own = [h for h in solid[True] if ((h.max(axis=0) >= low) & (h.min(axis=0) <= high)).all()]
        in_mesh = finger_passes(bar, bar, seen, behind)
        in_hulls = in_mesh and finger_passes(bar, _surface(own), _surface(solid[False]), behind)
        out.append(Handle(link=part.link, name=group[0].name, clear_in_mesh=in_mesh, clear_in_hulls=in_hulls))
    return out


def finger_passes(bar: np.ndarray, handle: np.ndarray, rest: np.ndarray, behind: np.ndarray) -> bool:
    """Whether a finger passes between a handle and what it is mounted on, across the handle's longer side.

    bar: triangles [m, 3, 3] of the handle's visual, which say where to look. handle, rest: triangles of the handle and
    of what it is mounted on. behind: unit direction from the handle to that.
    """
    if not len(handle):
        return False
    points = bar.reshape(-1, 3)
    plane = np.linalg.svd(behind[None])[2][1:]
    flat = (points - points.mean(axis=0)) @ plane.T
    along, across = np.linalg.svd(flat, full_matrices=False)[2] @ plane
    u, w, depth = points @ along, points @ across, points @ behind
    us = np.arange(u.min(), u.max(), SPACING)
    ws = np.arange(w.min() - FINGER, w.max() + FINGER, SPACING)
    if len(us) * SPACING < FINGER:
        return False
    grid = us[:, None, None] * along + ws[None, :, None] * across
    before, after = depth.min() - 0.1, depth.max() + 0.5
    back = after - _first(handle, grid + after * behind, -behind)  # depth of the handle's back side, -inf beside it
    front = before + _first(rest, grid + before * behind, behind)  # depth of the first thing that is not the handle
    n = round(FINGER / SPACING)
    for i in range(len(us) - n + 1):
        strip = slice(i, i + n + 1)
        deepest = back[strip].max()
        if np.isfinite(deepest) and (front[strip] >= deepest + FINGER).all():
            return True
    return False


def _first(triangles: np.ndarray, origins: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Distance to the first triangle along parallel rays; origins [..., 3], inf where there is none."""
    shape, origins = origins.shape[:-1], origins.reshape(-1, 3)
    out = np.full(len(origins), np.inf)
    if len(triangles):
        hit = first_triangle(triangles, origins, direction)
        rows = hit >= 0
        a, b, c = triangles[hit[rows]].transpose(1, 0, 2)
        normal = np.cross(b - a, c - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = ((a - origins[rows]) * normal).sum(axis=1) / (normal @ direction)
        out[rows] = np.nan_to_num(t, nan=np.inf)
    return out.reshape(shape)


def _behind(obj: ArticulatedObject, part: Part, bar: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Direction, link frame, from a handle to its part."""
    axis = obj.joints[part.link].axis
    if obj.joints[part.link].type == "prismatic":
        return -part.sign * axis
    centre = bar.reshape(-1, 3).mean(axis=0)
    middle = rest.reshape(-1, 3).mean(axis=0) if len(rest) else centre
    normal = np.cross(axis, middle)  # of the board: the hinge passes through the link frame's origin
    if np.linalg.norm(normal) < 1e-9:
        return axis
    normal /= np.linalg.norm(normal)
    return normal if (middle - centre) @ normal > 0 else -normal


def _clusters(visuals: Sequence[Visual]) -> list[list[Visual]]:
    """Visuals that touch, or nearly: one handle is often a bar and two posts."""
    if not visuals:
        return []
    low = np.array([v.vertices.min(axis=0) for v in visuals])
    high = np.array([v.vertices.max(axis=0) for v in visuals])
    near = ((low[:, None] <= high[None] + 0.01) & (high[:, None] >= low[None] - 0.01)).all(axis=2)
    count, label = connected_components(near, directed=False)
    return [[v for v, k in zip(visuals, label, strict=True) if k == c] for c in range(count)]


def _triangles(visuals: Sequence[Visual]) -> np.ndarray:
    return np.concatenate([np.zeros((0, 3, 3)), *[v.vertices[v.faces] for v in visuals]])


def _surface(hulls: Sequence[np.ndarray]) -> np.ndarray:
    return np.concatenate([np.zeros((0, 3, 3)), *[points[ConvexHull(points).simplices] for points in hulls]])
