"""Refrigerators and microwaves."""

from __future__ import annotations

import numpy as np

from mjcf_assets.procedural.components import (
    Joint,
    Link,
    Style,
    button,
    carcass,
    door,
    knob,
    legs,
    porthole,
    sample_size,
    set_semantics,
    weighted_choice,
)
from mjcf_assets.procedural.solids import Rect, board, frame, hollow_block, lathe, rod

# Ranges of width, height and depth by kind, in proportion to each other.
REFRIGERATOR_SIZES = {
    "single": ((0.45, 0.95), (1, 1), (0.45, 0.9)),
    "two": ((0.36, 0.5), (1, 1), (0.3, 0.45)),
    "side": ((0.5, 0.75), (1, 1), (0.35, 0.5)),
    "french": ((0.5, 0.65), (1, 1), (0.35, 0.45)),
    "wide": ((1.0, 1.4), (1, 1), (0.4, 0.6)),
}


def refrigerator(rng: np.random.Generator) -> list[Link]:
    """A refrigerator with one to three doors, or with a freezer of its own door or doors above or below."""
    handles = {"bar": 3, "rail": 2, "arc": 2, "lip": 0.7, "knob": 0.2, "none": 6}
    style = Style.sample(rng, handles, {"slab": 5, "shaker": 0.7, "glass": 1})
    style.inset, style.front = False, style.sheet or rng.uniform(0.04, 0.12)
    style.swing = float(np.radians(rng.choice([90, 120, 160, 180])))
    kind = weighted_choice(rng, {"single": 3, "two": 3, "side": 2, "french": 1.5, "wide": 0.7})
    w, h, d = sample_size(rng, *REFRIGERATOR_SIZES[kind])
    d -= style.front
    wall, low = rng.uniform(0.04, 0.08), rng.uniform(0.02, 0.08)
    body = Link("heavy refrigerator_body", "body")
    cut = h * rng.uniform(0.28, 0.42)
    split = low + (cut if rng.random() < 0.5 else h - low - cut)
    rows = [(low, h)] if kind in ("single", "side", "wide") else [(low, split), (split, h)]
    boxes = rng.random() < 0.4
    links = []
    radius = rng.choice([0.0, 0.06])
    for y0, y1 in rows:
        r = Rect(0, y0, w, y1)
        hole = r.shrink(wall)
        if boxes:
            carcass(body, r, 0, d, wall)
        else:
            body.add("frame", hollow_block(r, hole, 0, wall, d, radius=radius))
        n = int(rng.integers(0, 2 + int(hole.height / 0.3)))
        for y in np.linspace(hole.y0, hole.y1, n + 2)[1:-1]:
            shelf = hole._replace(y0=y - 0.008, y1=y + 0.008)
            depth = (d - wall) * rng.uniform(0.6, 0.8)
            if rng.random() < 0.5:
                body.add("shelf", board(shelf, wall, wall + depth))
            else:
                bars = [rod([x, y, wall], [x, y, wall + depth], 0.006, 6) for x in np.linspace(hole.x0, hole.x1, 9)]
                cross = [rod([hole.x0, y, z], [hole.x1, y, z], 0.008, 6) for z in (wall + 0.02, wall + depth)]
                body.add("shelf", *bars, *cross)
        n = {"side": 2, "wide": int(rng.integers(2, 4))}.get(kind, 2 if kind == "french" and y1 == h else 1)
        side = str(rng.choice(["left", "right"]))
        for k in range(n):
            front = Rect(w * k / n, y0, w * (k + 1) / n, y1).shrink(style.gap / 2)
            hinged = side if n == 1 else "left" if k == 0 else "right"
            outer = n < 3 or k != 1
            link = door(rng, style, body, front, z=d, side=hinged, outer=outer, leaf="door_frame")
            set_semantics(link, "hinge door", "door")
            if outer and rng.random() < 0.4 and front.width > 0.3:
                # Narrow enough to pass the wall on the free side as the door swings.
                bin_depth, inner = rng.uniform(0.05, 0.1), front.shrink(wall + 0.04, wall + 0.03)
                for y in np.linspace(inner.y0, inner.y1, int(rng.integers(2, 5)))[:-1]:
                    bin_ = inner._replace(y0=y, y1=min(y + rng.uniform(0.06, 0.12), inner.y1))
                    link.add("other_leaf", board(bin_, d - bin_depth, d))
            links.append(link)
    if kind == "wide" or rng.random() < 0.5:
        body.add("foot", *legs(rng, "round", Rect(0, 0, w, d), 0, low, 0.05))
    else:
        body.add("foot", board(Rect(0.01, 0, w - 0.01, low), 0.01, d - 0.03))
    return [*links, body]


