"""Storage furniture: cabinets, wardrobes, chests of drawers, cases with round doors."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from mjcf_assets.procedural.cabinet import cabinet
from mjcf_assets.procedural.components import (
    Link,
    Style,
    carcass,
    legs,
    porthole,
    rotate_about_y,
    sample_size,
    weighted_choice,
)
from mjcf_assets.procedural.solids import Rect, board, box

# Ranges of width, height and depth by kind, in proportion to each other.
SIZES = {
    "base": ((0.45, 1.5), (1, 1), (0.6, 0.9)),
    "wall": ((1.1, 2.6), (1, 1), (0.5, 1.1)),
    "tall": ((0.28, 0.55), (1, 1), (0.25, 0.5)),
    "wardrobe": ((0.6, 1.1), (1, 1), (0.3, 0.5)),
    "chest": ((0.5, 1.3), (1, 1), (0.45, 0.9)),
    "sideboard": ((1.4, 2.6), (1, 1), (0.45, 0.7)),
    "console": ((0.8, 2.2), (1, 1), (0.35, 0.7)),
}
# How likely drawers are.
DRAWERS = {
    "base": 0.6, "wall": 0.0, "tall": 0.25, "wardrobe": 0.25, "chest": 0.95, "sideboard": 0.5, "console": 0.3,
}  # fmt: skip


def storage_furniture(rng: np.random.Generator) -> list[Link]:
    """A cabinet of one of seven kinds, or a case with portholes."""
    faces = {"slab": 4, "shaker": 3, "raised": 1.5, "glass": 1, "louvre": 0.5}
    style = Style.sample(rng, {"bar": 5, "rail": 1.5, "arc": 2.5, "knob": 2, "lip": 1, "none": 1}, faces)
    if style.porthole:
        return case_with_portholes(rng, style)
    kinds = {"base": 4, "wall": 3, "tall": 2, "wardrobe": 1.5, "chest": 2.5, "sideboard": 1, "console": 1}
    kind = weighted_choice(rng, kinds)
    w, h, d = sample_size(rng, *SIZES[kind])
    spread = (0.3, 0.9) if kind == "wall" else (0.6, 1.4)
    columns = int(np.clip(round(w / h * rng.uniform(*spread)), 1, 3 - int(rng.random() < 0.6)))
    body = Link("heavy furniture_body", "cabinet_frame")
    low = 0.0
    if kind != "wall":
        low = rng.uniform(0.05, 0.12) if kind == "base" else rng.choice([0.0, rng.uniform(0.04, 0.25)])
    if kind == "console":
        low = h * rng.uniform(0.35, 0.65)
        if rng.random() < 0.5:
            body.add("shelf", board(Rect(0.05 * w, 0.25 * low, 0.95 * w, 0.25 * low + 0.03), 0.05 * d, 0.95 * d))
    if kind == "base":
        plinth = board(Rect(0, 0, w, low), 0, d - rng.uniform(0.02, 0.12))
        body.add("base_side_panel", plinth)
    elif low:
        leg_shape = str(rng.choice(["square", "tapered", "splayed", "round"]))
        body.add("foot", *legs(rng, leg_shape, Rect(0, 0, w, d), 0, low, rng.uniform(0.03, 0.08)))
    top = bool(kind != "base" or rng.random() < 0.5)
    carcass_rect = Rect(0, low, w, h)
    links = cabinet(rng, style, body, carcass_rect, back=0, z=d, columns=columns, drawers=DRAWERS[kind], top=top)
    if kind in ("base", "chest", "sideboard", "wardrobe") and rng.random() < 0.45:
        o = rng.uniform(0.01, 0.06)
        body.add("top_panel", box((-o, h, 0), (w + o, h + rng.uniform(0.02, 0.05), d + o)))
    # Some are used from the side, as the end of a counter is.
    return rotate_about_y([*links, body], float(rng.choice([0, np.pi / 2, -np.pi / 2], p=[0.92, 0.04, 0.04])))


def case_with_portholes(rng: np.random.Generator, style: Style) -> list[Link]:
    """One to three portholes beside or above each other, in a case that may have a closed strip above them."""
    n = int(rng.choice([1, 2, 3], p=[0.6, 0.3, 0.1]))
    beside = rng.random() < 0.5
    wide, high = (0.7 * n, 1.2 * n) if beside else (0.7, 1.2), (0.9, 1.1) if beside else (0.9 * n, 1.1 * n)
    w, h, d = sample_size(rng, wide, high, (0.4, 1.1))
    body = Link("heavy furniture_body", "cabinet_frame")
    top = h * (1 - rng.choice([0.0, rng.uniform(0.08, 0.2)]))
    if top < h:
        body.add("top_panel", board(Rect(0, top, w, h), 0, d))
    carcass(body, Rect(0, 0, w, top), 0, d, style.board)
    inside = Rect(0, 0, w, top).shrink(style.board)
    links = []
    for lo, hi in pairwise(np.linspace(*((inside.x0, inside.x1) if beside else (inside.y0, inside.y1)), n + 1)):
        cell = inside._replace(x0=lo, x1=hi) if beside else inside._replace(y0=lo, y1=hi)
        side = str(rng.choice(["left", "right", "bottom", "top"], p=[0.42, 0.42, 0.1, 0.06]))
        links.append(porthole(rng, style, body, cell, z=d, side=side, leaf="cabinet_door_surface"))
    return [*links, body]
