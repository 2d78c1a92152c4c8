"""Closed meshes for the procedural objects, all made by lofting rings.

Frame: PartNet's mesh frame, x to the right of a person in front of the object, y up, z out of the front. Axes are
numbered 0, 1, 2. Unit lengths.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Mesh(NamedTuple):
    """Triangles wound outwards."""

    vertices: np.ndarray  # [n, 3] float64
    faces: np.ndarray  # [m, 3] int


class Rect(NamedTuple):
    """A rectangle in a plane of two axes: x and y, or for tabletops x and z."""

    x0: float
    y0: float
    x1: float
    y1: float

    @property
    def width(self) -> float:
        return self.x1 - self.x0

    @property
    def height(self) -> float:
        return self.y1 - self.y0

    @property
    def centre(self) -> np.ndarray:
        return np.array([(self.x0 + self.x1) / 2, (self.y0 + self.y1) / 2])

    def shrink(self, x: float, y: float | None = None) -> Rect:
        y = x if y is None else y
        return Rect(self.x0 + x, self.y0 + y, self.x1 - x, self.y1 - y)


def loft(rings: list[np.ndarray], closed: bool = False) -> Mesh:
    """Skin over rings [k, 3] of equal length; the ends are capped, or joined to each other where `closed`."""
    k, n = len(rings[0]), len(rings)
    a = (np.arange(n if closed else n - 1)[:, None] * k + np.arange(k)).ravel()
    b = a // k * k + (a + 1) % k
    above_a, above_b = (a + k) % (n * k), (b + k) % (n * k)
    faces = [np.stack([a, b, above_b], 1), np.stack([a, above_b, above_a], 1)]
    if not closed:
        fan = np.stack([np.zeros(k - 2, int), np.arange(2, k), np.arange(1, k - 1)], 1)
        faces += [fan, fan[:, ::-1] + (n - 1) * k]
    vertices, faces = np.concatenate(rings), np.concatenate(faces)
    tri = vertices[faces] - vertices.mean(0)
    if np.einsum("ij,ij->", tri[:, 0], np.cross(tri[:, 1], tri[:, 2])) < 0:
        faces = faces[:, ::-1]
    return Mesh(vertices, faces)


def ring_at(ring: np.ndarray, axis: int, at: float) -> np.ndarray:
    """A flat ring [k, 2] as points [k, 3] in the plane `axis` = `at`."""
    return np.insert(ring, axis, at, axis=1)


def corners(rect: Rect) -> np.ndarray:
    return np.array([[rect.x0, rect.y0], [rect.x1, rect.y0], [rect.x1, rect.y1], [rect.x0, rect.y1]])


def rounded(rect: Rect, radius: float, sides: int = 24, start: float = 0.5) -> np.ndarray:
    """Outline of a rectangle with round corners; an ellipse where the radius is half the sides. [sides, 2].

    start: where the first point lies, counted in points from the middle of the +x side.
    """
    t = 2 * np.pi * (np.arange(sides) + start) / sides
    half = np.array([rect.width, rect.height]) / 2
    bend = np.minimum(radius, half)
    unit = np.stack([np.cos(t), np.sin(t)], 1)
    return rect.centre + unit * bend + np.sign(unit) * (half - bend)


def circle(centre: np.ndarray, radius: float, sides: int = 16) -> np.ndarray:
    t = 2 * np.pi * np.arange(sides) / sides
    return np.asarray(centre) + radius * np.stack([np.cos(t), np.sin(t)], 1)


def prism(outline: np.ndarray, axis: int, lo: float, hi: float) -> Mesh:
    return loft([ring_at(outline, axis, lo), ring_at(outline, axis, hi)])


def box(lo: tuple | np.ndarray, hi: tuple | np.ndarray) -> Mesh:
    return prism(corners(Rect(lo[0], lo[1], hi[0], hi[1])), 2, lo[2], hi[2])


def board(r: Rect, z0: float, z1: float) -> Mesh:
    return box((r.x0, r.y0, z0), (r.x1, r.y1, z1))


def lathe(
    profile: list[tuple[float, float]], centre: np.ndarray, axis: int, closed: bool = False, sides: int = 20
) -> Mesh:
    """Revolve (radius, height) pairs about an axis through `centre` [3]; heights count from the centre.

    A closed profile is a tube's cross-section. The open kind needs radii above 0.
    """
    flat = np.delete(centre, axis)
    return loft([ring_at(circle(flat, r, sides), axis, centre[axis] + h) for r, h in profile], closed)


def rod(a: np.ndarray | list, b: np.ndarray | list, radius: float, sides: int = 10) -> Mesh:
    return sweep(np.array([a, b], float), radius, radius, sides)


def sweep(path: np.ndarray, across: float, deep: float, sides: int = 8) -> Mesh:
    """A tube of elliptic section (half widths across and along the path's plane) along a path [n, 3]."""
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    chord = path[-1] - path[0]
    bulge = path[len(path) // 2] - (path[0] + path[-1]) / 2
    normal = np.cross(chord, bulge)
    if np.linalg.norm(normal) < 1e-9:
        normal = np.cross(chord, np.eye(3)[np.argmin(np.abs(chord))])
    normal /= np.linalg.norm(normal)
    t = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    return loft(
        [
            p + across * np.cos(t)[:, None] * normal + deep * np.sin(t)[:, None] * np.cross(u, normal)
            for p, u in zip(path, tangent, strict=True)
        ]
    )


def plate(rect: Rect, hole: np.ndarray, axis: int, lo: float, hi: float) -> Mesh:
    """A rectangular plate with a hole; the hole's outline [k, 2], k a multiple of 8, starts on the +x side."""
    t = 2 * np.pi * np.arange(len(hole)) / len(hole)
    unit = np.stack([np.cos(t), np.sin(t)], 1)
    outline = rect.centre + unit / np.abs(unit).max(1, keepdims=True) * [rect.width / 2, rect.height / 2]
    return _pierced(outline, hole, axis, lo, hi)


def frame(rect: Rect, hole: Rect, axis: int, lo: float, hi: float) -> Mesh:
    """A rectangular plate with a rectangular hole."""
    return _pierced(corners(rect), corners(hole), axis, lo, hi)


def _pierced(outer: np.ndarray, inner: np.ndarray, axis: int, lo: float, hi: float) -> Mesh:
    return loft(
        [ring_at(outer, axis, lo), ring_at(outer, axis, hi), ring_at(inner, axis, hi), ring_at(inner, axis, lo)], True
    )


def hollow_block(
    rect: Rect, hole: Rect, lo: float, floor: float, hi: float, *, radius: float = 0.0, axis: int = 2
) -> Mesh:
    """A block from lo to hi along an axis, with a pocket that is open at hi and reaches to floor.

    rect, hole: outlines in the other two axes. lo may be above hi: the pocket is then open downwards. radius: of the
    outer edges.
    """
    outer = rounded(rect, radius) if radius else corners(rect)
    inner = rounded(hole, 0.004) if radius else corners(hole)
    return loft([ring_at(ring, axis, at) for ring, at in ((outer, lo), (outer, hi), (inner, hi), (inner, floor))])
