"""Procedural articulated objects in PartNet-Mobility's own on-disk layout, in the seven categories of the paper.

They need no licence, and take the same road as real objects: `vatmart generate`, then `vatmart convert`. Object i of
a seed depends on the seed and i alone.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection
from itertools import pairwise
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from mjcf_assets.furniture import (
    Joint,
    Link,
    Style,
    carcass,
    door,
    drawer,
    face,
    feet,
    mirrored,
    pick,
    porthole,
    relief,
    turned,
)  # fmt: skip
from mjcf_assets.solids import (
    Rect,
    board,
    box,
    circle,
    corners,
    frame,
    lathe,
    plate,
    prism,
    rod,
    rounded,
    sweep,
    tub,
)  # fmt: skip
from vatmart_jax.atomic_io import whole_folder, write_text
from vatmart_jax.errors import UserError

# The order in which categories come: each of them early, and in proportions like those of the real set.
CYCLE = (
    "StorageFurniture", "Refrigerator", "StorageFurniture", "Table", "Microwave", "StorageFurniture", "Door", "Safe",
    "StorageFurniture", "WashingMachine", "Microwave", "StorageFurniture", "Refrigerator", "Table", "StorageFurniture",
    "Door", "Table", "StorageFurniture", "Safe", "Table",
)  # fmt: skip
TRAINING = ("StorageFurniture", "Door", "Microwave", "Refrigerator")


class GeneratorError(UserError):
    """The arguments or the output folder cannot be used."""


def generate(out: Path, count: int, seed: int) -> list[str]:
    """Write `count` object folders and splits.json into `out`; returns the ids, which name the folders.

    One in four objects of a training category is a test shape; Safe, Table and WashingMachine are test categories.
    Raises GeneratorError where an argument is out of range or `out` is not empty of other objects.
    """
    out = Path(out)
    if not 1 <= count < 100_000 or seed < 0:
        raise GeneratorError(f"--count {count} --seed {seed}: expected 1 <= count < 100000 and seed >= 0")
    ids = [f"9{seed:03d}{i:05d}" for i in range(count)]
    make_folder(out, ids)
    splits = {name: {} for name in ("train", "test_shapes", "test_categories", "extra")}
    seen = dict.fromkeys(CYCLE, 0)
    for i, name in enumerate(ids):
        category = CYCLE[i % len(CYCLE)]
        seen[category] += 1
        split = "test_categories" if category not in TRAINING else "test_shapes" if seen[category] % 4 == 2 else "train"
        splits[split].setdefault(category, []).append(name)
        rng = np.random.default_rng([seed, i])
        _write(out / name, category, MAKERS[category](rng), rng)
    write_text(out / "splits.json", json.dumps(splits))
    return ids


def make_folder(out: Path, ids: Collection[str]) -> None:
    """Make the folder that is to hold these objects. Raises GeneratorError where it holds others."""
    out.mkdir(parents=True, exist_ok=True)
    others = sorted(p.parent.name for p in out.glob("*/mobility.urdf") if p.parent.name not in ids)
    if others:
        raise GeneratorError(f"{out}: holds other objects ({others[0]}, ...); choose an empty folder")


# Storage furniture and tables


def fill(
    rng: np.random.Generator, s: Style, body: Link, cell: Rect, edges: tuple[float, float, float, float], kind: str,
    back: float, z: float, outer: tuple[bool, bool],
) -> list[Link]:  # fmt: skip
    """Furnish one cell of a carcass.

    kind: drawer, door, pair, flip (hinged above), drop (hinged below), open or panel. edges: how far the boards on
    the left, below, on the right and above reach into the cell. outer: its left and right side are the carcass's.
    """
    inside = Rect(cell.x0 + edges[0], cell.y0 + edges[1], cell.x1 - edges[2], cell.y1 - edges[3])
    front = inside.shrink(s.gap) if s.inset else cell.shrink(s.gap / 2)
    if kind == "panel":
        body.add("vertical_front_panel", board(inside, z - 0.02, z))
        return []
    if kind == "drawer":
        return [drawer(rng, s, body, front, inside, back, z)]
    if kind == "door" and s.porthole and 0.5 < inside.width / inside.height < 2:
        return [porthole(rng, s, body, inside, z, str(rng.choice(["left", "right"])), "cabinet_door_surface")]
    room = s.depths(z)[0] - (0.02 if s.inset else 0.01)
    for y in np.linspace(inside.y0, inside.y1, int(rng.integers(0, 2 + int(inside.height / 0.35))) + 2)[1:-1]:
        shelf = inside._replace(y0=y - 0.01, y1=y + 0.01)
        body.add("shelf", board(shelf, back, back + (room - back) * rng.choice([0.6, 1.0])))
    if kind == "open":
        return []
    if kind == "pair":
        x = front.centre[0]
        halves = front._replace(x1=x - s.gap / 2), front._replace(x0=x + s.gap / 2)
        return [door(rng, s, body, r, z, side, o) for r, side, o in zip(halves, ("left", "right"), outer, strict=True)]
    side = {"flip": "top", "drop": "bottom"}.get(kind) or str(rng.choice(["left", "right"]))
    return [door(rng, s, body, front, z, side, outer[side == "right"] if kind == "door" else False)]


def column(rng: np.random.Generator, width: float, height: float, drawers: float) -> list[tuple[str, float]]:
    """What is stacked in one column, from above: (kind, height). drawers: how likely drawers are."""
    leaf = lambda: "pair" if width > 0.8 or (width > 0.6 and rng.random() < 0.5) else "door"  # noqa: E731
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
    rng: np.random.Generator, s: Style, body: Link, r: Rect, back: float, z: float, columns: int, drawers: float,
    top: bool = True, free: tuple[bool, bool] = (True, True),
) -> list[Link]:  # fmt: skip
    """A carcass in r, cut into columns and rows, furnished with at least one moving part.

    drawers: how likely they are. free: nothing stands beside it on the left, on the right.
    """
    t = s.board
    carcass(body, r, back, z, t, top)
    share = np.ones(columns) if rng.random() < 0.7 else rng.uniform(0.6, 1.4, columns)
    x = r.x0 + r.width * np.concatenate([[0], np.cumsum(share / share.sum())])
    plan = column(rng, r.width / columns, r.height, drawers)
    links: list[Link] = []
    for c in range(columns):
        if c and rng.random() < 0.4:
            plan = column(rng, x[c + 1] - x[c], r.height, drawers)
        if c:
            divider = Rect(x[c] - t / 2, r.y0 + t, x[c] + t / 2, r.y1 - t)
            body.add("vertical_divider_panel", board(divider, back, z))
        y = r.y1
        for k, (kind, h) in enumerate(plan):
            first, last = k == 0, k == len(plan) - 1
            if links and kind != "open" and rng.random() < 0.06:
                kind = "panel" if rng.random() < 0.5 else "open"
            cell = Rect(x[c], y - h, x[c + 1], y)
            left, right = c == 0, c == columns - 1
            edges = (t if left else t / 2, t if last else t / 2, t if right else t / 2, t if first else t / 2)
            links += fill(rng, s, body, cell, edges, kind, back + 0.5 * t, z, (left and free[0], right and free[1]))
            if not last and not (kind == plan[k + 1][0] == "drawer" and rng.random() < 0.5):
                rail = Rect(x[c], y - h - t / 2, x[c + 1], y - h + t / 2).shrink(t / 2, 0)
                body.add("frame_horizontal_bar", board(rail, back + 0.5 * t, z))
            y -= h
    return links


def _scaled(rng: np.random.Generator, *ranges: tuple[float, float]) -> np.ndarray:
    """Random proportions, as a size [3] with a diagonal of 2."""
    size = np.array([rng.uniform(*r) for r in ranges])
    return 2 * size / np.linalg.norm(size)


def storage_furniture(rng: np.random.Generator) -> list[Link]:
    faces = {"slab": 4, "shaker": 3, "raised": 1.5, "glass": 1, "louvre": 0.5}
    s = Style.draw(rng, {"bar": 5, "rail": 1.5, "arc": 2.5, "knob": 2, "lip": 1, "none": 1}, faces)
    if s.porthole:
        return case_with_portholes(rng, s)
    kind = pick(rng, {"base": 4, "wall": 3, "tall": 2, "wardrobe": 1.5, "chest": 2.5, "sideboard": 1, "console": 1})
    w, h, d = {
        "base": lambda: _scaled(rng, (0.45, 1.5), (1, 1), (0.6, 0.9)),
        "wall": lambda: _scaled(rng, (1.1, 2.6), (1, 1), (0.5, 1.1)),
        "tall": lambda: _scaled(rng, (0.28, 0.55), (1, 1), (0.25, 0.5)),
        "wardrobe": lambda: _scaled(rng, (0.6, 1.1), (1, 1), (0.3, 0.5)),
        "chest": lambda: _scaled(rng, (0.5, 1.3), (1, 1), (0.45, 0.9)),
        "sideboard": lambda: _scaled(rng, (1.4, 2.6), (1, 1), (0.45, 0.7)),
        "console": lambda: _scaled(rng, (0.8, 2.2), (1, 1), (0.35, 0.7)),
    }[kind]()
    spread = (0.3, 0.9) if kind == "wall" else (0.6, 1.4)
    columns = int(np.clip(round(w / h * rng.uniform(*spread)), 1, 3 - int(rng.random() < 0.6)))
    drawers = {"base": 0.6, "wall": 0.0, "tall": 0.25, "wardrobe": 0.25, "chest": 0.95, "sideboard": 0.5,
               "console": 0.3}[kind]  # fmt: skip
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
        style = str(rng.choice(["square", "tapered", "splayed", "round"]))
        body.add("foot", *feet(rng, style, Rect(0, 0, w, d), 0, low, rng.uniform(0.03, 0.08)))
    links = cabinet(
        rng, s, body, Rect(0, low, w, h), 0, d, columns, drawers, bool(kind != "base" or rng.random() < 0.5)
    )
    if kind in ("base", "chest", "sideboard", "wardrobe") and rng.random() < 0.45:
        o = rng.uniform(0.01, 0.06)
        body.add("top_panel", box((-o, h, 0), (w + o, h + rng.uniform(0.02, 0.05), d + o)))
    # Some are used from the side, as the end of a counter is.
    return turned([*links, body], float(rng.choice([0, np.pi / 2, -np.pi / 2], p=[0.92, 0.04, 0.04])))


def case_with_portholes(rng: np.random.Generator, s: Style) -> list[Link]:
    """One to three portholes beside or above each other, in a case that may have a closed strip above them."""
    n = int(rng.choice([1, 2, 3], p=[0.6, 0.3, 0.1]))
    beside = rng.random() < 0.5
    wide, high = (0.7 * n, 1.2 * n) if beside else (0.7, 1.2), (0.9, 1.1) if beside else (0.9 * n, 1.1 * n)
    w, h, d = _scaled(rng, wide, high, (0.4, 1.1))
    body = Link("heavy furniture_body", "cabinet_frame")
    top = h * (1 - rng.choice([0.0, rng.uniform(0.08, 0.2)]))
    if top < h:
        body.add("top_panel", board(Rect(0, top, w, h), 0, d))
    carcass(body, Rect(0, 0, w, top), 0, d, s.board)
    inside = Rect(0, 0, w, top).shrink(s.board)
    links = []
    for lo, hi in pairwise(np.linspace(*((inside.x0, inside.x1) if beside else (inside.y0, inside.y1)), n + 1)):
        cell = inside._replace(x0=lo, x1=hi) if beside else inside._replace(y0=lo, y1=hi)
        side = str(rng.choice(["left", "right", "bottom", "top"], p=[0.42, 0.42, 0.1, 0.06]))
        links.append(porthole(rng, s, body, cell, d, side, "cabinet_door_surface"))
    return [*links, body]


def table(rng: np.random.Generator) -> list[Link]:
    s = Style.draw(
        rng, {"bar": 2, "rail": 0.5, "arc": 1.5, "knob": 3, "lip": 1, "none": 4}, {"slab": 5, "shaker": 1, "raised": 1}
    )
    kind = pick(rng, {"apron": 4, "desk": 4, "nightstand": 3})
    w, h, d = {
        "apron": lambda: _scaled(rng, (0.7, 2.2), (1, 1), (0.6, 1.1)),
        "desk": lambda: _scaled(rng, (1.4, 2.4), (1, 1), (0.7, 1.1)),
        "nightstand": lambda: _scaled(rng, (0.7, 1.5), (1, 1), (0.6, 1.0)),
    }[kind]()
    body = Link("heavy furniture_body", "table_body")
    thick, over = rng.uniform(0.025, 0.08), rng.uniform(0.02, 0.12)
    radius = rng.choice([0.0, 0.05, 0.15, 2.0], p=[0.55, 0.2, 0.15, 0.1]) if kind == "apron" else 0.0
    top = Rect(0, 0, w, d)
    body.add("board", prism(rounded(top, radius, 32) if radius else corners(top), 1, h - thick, h))
    if radius > 1:
        over = 0.16 * min(w, d)
    leg = rng.uniform(0.035, 0.1)
    under = top.shrink(over)
    style = str(rng.choice(["square", "tapered", "turned", "round"]))
    ceiling = h - thick
    if kind == "nightstand":
        low = rng.choice([0.0, rng.uniform(0.04, 0.4) * h])
        if low:
            body.add("leg", *feet(rng, style, under, 0, low, leg))
        room = Rect(under.x0, low, under.x1, ceiling)
        return [*cabinet(rng, s, body, room, under.y0, under.y1, int(room.width > 0.95) + 1, 0.95), body]
    links = []
    if kind == "apron":
        apron = rng.uniform(0.12, 0.3) * h
        body.add("leg", *feet(rng, style, under.shrink(-0.5 * leg), 0, ceiling, leg))
        n = int(rng.integers(1, 2 + round(w / 0.8)))
        links += cabinet(rng, s, body, Rect(under.x0 + leg, ceiling - apron, under.x1 - leg, ceiling),
                         under.y0 + leg / 2, under.y1, n, 100.0)  # fmt: skip
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
            links += cabinet(rng, s, body, room, under.y0, under.y1, 1, 0.9, free=free)
            if low:
                body.add("leg", *feet(rng, style, Rect(x, under.y0, x + width, under.y1), 0, low, min(leg, 0.06)))
        elif rng.random() < 0.5:
            x = under.x0 if side == "left" else under.x1 - s.board
            body.add("vertical_side_panel", box((x, 0, under.y0), (x + s.board, ceiling, under.y1)))
        else:
            x = under.x0 if side == "left" else under.x1 - 2 * leg
            body.add("leg", *feet(rng, style, Rect(x, under.y0, x + 2 * leg, under.y1), 0, ceiling, leg)[::2])
    knees = Rect(
        under.x0 + (width if "left" in sides else 2 * leg), ceiling - rng.uniform(0.12, 0.2),
        under.x1 - (width if "right" in sides else 2 * leg), ceiling,
    )  # fmt: skip
    if rng.random() < 0.6:
        low = ceiling - rng.uniform(0.3, 0.8) * ceiling
        body.add("back_panel", box((knees.x0, low, under.y0), (knees.x1, ceiling, under.y0 + 0.02)))
    if rng.random() < 0.35:
        links += cabinet(rng, s, body, knees, under.y0 + 0.03, under.y1, 1, 100.0)
    return [*links, body]


# Appliances, safes and doors


def _as(link: Link, kind: str, name: str = "door") -> Link:
    link.kind, link.name = kind, name
    return link


def button(rng: np.random.Generator, parent: Link, at: np.ndarray, w: float, h: float, leaf: str = "button") -> Link:
    """A push button on a surface that faces +z."""
    link = Link("slider button", "button", parent, Joint(np.array(at), np.array([0.0, 0, -1]), 0.004))
    r = Rect(at[0] - w / 2, at[1] - h / 2, at[0] + w / 2, at[1] + h / 2)
    link.add(leaf, prism(rounded(r, min(w, h) / 2, 12), 2, at[2], at[2] + rng.uniform(0.006, 0.015)))
    return link


def knob(rng: np.random.Generator, parent: Link, at: np.ndarray, radius: float, leaf: str) -> Link:
    """A knob or dial that turns without end about +z."""
    link = Link("hinge knob", "knob", parent, Joint(np.array(at), np.array([0.0, 0, 1]), None))
    d = rng.uniform(0.03, 0.06)
    link.add(leaf, lathe([(radius, 0), (0.9 * radius, 0.6 * d), (0.8 * radius, d)], at, 2))
    grip = Rect(at[0] - 0.15 * radius, at[1] - 0.75 * radius, at[0] + 0.15 * radius, at[1] + 0.75 * radius)
    link.add(leaf, board(grip, at[2] + d, at[2] + 1.4 * d))
    return link


def lever(rng: np.random.Generator, parent: Link, at: np.ndarray, reach: float, direction: float, leaf: str) -> Link:
    """A door handle that is pressed down; direction: +1 or -1 along x."""
    link = Link("hinge handle", "handle", parent, Joint(np.array(at), np.array([0.0, 0, -direction]), np.pi / 4))
    r = rng.uniform(0.01, 0.018)
    out = at + np.array([0, 0, rng.uniform(0.045, 0.07)])
    x = np.array([direction, 0, 0])
    link.add(leaf, rod(at, out + np.array([0, 0, r]), r), rod(out - r * x, out + reach * x, r))
    return link


def refrigerator(rng: np.random.Generator) -> list[Link]:
    handles = {"bar": 3, "rail": 2, "arc": 2, "lip": 0.7, "knob": 0.2, "none": 6}
    s = Style.draw(rng, handles, {"slab": 5, "shaker": 0.7, "glass": 1})
    s.inset, s.front = False, s.sheet or rng.uniform(0.04, 0.12)
    s.swing = float(np.radians(rng.choice([90, 120, 160, 180])))
    kind = pick(rng, {"single": 3, "two": 3, "side": 2, "french": 1.5, "wide": 0.7})
    w, h, d = {
        "single": lambda: _scaled(rng, (0.45, 0.95), (1, 1), (0.45, 0.9)),
        "two": lambda: _scaled(rng, (0.36, 0.5), (1, 1), (0.3, 0.45)),
        "side": lambda: _scaled(rng, (0.5, 0.75), (1, 1), (0.35, 0.5)),
        "french": lambda: _scaled(rng, (0.5, 0.65), (1, 1), (0.35, 0.45)),
        "wide": lambda: _scaled(rng, (1.0, 1.4), (1, 1), (0.4, 0.6)),
    }[kind]()
    d -= s.front
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
            body.add("frame", tub(r, hole, 0, wall, d, radius))
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
            front = Rect(w * k / n, y0, w * (k + 1) / n, y1).shrink(s.gap / 2)
            hinged = side if n == 1 else "left" if k == 0 else "right"
            outer = n < 3 or k != 1
            link = _as(door(rng, s, body, front, d, hinged, outer, "door_frame"), "hinge door")
            if outer and rng.random() < 0.4 and front.width > 0.3:
                # Narrow enough to pass the wall on the free side as the door swings.
                bin_depth, inner = rng.uniform(0.05, 0.1), front.shrink(wall + 0.04, wall + 0.03)
                for y in np.linspace(inner.y0, inner.y1, int(rng.integers(2, 5)))[:-1]:
                    bin_ = inner._replace(y0=y, y1=min(y + rng.uniform(0.06, 0.12), inner.y1))
                    link.add("other_leaf", board(bin_, d - bin_depth, d))
            links.append(link)
    if kind == "wide" or rng.random() < 0.5:
        body.add("foot", *feet(rng, "round", Rect(0, 0, w, d), 0, low, 0.05))
    else:
        body.add("foot", board(Rect(0.01, 0, w - 0.01, low), 0.01, d - 0.03))
    return [*links, body]


def microwave(rng: np.random.Generator) -> list[Link]:
    handles = {"bar": 3, "rail": 2, "arc": 2, "lip": 1, "knob": 0.3, "none": 11}
    s = Style.draw(rng, handles, {"slab": 2, "shaker": 1.5, "glass": 5})
    s.inset, s.front = bool(rng.random() < 0.15), s.sheet or rng.uniform(0.025, 0.07)
    s.swing = float(np.radians(rng.choice([90, 90, 110, 150])))
    w, h, d = _scaled(rng, (1.5, 2.1), (1, 1), (0.9, 1.5))
    low = rng.choice([0.0, 0.03])
    drop = rng.random() < 0.2
    band = h * rng.uniform(0.15, 0.25) if drop else w * rng.uniform(0.16, 0.3)
    oven = Rect(0, low, w, h - band) if drop else Rect(0, low, w - band, h)
    panel = Rect(0, h - band, w, h) if drop else Rect(w - band, low, w, h)
    body = Link("heavy microwave_body", "body")
    wall = rng.uniform(0.04, 0.08)
    cavity = oven.shrink(wall)
    if rng.random() < 0.6:
        body.add("frame", tub(oven, cavity, 0, wall, d))
    else:
        carcass(body, oven, 0, d, wall)
        body.add("frame", frame(oven, cavity, 2, d - 0.02, d))
    z0, face_z = s.depths(d)[0], d if s.inset else d + s.front
    body.add("frame", board(panel, 0, face_z))
    if low:
        body.add("foot", *feet(rng, "round", Rect(0, 0, w, d), 0, low, 0.06))
    front = cavity.shrink(s.gap) if s.inset else oven.shrink(s.gap / 2)
    if s.inset:
        s.gap = max(s.gap, s.front**2 / front.width)
    side = "bottom" if drop else "left"
    if s.porthole:
        leaf = porthole(rng, s, body, cavity, d, side, "door_frame")
    else:
        leaf = door(rng, s, body, front, d, side, not drop, "door_frame")
    links = [_as(leaf, "hinge door")]
    if not s.porthole and rng.random() < 0.4:  # where a hollow leaf would reach in
        c = np.array([cavity.centre[0], cavity.y0 + 0.03, (wall + z0) / 2])
        tray = Link("hinge rotation_tray", "tray", body, Joint(c, np.array([0.0, 1, 0]), None))
        tray.add("tray", lathe([(0.42 * min(cavity.width, z0 - wall), y) for y in (0, 0.015)], c, 1, sides=24))
        body.add("tray_support", lathe([(0.06, -0.03), (0.06, -0.001)], c, 1))
        links.append(tray)
    # Controls, from one end of the panel: a display, then knobs or a field of buttons.
    long, short = (panel.width, panel.height) if drop else (panel.height, panel.width)
    across = lambda a, b: (panel.x0 + a, panel.centre[1] + b) if drop else (panel.centre[0] + b, panel.y1 - a)  # noqa: E731
    x, y = across(0.14 * long, 0)
    size = (0.08 * long, 0.25 * short) if drop else (0.3 * short, 0.05 * long)
    body.add("display_panel", board(Rect(x - size[0], y - size[1], x + size[0], y + size[1]), face_z, face_z + 0.004))
    if rng.random() < 0.4:
        for a in np.linspace(0.42, 0.8, int(rng.integers(1, 4))):
            centre = np.array([*across(a * long, 0), face_z])
            links.append(knob(rng, body, centre, min(0.28 * short, 0.07 * long), "control_button"))
    else:
        n, m = int(rng.integers(3, 7)), int(rng.integers(1, 4))
        pitch = 0.62 * long / n, 0.8 * short / m
        moving = rng.random() < 0.5
        for i in range(n):
            for k in range(m):
                centre = np.array([*across((0.28 + 0.62 * (i + 0.5) / n) * long, pitch[1] * (k - (m - 1) / 2)), face_z])
                size = pitch if drop else pitch[::-1]
                b = button(rng, body, centre, 0.6 * size[0], 0.6 * size[1], "control_button")
                if moving and i == n - 1:
                    links.append(b)
                else:
                    body.add(*b.leaves[0][:1], *b.leaves[0][1])
    return [*links, body]


def safe(rng: np.random.Generator) -> list[Link]:
    s = Style.draw(rng, {"none": 1}, {"slab": 3, "raised": 1})
    s.inset, s.front = bool(rng.random() < 0.6), s.sheet or rng.uniform(0.04, 0.1)
    s.swing = float(np.radians(rng.choice([90, 120, 160, 170])))
    w, h, d = _scaled(rng, (0.55, 1.15), (1, 1), (0.6, 1.1))
    body = Link("heavy safe_body", "base_body")
    low = rng.choice([0.0, rng.uniform(0.02, 0.1)])
    if low:
        body.add("base_body", *feet(rng, str(rng.choice(["square", "tapered"])), Rect(0, 0, w, d), 0, low, 0.12))
    shell = Rect(0, low, w, h)
    wall = rng.uniform(0.05, 0.12)
    hole = shell.shrink(wall)
    if rng.random() < 0.7:
        body.add("base_body", tub(shell, hole, 0, wall, d, rng.choice([0.0, 0.0, 0.06])))
    else:
        carcass(body, shell, 0, d, wall)
        body.leaves = [("base_body", meshes) for _, meshes in body.leaves]
    if rng.random() < 0.5:
        y = hole.y0 + hole.height * rng.uniform(0.35, 0.65)
        body.add("base_body", board(hole._replace(y0=y - 0.012, y1=y + 0.012), wall, s.depths(d)[0] - 0.06))
    s.gap = max(s.gap, 0.7 * s.front**2 / hole.width)
    front = hole.shrink(s.gap) if s.inset else shell.shrink(s.gap / 2)
    side = str(rng.choice(["left", "right"], p=[0.4, 0.6]))
    link = _as(door(rng, s, body, front, d, side, True, "door"), "hinge door")
    z = s.depths(d)[1]
    if s.face == "raised":
        z += relief(s.front)
    sign = 1.0 if side == "left" else -1.0
    c = front.centre
    spot = lambda x, y: np.array([c[0] + sign * x * front.width, c[1] + y * front.height, z])  # noqa: E731
    links = [link]
    lock = pick(rng, {"dial and lever": 2, "wheel and dial": 2, "keypad and lever": 2, "keypad": 1, "wheel": 1})
    small = min(front.width, front.height)
    if "dial" in lock:
        links.append(knob(rng, link, spot(0.1, 0.18), 0.09 * small, "switch"))
    if "lever" in lock:
        low_spot = spot(0.28, -0.15)
        links.append(lever(rng, link, low_spot, 0.22 * front.width, -sign, "handle"))
    if "wheel" in lock:
        at, r = spot(0.1, -0.12), rng.uniform(0.13, 0.2) * small
        wheel = Link("hinge knob", "knob", link, Joint(at, np.array([0.0, 0, 1]), None))
        hub = at + np.array([0, 0, 0.06])
        angles = np.linspace(0, 2 * np.pi, int(rng.integers(3, 7)))[:-1]
        spokes = [rod(hub, hub + r * np.array([np.cos(a), np.sin(a), 0]), 0.012, 8) for a in angles]
        wheel.add("switch", lathe([(0.03, 0), (0.03, 0.06), (0.02, 0.075)], at, 2), *spokes)
        if rng.random() < 0.5:
            rim = [(r + 0.012 * np.cos(a), 0.06 + 0.012 * np.sin(a)) for a in np.linspace(0, 2 * np.pi, 9)[:-1]]
            wheel.add("switch", lathe(rim, at, 2, closed=True, sides=24))
        links.append(wheel)
    if "keypad" in lock:
        at, pitch = spot(0.1, 0.2), 0.1 * small
        pad = Rect(at[0] - 1.7 * pitch, at[1] - 2.2 * pitch, at[0] + 1.7 * pitch, at[1] + 2.2 * pitch)
        if lock != "keypad":
            pad = pad._replace(y0=at[1] - 1.7 * pitch)
        link.add("door", board(pad, z, z + 0.01))
        for i in range(4 if lock == "keypad" else 3):
            for k in range(3):
                here = at + np.array([(k - 1) * pitch, (1 - i) * pitch, 0.01])
                links.append(button(rng, link, here, 0.7 * pitch, 0.7 * pitch))
    return [*links, body]


def room_door(rng: np.random.Generator) -> list[Link]:
    """One or two leaves in a frame without a wall, opening towards its front or away from it."""
    faces = {"slab": 2, "shaker": 2, "raised": 1, "glass": 1.5, "louvre": 0.5}
    s = Style.draw(rng, {"bar": 1.5, "arc": 1, "knob": 2, "rail": 0.5, "none": 3}, faces)
    s.inset, s.front, s.gap = True, s.sheet or rng.uniform(0.02, 0.06), max(s.gap, 0.008)
    s.length = min(s.length, 0.4)
    double = rng.random() < 0.35
    w, h, d = _scaled(rng, (0.6, 1.1) if double else (0.35, 0.65), (1, 1), (0.04, 0.14))
    s.recess = float(rng.choice([0.0, rng.uniform(0, max(d - s.front, 0))]))
    jamb = w * rng.uniform(0.05, 0.18) if rng.random() < 0.4 else rng.uniform(0.02, 0.1)
    above = jamb if rng.random() < 0.7 else rng.uniform(0.15, 0.3)
    inside = Rect(jamb, 0, w - jamb, h - above)
    body = Link("static door_frame", "outside_frame")
    for x in (0.0, w - jamb):
        body.add("outside_frame", box((x, 0, 0), (x + jamb, h - above, d)))
    if rng.random() < 0.25:
        x = np.linspace(0, np.pi, 17)
        rise = rng.uniform(above + 0.05, max(w / 2, above + 0.1))
        arch = np.stack([w / 2 * (1 + np.cos(x)), h - above + rise * np.sin(x)], 1)
        body.add("outside_frame", prism(arch, 2, 0, d))
    else:
        body.add("outside_frame", box((0, h - above, 0), (w, h, d)))
    if rng.random() < 0.3:
        # A panel that does not open beside the door.
        width = w * rng.uniform(0.3, 0.6)
        side_panel = Rect(w, 0, w + width, h)
        for what, meshes in face(rng, "glass", side_panel, 0.3 * d, 0.7 * d).items():
            body.add("fixed_part" if what == "board" else "glass", *meshes)
    z0, z1 = s.depths(d)
    if rng.random() < 0.3:
        body.add("fixed_part", box((jamb, 0, 0), (w - jamb, 0.012, max(z0 - 0.01, 0.01))))
    x = inside.centre[0]
    rects = [(inside, str(rng.choice(["left", "right"])))]
    if double:
        rects = [(inside._replace(x1=x), "left"), (inside._replace(x0=x), "right")]
        if rng.random() < 0.3:
            del rects[int(rng.integers(2))]  # a doorway wider than its one leaf
    links = []
    levers = s.handle == "none" and rng.random() < 0.7
    both_sides = rng.random() < 0.5
    for r, side in rects:
        front = r.shrink(s.gap, 0)._replace(y0=0.015, y1=r.y1 - s.gap)
        link = _as(door(rng, s, body, front, d, side, False, "surface_board"), "hinge rotation_door", "surface_board")
        links.append(link)
        if both_sides and link.leaves[-1][0] == "handle":
            link.add("handle", *mirrored(link.leaves[-1][1], (z0 + z1) / 2))
        hinge_x = front.x1 if side == "right" else front.x0
        for y in (0.15, 0.85) if s.recess == 0 and rng.random() < 0.5 else ():
            at = np.array([hinge_x, front.y0 + y * front.height - 0.04, d])
            link.add("hinge", lathe([(0.9 * s.gap, 0), (0.9 * s.gap, 0.08)], at, 1))
        if levers:
            sign = 1.0 if side == "left" else -1.0
            at = np.array([front.x1 - 0.05 if side == "left" else front.x0 + 0.05, front.centre[1], z1])
            turn = lever(rng, link, at + np.array([0, 0, 0.011]), min(0.15, 0.4 * front.width), -sign, "movable_part")
            rose = [lathe([(0.028, 0), (0.024, 0.01)], at, 2)]
            if both_sides:
                rose += mirrored(rose, (z0 + z1) / 2)
                turn.add("movable_part", *mirrored(turn.leaves[0][1], (z0 + z1) / 2))
            link.add("fixed_part", *rose)
            links.append(turn)
    return turned([*links, body], np.pi if rng.random() < 0.4 else 0.0)


def washing_machine(rng: np.random.Generator) -> list[Link]:
    w, h, d = _scaled(rng, (0.65, 1.0), (1, 1), (0.6, 0.95))
    body = Link("heavy washing_machine_body", "base_body")
    t, links = 0.03, []
    top_loader = rng.random() < 0.3
    if top_loader:
        y, rear = h * rng.uniform(0.82, 0.9), d * rng.uniform(0.12, 0.2)
        opening = Rect(w / 2 - 0.38 * w, 0, w / 2 + 0.38 * w, 0)._replace(y0=rear + 0.04, y1=d - 0.08)
        for lo, hi in (((0, 0, 0), (t, y, d)), ((w - t, 0, 0), (w, y, d)), ((t, 0, 0), (w - t, y, t)),
                       ((t, 0, d - t), (w - t, y, d)), ((t, 0, t), (w - t, t, d - t))):  # fmt: skip
            body.add("base_body", box(lo, hi))
        body.add("base_body", frame(Rect(t, t, w - t, d - t), opening, 1, y - t, y))
        c = np.array([*opening.centre, 0.0])[[0, 2, 1]]
        r = 0.45 * min(opening.width, opening.height)
        body.add("base_body", lathe([(r, 0.15 * y), (r, y - t), (r + 0.012, y - t), (r + 0.012, 0.15 * y)], c, 1, True))
        panel = [[0.0, y], [rear - 0.05, y], [rear * rng.uniform(0.3, 0.7), h], [0.0, h]]
        body.add("base_body", prism(np.array(panel)[:, ::-1], 0, 0, w))
        lid = Link("hinge door", "door", body)
        thick, edge = rng.uniform(0.02, 0.05), d - rng.uniform(0, 0.05)
        slab = Rect(0.04, rear, w - 0.04, edge)
        lid.joint = Joint(
            np.array([w / 2, y, rear]), np.array([-1.0, 0, 0]), float(np.radians(rng.choice([75, 85, 90])))
        )
        if rng.random() < 0.5:
            window = slab.shrink(0.15 * slab.width, 0.2 * slab.height)
            lid.add(
                "door",
                frame(slab, window, 1, y, y + thick),
                prism(corners(window), 1, y + 0.3 * thick, y + 0.6 * thick),
            )
        else:
            lid.add("door", prism(rounded(slab, 0.05), 1, y, y + thick))
        if rng.random() < 0.7:
            half = rng.uniform(0.1, 0.3) * w
            lid.add("handle", box((w / 2 - half, y + 0.1 * thick, edge), (w / 2 + half, y + 0.7 * thick, edge + 0.04)))
        links.append(lid)
        for x in np.linspace(0.25, 0.75, int(rng.integers(1, 4))):
            dial = lathe([(0.05, 0), (0.045, 0.04)], np.array([x * w, (y + h) / 2, rear * 0.5]), 2)
            body.add("button", dial)
        return [*links, body]
    radius = rng.uniform(0.24, 0.33) * w
    strip = h * rng.uniform(0.12, 0.18)
    c = np.array([w / 2 + rng.uniform(-0.03, 0.03), rng.uniform(0.46, 0.54) * (h - strip) + 0.02, d])
    shell = Rect(0, 0, w, h - strip)
    body.add("base_body", plate(shell, circle(c[:2], radius, 24), 2, d - t, d))
    body.add("base_body", board(Rect(0, h - strip, w, h), 0, d))
    for r in (Rect(0, 0, t, h - strip), Rect(w - t, 0, w, h - strip), Rect(t, 0, w - t, t)):
        body.add("base_body", board(r, 0, d - t))
    body.add("base_body", board(shell.shrink(t, 0), 0, t))
    inner = 0.97 * radius
    drum = [(inner + 0.01, -t), (inner + 0.01, t - d + 0.1), (0.02, t - d + 0.1), (0.02, t - d + 0.12)]
    body.add("base_body", lathe([*drum, (inner, t - d + 0.12), (inner, -t)], c, 2, True, 24))
    # The door: a ring over the opening, a bowl of glass that reaches into it.
    outer, thick = min(radius * rng.uniform(1.1, 1.3), h - strip - c[1] - 0.01), rng.uniform(0.03, 0.06)
    side = str(rng.choice(["left", "right"]))
    sign = -1.0 if side == "left" else 1.0
    link = Link("hinge door", "door", body)
    axis = c + np.array([sign * outer, 0, thick])
    link.joint = Joint(axis, np.array([0.0, sign, 0]), float(np.radians(rng.choice([90, 110, 130, 150]))))
    glass, rim = 0.85 * radius, thick * rng.uniform(0.4, 1)
    link.add("door", lathe([(glass, 0.002), (outer, 0.002), (0.95 * outer, thick), (glass, rim)], c, 2, True, 24))
    sag = rng.uniform(0.2, 0.5) * glass
    bowl = [(glass * np.cos(a), -sag * np.sin(a)) for a in np.linspace(0, 1.4, 6)]
    link.add("door", lathe([*((r - 0.008, z + 0.016) for r, z in bowl[::-1]), *((r, z + 0.004) for r, z in bowl)], c, 2,
                           sides=24))  # fmt: skip
    if rng.random() < 0.6:
        a = np.linspace(-0.35, 0.35, 7) + (np.pi if side == "right" else 0)
        mid = 0.5 * (glass + outer)
        arc = c + np.stack([mid * np.cos(a), mid * np.sin(a), thick + 0.045 * np.cos((a - a.mean()) / 0.35 * 1.4)], 1)
        link.add("handle", sweep(arc - [0, 0, 0.01], 0.01, 0.01))
    links.append(link)
    links.append(knob(rng, body, np.array([w * rng.uniform(0.4, 0.6), h - strip / 2, d]), 0.32 * strip, "button"))
    for x in np.linspace(0.72, 0.92, int(rng.integers(2, 6))):
        links.append(button(rng, body, np.array([x * w, h - strip / 2, d]), 0.03, 0.03))
    body.add("base_body", board(Rect(0.06 * w, h - 0.75 * strip, 0.3 * w, h - 0.25 * strip), d, d + 0.006))
    return [*links, body]


MAKERS: dict[str, Callable[[np.random.Generator], list[Link]]] = {
    "StorageFurniture": storage_furniture,
    "Door": room_door,
    "Microwave": microwave,
    "Refrigerator": refrigerator,
    "Safe": safe,
    "Table": table,
    "WashingMachine": washing_machine,
}


# Writing


def _write(folder: Path, category: str, links: list[Link], rng: np.random.Generator) -> None:
    """One object folder, complete or not at all. The links come in any order, the body is the one without a parent."""
    if rng.random() < 0.5:
        links = [links[-1], *links[:-1]]
    points = np.concatenate([m.vertices for link in links for _, meshes in link.leaves for m in meshes])
    lo, hi = points.min(0), points.max(0)
    # The dataset's objects fill a unit sphere, more or less, and stand a little off its centre.
    scale = rng.uniform(2.0, 2.08) / float(np.linalg.norm(hi - lo))
    centre = (lo + hi) / 2 + rng.normal(0, 0.015, 3)
    index = {id(link): i for i, link in enumerate(links)}
    origin = [
        np.zeros(3) if link.joint is None or not link.joint.origin.any() else scale * (link.joint.origin - centre)
        for link in links
    ]
    with whole_folder(folder) as part:
        (part / "textured_objs").mkdir()
        urdf, semantics, mobility = [], [], []
        objs = parts = 0
        for i, link in enumerate(links):
            parent = -1 if link.parent is None else index[id(link.parent)]
            base = np.zeros(3) if parent < 0 else origin[parent]
            visuals, names = [], []
            for name, meshes in link.leaves:
                parts += 1
                names.append({"id": parts, "name": name, "children": []})
                for mesh in meshes:
                    objs += 1
                    file = f"textured_objs/original-{objs}.obj"
                    text = _obj(f"{name}-{objs}", scale * (mesh.vertices - centre), mesh.faces)
                    (part / file).write_text(text)
                    visuals.append((f"{name}-{parts}", file))
            semantics.append(f"link_{i} {link.kind}")
            urdf += _link(i, visuals, -origin[i]) + _joint(i, link, parent, origin[i] - base, scale)
            mobility.append({
                "id": i, "parent": parent, "joint": link.kind.split()[0], "name": link.name, "parts": names,
                "jointData": _joint_data(link, origin[i], scale),
            })  # fmt: skip
        (part / "mobility.urdf").write_text(
            "\n".join(
                ['<?xml version="1.0" ?>', f'<robot name="partnet_{folder.name}">', '\t<link name="base"/>', *urdf]
            )
            + "\n</robot>\n"
        )
        (part / "semantics.txt").write_text("\n".join(semantics) + "\n")
        (part / "mobility_v2.json").write_text(json.dumps(mobility))
        meta = {"model_id": folder.name, "anno_id": folder.name, "user_id": "procedural", "time_in_sec": "0",
                "version": "1", "model_cat": category}  # fmt: skip
        (part / "meta.json").write_text(json.dumps(meta))
        box_ = {"min": (scale * (lo - centre)).round(6).tolist(), "max": (scale * (hi - centre)).round(6).tolist()}
        (part / "bounding_box.json").write_text(json.dumps(box_))


def _obj(name: str, vertices: np.ndarray, faces: np.ndarray) -> str:
    lines = [f"o {name}", *("v {:.6f} {:.6f} {:.6f}".format(*v) for v in vertices)]
    return "\n".join([*lines, *("f {} {} {}".format(*f) for f in faces + 1)]) + "\n"


def _xyz(v: np.ndarray) -> str:
    return '"' + " ".join(repr(float(x) + 0.0) for x in v) + '"'


def _link(i: int, visuals: list[tuple[str, str]], origin: np.ndarray) -> list[str]:
    lines = [f'\t<link name="link_{i}">']
    for tag in ("visual", "collision"):
        for name, file in visuals:
            lines += [
                f"\t\t<{tag} name={quoteattr(name)}>" if tag == "visual" else f"\t\t<{tag}>",
                f"\t\t\t<origin xyz={_xyz(origin)}/>",
                "\t\t\t<geometry>",
                f'\t\t\t\t<mesh filename="{file}"/>',
                "\t\t\t</geometry>",
                f"\t\t</{tag}>",
            ]
    return [*lines, "\t</link>"]


def _joint(i: int, link: Link, parent: int, xyz: np.ndarray, scale: float) -> list[str]:
    slide = link.kind.startswith("slider")
    if link.joint is None:
        kind, middle = "fixed", [f'\t\t<origin rpy="1.570796326794897 0 -1.570796326794897" xyz={_xyz(xyz)}/>']
    else:
        kind = "continuous" if link.joint.upper is None else "prismatic" if slide else "revolute"
        middle = [f"\t\t<origin xyz={_xyz(xyz)}/>", f"\t\t<axis xyz={_xyz(link.joint.axis)}/>"]
    lines = [f'\t<joint name="joint_{i}" type="{kind}">', *middle, f'\t\t<child link="link_{i}"/>']
    lines.append(f'\t\t<parent link="{"base" if parent < 0 else f"link_{parent}"}"/>')
    if link.joint is not None and link.joint.upper is not None:
        lines.append(f'\t\t<limit lower="0.0" upper="{float(link.joint.upper * (scale if slide else 1))}"/>')
    return [*lines, "\t</joint>"]


def _joint_data(link: Link, origin: np.ndarray, scale: float) -> dict:
    if link.joint is None:
        return {}
    upper = link.joint.upper
    b = 0 if upper is None else upper * scale if link.kind.startswith("slider") else float(np.degrees(upper))
    return {
        "axis": {"origin": origin.tolist(), "direction": link.joint.axis.tolist()},
        "limit": {"a": 0, "b": b, "noLimit": upper is None},
    }