def microwave(rng: np.random.Generator) -> list[Link]:
    """A microwave that opens to the left, or an oven that drops its door, with knobs or buttons beside it."""
    handles = {"bar": 3, "rail": 2, "arc": 2, "lip": 1, "knob": 0.3, "none": 11}
    style = Style.sample(rng, handles, {"slab": 2, "shaker": 1.5, "glass": 5})
    style.inset, style.front = bool(rng.random() < 0.15), style.sheet or rng.uniform(0.025, 0.07)
    style.swing = float(np.radians(rng.choice([90, 90, 110, 150])))
    w, h, d = sample_size(rng, (1.5, 2.1), (1, 1), (0.9, 1.5))
    low = rng.choice([0.0, 0.03])
    drop = rng.random() < 0.2
    band = h * rng.uniform(0.15, 0.25) if drop else w * rng.uniform(0.16, 0.3)
    oven = Rect(0, low, w, h - band) if drop else Rect(0, low, w - band, h)
    panel = Rect(0, h - band, w, h) if drop else Rect(w - band, low, w, h)
    body = Link("heavy microwave_body", "body")
    wall = rng.uniform(0.04, 0.08)
    cavity = oven.shrink(wall)
    if rng.random() < 0.6:
        body.add("frame", hollow_block(oven, cavity, 0, wall, d))
    else:
        carcass(body, oven, 0, d, wall)
        body.add("frame", frame(oven, cavity, 2, d - 0.02, d))
    z0, face_z = style.depths(d)[0], d if style.inset else d + style.front
    body.add("frame", board(panel, 0, face_z))
    if low:
        body.add("foot", *legs(rng, "round", Rect(0, 0, w, d), 0, low, 0.06))
    front = cavity.shrink(style.gap) if style.inset else oven.shrink(style.gap / 2)
    if style.inset:
        style.gap = max(style.gap, style.front**2 / front.width)
    side = "bottom" if drop else "left"
    if style.porthole:
        leaf = porthole(rng, style, body, cavity, z=d, side=side, leaf="door_frame")
    else:
        leaf = door(rng, style, body, front, z=d, side=side, outer=not drop, leaf="door_frame")
    set_semantics(leaf, "hinge door", "door")
    links = [leaf]
    if not style.porthole and rng.random() < 0.4:  # where a hollow leaf would reach in
        c = np.array([cavity.centre[0], cavity.y0 + 0.03, (wall + z0) / 2])
        tray = Link("hinge rotation_tray", "tray", body, Joint(c, np.array([0.0, 1, 0]), None))
        tray.add("tray", lathe([(0.42 * min(cavity.width, z0 - wall), y) for y in (0, 0.015)], c, 1, sides=24))
        body.add("tray_support", lathe([(0.06, -0.03), (0.06, -0.001)], c, 1))
        links.append(tray)
    # Controls, from one end of the panel: a display, then knobs or a field of buttons.
    long, short = (panel.width, panel.height) if drop else (panel.height, panel.width)

    def on_panel(along: float, across: float) -> tuple[float, float]:
        if drop:
            return panel.x0 + along, panel.centre[1] + across
        return panel.centre[0] + across, panel.y1 - along

    x, y = on_panel(0.14 * long, 0)
    size = (0.08 * long, 0.25 * short) if drop else (0.3 * short, 0.05 * long)
    body.add("display_panel", board(Rect(x - size[0], y - size[1], x + size[0], y + size[1]), face_z, face_z + 0.004))
    if rng.random() < 0.4:
        for a in np.linspace(0.42, 0.8, int(rng.integers(1, 4))):
            centre = np.array([*on_panel(a * long, 0), face_z])
            links.append(knob(rng, body, centre, min(0.28 * short, 0.07 * long), "control_button"))
    else:
        n, m = int(rng.integers(3, 7)), int(rng.integers(1, 4))
        pitch = 0.62 * long / n, 0.8 * short / m
        moving = rng.random() < 0.5
        for i in range(n):
            for k in range(m):
                centre = np.array(
                    [*on_panel((0.28 + 0.62 * (i + 0.5) / n) * long, pitch[1] * (k - (m - 1) / 2)), face_z]
                )
                size = pitch if drop else pitch[::-1]
                b = button(rng, body, centre, 0.6 * size[0], 0.6 * size[1], "control_button")
                if moving and i == n - 1:
                    links.append(b)
                else:
                    body.add(*b.leaves[0][:1], *b.leaves[0][1])
    return [*links, body]
