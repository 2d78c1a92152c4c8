"""Boxes with hinged lids: shoe boxes, chests, toolboxes, cartons, cases and chest freezers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjcf_assets.procedural.components import (
    Joint,
    Link,
    Style,
    face_up,
    handle,
    legs,
    sample_size,
    weighted_choice,
)
from mjcf_assets.procedural.solids import Mesh, Rect, box, corners, hollow_block, prism

KINDS = {"shoe box": 2, "chest": 2.5, "toolbox": 2, "carton": 2.5, "case": 1.5, "freezer": 1.5}
# Ranges of width, height without the lid, and depth by kind, in proportion to each other.
SIZES = {
    "shoe box": ((1.2, 2.0), (0.5, 0.9), (0.8, 1.2)),
    "chest": ((1.2, 2.0), (0.6, 1.0), (0.8, 1.1)),
    "toolbox": ((1.5, 2.4), (0.6, 1.0), (0.7, 1.1)),
    "carton": ((0.8, 1.6), (0.5, 1.3), (0.8, 1.3)),
    "case": ((1.1, 1.8), (0.2, 0.5), (0.8, 1.2)),
    "freezer": ((0.9, 2.0), (1, 1), (0.6, 0.9)),
}
# Ranges of the thickness of walls and lids.
WALLS = {
    "shoe box": (0.006, 0.02),
    "chest": (0.02, 0.06),
    "toolbox": (0.01, 0.03),
    "carton": (0.005, 0.02),
    "case": (0.01, 0.03),
    "freezer": (0.05, 0.1),
}
HANDLES = {"bar": 3, "rail": 1, "arc": 2, "knob": 2, "lip": 3, "none": 4}
# How lids share a box: one, two side by side, or two that meet in the middle, hinged at the back and at the front.
LAYOUTS = {"carton": {"one": 3, "beside": 2, "meeting": 3}, "freezer": {"one": 3, "beside": 2}}
CLEARANCE = 0.002  # between the rim and what lies on it


class Lid(NamedTuple):
    """The shape of one lid, closed."""

    meshes: list[Mesh]
    rect: Rect  # what it covers in x and z
    top: float  # y of its upper side
    front: float  # height of its front
    grip: tuple[float, float]  # y and z where a handle on its front begins


def lidded_box(rng: np.random.Generator) -> list[Link]:
    """A box with one lid hinged at its back edge, or two: side by side, or meeting in the middle as flaps do.

    Lids are closed at q = 0 and open upwards by 90 to 135 degrees. Of two flaps that meet, one is hinged at the front
    edge.
    """
    style = Style.sample(rng, HANDLES, {"slab": 1})
    kind = weighted_choice(rng, KINDS)
    w, h, d = sample_size(rng, *SIZES[kind])
    wall = rng.uniform(*WALLS[kind])
    # Rounder, and the pocket's corners would come through the walls.
    radius = wall * float(rng.choice([0, 2, 3])) if kind in ("toolbox", "case") else 0.0
    low = rng.uniform(0.03, 0.12) if kind in ("chest", "freezer") and rng.random() < 0.5 else 0.0
    footprint = Rect(0, 0, w, d)
    body = _body(rng, footprint, low=low, rim=h, wall=wall, radius=radius)
    layout = weighted_choice(rng, LAYOUTS.get(kind, {"one": 1}))
    arched = kind == "chest" and rng.random() < 0.5
    lids = []
    for rect, at_back in _lid_rects(rng, style, footprint, layout):
        if arched:
            lid = _arched_lid(rng, rect, rim=h, wall=wall)
        elif kind == "shoe box":
            lid = _cap(rng, rect, rim=h, wall=wall)
        elif kind in ("toolbox", "case"):
            lid = _hollow_lid(rng, rect, rim=h, wall=wall, radius=radius)
        else:
            lid = _flat_lid(rng, rect, layout, rim=h, wall=wall)
        swing = float(np.radians(rng.choice([90, 100, 110, 120, 135])))
        hinge = np.array([rect.centre[0], h + CLEARANCE, rect.y0 if at_back else rect.y1])
        link = Link("hinge rotation_lid", "rotation_lid", body)
        link.joint = Joint(hinge, np.array([-1.0 if at_back else 1.0, 0, 0]), swing)
        link.add("lid", *lid.meshes)
        if style.handle != "none":
            # A lip needs little height; other handles would reach down over the body from the front of a thin lid.
            high = arched or style.handle == "lip" or (lid.front > 2.2 * style.thick and rng.random() < 0.7)
            upwards = layout == "meeting" or not high
            link.add("handle", *_lid_handle(rng, style, lid, at_back=at_back, upwards=upwards))
        lids.append(link)
    return [*lids, body]


def _body(rng: np.random.Generator, footprint: Rect, *, low: float, rim: float, wall: float, radius: float) -> Link:
    """An open box from y = low to the rim, on legs where low is above 0, some of them divided."""
    body = Link("free box_body", "base_body")
    inside, floor = footprint.shrink(wall), low + wall
    body.add("base_body", hollow_block(footprint, inside, low, floor, rim, radius=radius, axis=1))
    if low:
        shape = str(rng.choice(["square", "tapered", "round"]))
        body.add("foot", *legs(rng, shape, footprint, 0, low, rng.uniform(0.05, 0.1)))
    if rng.random() < 0.25:
        x = footprint.x0 + footprint.width * rng.uniform(0.35, 0.65)
        top = floor + (rim - floor) * rng.uniform(0.4, 0.9)
        body.add("other_leaf", box((x - 0.008, floor, inside.y0), (x + 0.008, top, inside.y1)))
    return body


def _lid_rects(rng: np.random.Generator, style: Style, rect: Rect, layout: str) -> list[tuple[Rect, bool]]:
    """The rectangles of x and z that the lids cover, each with whether it is hinged at the back.

    layout: one of those in LAYOUTS.
    """
    if layout == "one":
        return [(rect, True)]
    cut = 0.5 if rng.random() < 0.6 else rng.uniform(0.4, 0.6)
    if layout == "beside":
        x = rect.x0 + cut * rect.width
        return [(rect._replace(x1=x - style.gap / 2), True), (rect._replace(x0=x + style.gap / 2), True)]
    z = rect.y0 + cut * rect.height
    return [(rect._replace(y1=z - style.gap / 2), True), (rect._replace(y0=z + style.gap / 2), False)]


def _flat_lid(rng: np.random.Generator, rect: Rect, layout: str, *, rim: float, wall: float) -> Lid:
    """A board on the rim; it may hang over the body's front and sides, but not where it would turn into the body."""
    over = rng.uniform(0.01, 0.07) if rng.random() < 0.6 else 0.0
    if layout == "one":
        rect = Rect(rect.x0 - over, rect.y0, rect.x1 + over, rect.y1 + over)
    elif layout == "beside":
        rect = rect._replace(y1=rect.y1 + over)
    bottom = rim + CLEARANCE
    top = bottom + wall * rng.uniform(0.8, 1.4)
    return Lid([prism(corners(rect), 1, bottom, top)], rect, top, top - bottom, ((bottom + top) / 2, rect.y1))


