"""Tables, desks and nightstands with drawers and doors."""

from __future__ import annotations

import numpy as np

from mjcf_assets.procedural.cabinet import cabinet
from mjcf_assets.procedural.components import Link, Style, legs, sample_size, weighted_choice
from mjcf_assets.procedural.solids import Rect, box, corners, prism, rod, rounded

# Ranges of width, height and depth by kind, in proportion to each other.
SIZES = {
    "apron": ((0.7, 2.2), (1, 1), (0.6, 1.1)),
    "desk": ((1.4, 2.4), (1, 1), (0.7, 1.1)),
    "nightstand": ((0.7, 1.5), (1, 1), (0.6, 1.0)),
}
ONLY_DRAWERS = 100.0  # a likelihood that survives every factor on its way


def table(rng: np.random.Generator) -> list[Link]:
    """A table with drawers in its apron, a desk with pedestals, or a nightstand."""
    handles = {"bar": 2, "rail": 0.5, "arc": 1.5, "knob": 3, "lip": 1, "none": 4}
    style = Style.sample(rng, handles, {"slab": 5, "shaker": 1, "raised": 1})
    kind = weighted_choice(rng, {"apron": 4, "desk": 4, "nightstand": 3})
    w, h, d = sample_size(rng, *SIZES[kind])
    body = Link("heavy furniture_body", "table_body")
    thick, over = rng.uniform(0.025, 0.08), rng.uniform(0.02, 0.12)
    radius = rng.choice([0.0, 0.05, 0.15, 2.0], p=[0.55, 0.2, 0.15, 0.1]) if kind == "apron" else 0.0
    top = Rect(0, 0, w, d)
    body.add("board", prism(rounded(top, radius, 32) if radius else corners(top), 1, h - thick, h))
    if radius > 1:
        over = 0.16 * min(w, d)
    leg = rng.uniform(0.035, 0.1)
    under = top.shrink(over)
    leg_shape = str(rng.choice(["square", "tapered", "turned", "round"]))
    ceiling = h - thick
    if kind == "nightstand":
        low = rng.choice([0.0, rng.uniform(0.04, 0.4) * h])
        if low:
            body.add("leg", *legs(rng, leg_shape, under, 0, low, leg))
        room = Rect(under.x0, low, under.x1, ceiling)
        columns = int(room.width > 0.95) + 1
        fronts = cabinet(rng, style, body, room, back=under.y0, z=under.y1, columns=columns, drawers=0.95)
        return [*fronts, body]
    links = []
    if kind == "apron":
        apron = rng.uniform(0.12, 0.3) * h
        body.add("leg", *legs(rng, leg_shape, under.shrink(-0.5 * leg), 0, ceiling, leg))
        columns = int(rng.integers(1, 2 + round(w / 0.8)))
        room = Rect(under.x0 + leg, ceiling - apron, under.x1 - leg, ceiling)
        links += cabinet(
            rng, style, body, room, back=under.y0 + leg / 2, z=under.y1, columns=columns, drawers=ONLY_DRAWERS
        )
        if rng.random() < 0.4:
            y = h * rng.uniform(0.1, 0.3)
            body.add("shelf", box((under.x0, y, under.y0), (under.x1, y + 0.03, under.y1)))
        elif rng.random() < 0.4:
            y = h * rng.uniform(0.1, 0.3)
            for x in (under.x0 + leg, under.x1 - leg):
                body.add("bar_stretcher", rod([x, y, under.y0 + leg], [x, y, under.y1 - leg], 0.015))
            c = under.centre[1]
            body.add("bar_stretcher", rod([under.x0 + leg, y, c], [under.x1 - leg, y, c], 0.015))
        return [*links, body]
    sides = [("left",), ("right",), ("left",), ("right",), ("left", "right")][int(rng.integers(5))]
    width = w * rng.uniform(0.2, 0.32)
    low = rng.choice([0.0, rng.uniform(0.03, 0.3) * h])
    for side in ("left", "right"):
        x = under.x0 if side == "left" else under.x1 - width
        if side in sides:
            room, free = Rect(x, low, x + width, ceiling), (side == "left", side == "right")
            links += cabinet(rng, style, body, room, back=under.y0, z=under.y1, columns=1, drawers=0.9, free=free)
            if low:
                body.add("leg", *legs(rng, leg_shape, Rect(x, under.y0, x + width, under.y1), 0, low, min(leg, 0.06)))
        elif rng.random() < 0.5:
            x = under.x0 if side == "left" else under.x1 - style.board
            body.add("vertical_side_panel", box((x, 0, under.y0), (x + style.board, ceiling, under.y1)))
        else:
            x = under.x0 if side == "left" else under.x1 - 2 * leg
            body.add("leg", *legs(rng, leg_shape, Rect(x, under.y0, x + 2 * leg, under.y1), 0, ceiling, leg)[::2])
    knees = Rect(
        under.x0 + (width if "left" in sides else 2 * leg), ceiling - rng.uniform(0.12, 0.2),
        under.x1 - (width if "right" in sides else 2 * leg), ceiling,
    )  # fmt: skip
    if rng.random() < 0.6:
        low = ceiling - rng.uniform(0.3, 0.8) * ceiling
        body.add("back_panel", box((knees.x0, low, under.y0), (knees.x1, ceiling, under.y0 + 0.02)))
    if rng.random() < 0.35:
        back = under.y0 + 0.03
        links += cabinet(rng, style, body, knees, back=back, z=under.y1, columns=1, drawers=ONLY_DRAWERS)
    return [*links, body]
