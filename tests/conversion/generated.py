"""Converted objects for tests, quickly: one hull per visual, whatever it swallows."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from conversion.model import ArticulatedObject, ConvertedObject, ConvexShape, Joint, Link, Visual
from conversion.part_detection import detect_parts
from conversion.readers import read_object


def with_hulls(obj: ArticulatedObject, split: str = "train") -> ConvertedObject:
    parts, left_out = detect_parts(obj)
    hulls = {g: [_hull(v) for v in obj.group_visuals(g)] for g in obj.groups}
    return ConvertedObject(obj=obj, hulls=hulls, parts=parts, left_out=left_out, split=split)


def _hull(visual: Visual) -> ConvexShape:
    """Two flat visuals' worth of thickness, so that sheets have a hull."""
    v = visual.vertices
    return ConvexShape(vertices=np.concatenate([v - 1e-4, v + 1e-4]), is_handle=visual.is_handle)


def read_with_hulls(folder: Path) -> ConvertedObject:
    return with_hulls(read_object(folder))


def box(name: str, low: tuple, high: tuple) -> Visual:
    """A closed box."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    vertices = np.array(low) + corners * (np.array(high) - np.array(low))
    return Visual(name=name, vertices=vertices, faces=faces, is_handle="handle" in name, file=None)


def made(
    name: str,
    links: dict[str, list[Visual]],
    joints: list[Joint],
    category: str = "Test",
    semantics: dict[str, str] | None = None,
) -> ConvertedObject:
    """An object from hand-made links; the first one is the root."""
    obj = ArticulatedObject(
        id=name,
        category=category,
        folder=Path(name),
        links={k: Link(name=k, semantics=(semantics or {}).get(k, ""), visuals=tuple(v)) for k, v in links.items()},
        joints={j.child: j for j in joints},
    )
    return with_hulls(obj)


def joint(child: str, kind: str, axis: tuple, lower: float, upper: float, at: tuple = (0, 0, 0)) -> Joint:
    origin = np.eye(4)
    origin[:3, 3] = at
    return Joint(
        name=f"joint_{child}",
        type=kind,
        parent="base",
        child=child,
        origin=origin,
        axis=np.array(axis, float),
        lower=lower,
        upper=upper,
    )