def _cap(rng: np.random.Generator, rect: Rect, *, rim: float, wall: float) -> Lid:
    """A board with a skirt that reaches down over the body's front and sides."""
    bottom, room = rim * (1 - rng.uniform(0.15, 0.6)), rng.uniform(0.003, 0.01)
    under, top = rim + CLEARANCE, rim + CLEARANCE + wall
    inner = Rect(rect.x0 - room, rect.y0, rect.x1 + room, rect.y1 + room)
    outer = Rect(inner.x0 - wall, inner.y0, inner.x1 + wall, inner.y1 + wall)
    meshes = [
        box((outer.x0, under, outer.y0), (outer.x1, top, outer.y1)),
        box((outer.x0, bottom, outer.y0), (inner.x0, under, outer.y1)),
        box((inner.x1, bottom, outer.y0), (outer.x1, under, outer.y1)),
        box((inner.x0, bottom, inner.y1), (inner.x1, under, outer.y1)),
    ]
    return Lid(meshes, outer, top, top - bottom, (bottom + (top - bottom) * rng.uniform(0.35, 0.65), outer.y1))


def _hollow_lid(rng: np.random.Generator, rect: Rect, *, rim: float, wall: float, radius: float) -> Lid:
    """A second box, upside down."""
    bottom = rim + CLEARANCE
    top = bottom + max(rim * rng.uniform(0.2, 0.9), 2.5 * wall)
    mesh = hollow_block(rect, rect.shrink(wall), top, top - wall, bottom, radius=radius, axis=1)
    return Lid([mesh], rect, top, top - bottom, (bottom + (top - bottom) * rng.uniform(0.35, 0.65), rect.y1))


def _arched_lid(rng: np.random.Generator, rect: Rect, *, rim: float, wall: float) -> Lid:
    """Staves along x that arch from the back edge to the front edge, closed by a board at either end."""
    bottom, middle, half = rim + CLEARANCE, rect.centre[1], rect.height / 2
    rise = max(half * rng.uniform(0.35, 0.9), 2.5 * wall)
    angle = np.linspace(0, np.pi, 2 * int(rng.integers(3, 7)) + 1)
    arc = np.stack([np.sin(angle), -np.cos(angle)], 1)
    outside = arc * [rise, half] + [bottom, middle]  # y, z
    inside = arc * [rise - wall, half - wall] + [bottom, middle]
    staves = [
        prism(np.array([outside[i], outside[i + 1], inside[i + 1], inside[i]]), 0, rect.x0, rect.x1)
        for i in range(len(angle) - 1)
    ]
    ends = [prism(inside, 0, x, x + wall) for x in (rect.x0, rect.x1 - wall)]
    front = outside[len(angle) // 2 :][::-1]
    y = bottom + max(0.3 * rise, 0.07)  # as high as the widest handle reaches down
    return Lid([*staves, *ends], rect, bottom + rise, rise, (y, float(np.interp(y, front[:, 0], front[:, 1]))))


def _lid_handle(rng: np.random.Generator, style: Style, lid: Lid, *, at_back: bool, upwards: bool) -> list[Mesh]:
    """A handle near the edge of a lid that opens: standing on its upper side, or before its front.

    at_back: the lid's hinge is at its back edge.
    """
    rect = lid.rect
    x = rect.centre[0] + rect.width * rng.choice([0.0, 0.0, 0.0, -0.2, 0.2])
    span = min(max(style.length * rect.width, 0.06), 0.55 * rect.width)
    if not upwards:
        return handle(rng, style, np.array([x, *lid.grip]), span, False)
    margin = min(0.3 * rect.height, style.thick + rng.uniform(0.02, 0.08))
    z = rect.y1 - margin if at_back else rect.y0 + margin
    return face_up(handle(rng, style, np.zeros(3), span, False), np.array([x, lid.top, z]))
