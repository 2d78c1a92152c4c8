"""Carcasses divided into columns and rows of drawers and doors: storage furniture and tables are made of them."""

from __future__ import annotations

import numpy as np

from mjcf_assets.procedural.components import Link, Style, carcass, door, drawer, porthole
from mjcf_assets.procedural.solids import Rect, board


def furnish_cell(
    rng: np.random.Generator, style: Style, body: Link, cell: Rect, edges: tuple[float, float, float, float], *,
    kind: str, back: float, z: float, outer: tuple[bool, bool],
) -> list[Link]:  # fmt: skip
    """Furnish one cell of a carcass.

    kind: drawer, door, pair, flip (hinged above), drop (hinged below), open or panel. edges: how far the boards on
    the left, below, on the right and above reach into the cell. outer: its left and right side are the carcass's.
    """
    inside = Rect(cell.x0 + edges[0], cell.y0 + edges[1], cell.x1 - edges[2], cell.y1 - edges[3])
    front = inside.shrink(style.gap) if style.inset else cell.shrink(style.gap / 2)
    if kind == "panel":
        body.add("vertical_front_panel", board(inside, z - 0.02, z))
        return []
    if kind == "drawer":
        return [drawer(rng, style, body, front, inside, back=back, z=z)]
    if kind == "door" and style.porthole and 0.5 < inside.width / inside.height < 2:
        side = str(rng.choice(["left", "right"]))
        return [porthole(rng, style, body, inside, z=z, side=side, leaf="cabinet_door_surface")]
    room = style.depths(z)[0] - (0.02 if style.inset else 0.01)
    for y in np.linspace(inside.y0, inside.y1, int(rng.integers(0, 2 + int(inside.height / 0.35))) + 2)[1:-1]:
        shelf = inside._replace(y0=y - 0.01, y1=y + 0.01)
        body.add("shelf", board(shelf, back, back + (room - back) * rng.choice([0.6, 1.0])))
    if kind == "open":
        return []
    if kind == "pair":
        x = front.centre[0]
        halves = front._replace(x1=x - style.gap / 2), front._replace(x0=x + style.gap / 2)
        return [
            door(rng, style, body, half, z=z, side=side, outer=at_end)
            for half, side, at_end in zip(halves, ("left", "right"), outer, strict=True)
        ]
    side = {"flip": "top", "drop": "bottom"}.get(kind) or str(rng.choice(["left", "right"]))
    at_end = kind == "door" and outer[side == "right"]
    return [door(rng, style, body, front, z=z, side=side, outer=at_end)]


def stack_column(rng: np.random.Generator, width: float, height: float, drawers: float) -> list[tuple[str, float]]:
    """What is stacked in one column, from above: (kind, height). drawers: how likely drawers are."""

    def leaf() -> str:
        return "pair" if width > 0.8 or (width > 0.6 and rng.random() < 0.5) else "door"

    if rng.random() < drawers * 0.55:
        n = int(np.clip(rng.integers(1, 5), np.ceil(height / 0.5), max(height / 0.14, 1)))
        share = np.linspace(1, rng.choice([1.0, 1.0, 1.8]), n)
        return [("drawer", float(h)) for h in height * share / share.sum()]
    if rng.random() < drawers and height > 0.4:
        h = float(np.clip(height * rng.uniform(0.15, 0.35), 0.13, 0.4))
        middle = [("open", 0.25 * height)] if height > 0.8 and rng.random() < 0.3 else []
        rest = height - h - sum(x for _, x in middle)
        rows = [("drawer", h), *middle, (leaf(), rest)]
        return rows[::-1] if rng.random() < 0.25 else rows
    if width / height > 1.5:
        n = 2 if height > 0.5 and rng.random() < 0.4 else 1
        kinds = [str(rng.choice(["flip", "drop", "pair", "door"], p=[0.4, 0.15, 0.25, 0.2])) for _ in range(n)]
        return [(k if width / (height / n) > 1.2 else leaf(), height / n) for k in kinds]
    if height > 1.2 and rng.random() < 0.6:
        h = height * rng.uniform(0.3, 0.7)
        other = str(rng.choice(["open", leaf(), leaf()]))
        return [(leaf(), height - h), (other, h)]
    return [(leaf(), height)]


def cabinet(
    rng: np.random.Generator, style: Style, body: Link, rect: Rect, *,
    back: float, z: float, columns: int, drawers: float, top: bool = True, free: tuple[bool, bool] = (True, True),
) -> list[Link]:  # fmt: skip
    """A carcass in rect, cut into columns and rows, furnished with at least one moving part.

    drawers: how likely they are. free: nothing stands beside it on the left, on the right.
    """
    t = style.board
    carcass(body, rect, back, z, t, top)
    share = np.ones(columns) if rng.random() < 0.7 else rng.uniform(0.6, 1.4, columns)
    x = rect.x0 + rect.width * np.concatenate([[0], np.cumsum(share / share.sum())])
    plan = stack_column(rng, rect.width / columns, rect.height, drawers)
    links: list[Link] = []
    for c in range(columns):
        if c and rng.random() < 0.4:
            plan = stack_column(rng, x[c + 1] - x[c], rect.height, drawers)
        if c:
            divider = Rect(x[c] - t / 2, rect.y0 + t, x[c] + t / 2, rect.y1 - t)
            body.add("vertical_divider_panel", board(divider, back, z))
        y = rect.y1
        for k, (kind, h) in enumerate(plan):
            first, last = k == 0, k == len(plan) - 1
            if links and kind != "open" and rng.random() < 0.06:
                kind = "panel" if rng.random() < 0.5 else "open"
            cell = Rect(x[c], y - h, x[c + 1], y)
            left, right = c == 0, c == columns - 1
            edges = (t if left else t / 2, t if last else t / 2, t if right else t / 2, t if first else t / 2)
            outer = left and free[0], right and free[1]
            links += furnish_cell(rng, style, body, cell, edges, kind=kind, back=back + 0.5 * t, z=z, outer=outer)
            if not last and not (kind == plan[k + 1][0] == "drawer" and rng.random() < 0.5):
                rail = Rect(x[c], y - h - t / 2, x[c + 1], y - h + t / 2).shrink(t / 2, 0)
                body.add("frame_horizontal_bar", board(rail, back + 0.5 * t, z))
            y -= h
    return links
