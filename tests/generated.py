"""Converted objects for tests, quickly: one hull per visual, whatever it swallows."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from conversion.partnet import ConvertedObject, Hull, Joint, Link, PartNetObject, Visual, parts, read_object


def with_hulls(obj: PartNetObject, split: str = "train") -> ConvertedObject:
    found, left_out = parts(obj)
    return ConvertedObject(
        obj, {g: [_hull(v) for v in obj.group_visuals(g)] for g in obj.groups}, found, left_out, split
    )


def _hull(visual: Visual) -> Hull:
    """Two flat visuals' worth of thickness, so that sheets have a hull."""
    v = visual.vertices
    return Hull(np.concatenate([v - 1e-4, v + 1e-4]), visual.is_handle)


def read_with_hulls(folder: Path) -> ConvertedObject:
    return with_hulls(read_object(folder))


def box(name: str, low: tuple, high: tuple) -> Visual:
    """A closed box."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    return Visual(name, np.array(low) + corners * (np.array(high) - np.array(low)), faces, "handle" in name, None)


def made(name: str, links: dict[str, list[Visual]], joints: list[Joint]) -> ConvertedObject:
    """An object from hand-made links; the first one is the root."""
    obj = PartNetObject(
        name, "Test", Path(name), {k: Link(k, "", tuple(v)) for k, v in links.items()}, {j.child: j for j in joints}
    )
    return with_hulls(obj)


def joint(child: str, kind: str, axis: tuple, lower: float, upper: float, at: tuple = (0, 0, 0)) -> Joint:
    origin = np.eye(4)
    origin[:3, 3] = at
    return Joint(f"joint_{child}", kind, "base", child, origin, np.array(axis, float), lower, upper)
