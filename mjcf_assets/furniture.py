"""Doors, drawers, handles, carcasses: what the procedural objects are put together from.

Frame and units as in `solids`; lengths fit objects whose bounding box has a diagonal of about 2.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from mjcf_assets.solids import (
    Mesh,
    Rect,
    board,
    box,
    corners,
    frame,
    lathe,
    loft,
    place,
    plate,
    prism,
    rod,
    rounded,
    sweep,
)

HANDLES = ("bar", "rail", "arc", "knob", "lip", "none")


@dataclass
class Joint:
    """A joint at q = 0 closed, opening to `upper`; None turns without end. Radians or unit lengths."""

    origin: np.ndarray  # [3]
    axis: np.ndarray  # [3] unit
    upper: float | None


@dataclass
class Link:
    """One link: `kind` is its line in semantics.txt, `leaves` are semantic parts of one or more meshes."""

    kind: str  # such as "hinge rotation_door"
    name: str  # its name in mobility_v2.json, such as "cabinet_door"
    parent: Link | None = None
    joint: Joint | None = None
    leaves: list[tuple[str, list[Mesh]]] = field(default_factory=list)

    def add(self, name: str, *meshes: Mesh) -> None:
        if meshes:
            self.leaves.append((name, list(meshes)))


@dataclass
class Style:
    """What the parts of one object have in common."""

    handle: str  # one of HANDLES
    reach: float  # how far a handle stands out of the front
    thick: float  # a handle's bar
    length: float  # a handle's length as a share of the front
    round: bool  # bars of round section
    face: str  # slab, shaker, raised, glass or louvre
    inset: bool  # fronts lie between the boards rather than over them
    recess: float  # and this far behind their edges
    gap: float  # between neighbouring fronts
    board: float  # thickness of boards
    front: float  # thickness of doors and drawer fronts
    sheet: float  # that thickness where they are sheets of metal or plastic, else 0
    swing: float  # how far doors open, rad
    porthole: bool  # single doors are portholes where there is room

    @classmethod
    def draw(cls, rng: np.random.Generator, handles: dict[str, float], faces: dict[str, float]) -> Style:
        reach = float(np.clip(rng.lognormal(np.log(0.047), 0.45), 0.012, 0.095))
        # Of a generator of their own, so that objects without them are the same as before there were any.
        later = rng.spawn(1)[0]
        porthole = bool(later.random() < 0.15)
        sheet = float(later.uniform(0.003, 0.012)) if later.random() < 0.3 else 0.0
        return cls(
            handle=pick(rng, handles),
            reach=reach,
            thick=float(np.clip(rng.lognormal(np.log(0.02), 0.4), 0.01, 0.6 * reach)),
            length=float(rng.choice([rng.uniform(0.12, 0.35), rng.uniform(0.3, 0.95)], p=[0.5, 0.5])),
            round=bool(rng.random() < 0.5),
            face=pick(rng, faces),
            inset=bool(rng.random() < 0.35),
            gap=float(rng.uniform(0.005, 0.012)),
            board=float(rng.uniform(0.02, 0.045)),
            front=sheet or float(rng.uniform(0.02, 0.045)),
            sheet=sheet,
            porthole=porthole,
            swing=float(np.radians(rng.choice([90, 90, 90, 90, 110, 135, 170, 180]))),
            recess=float(rng.choice([0.0, rng.uniform(0.0, 0.06)])),
        )

    def depths(self, z: float) -> tuple[float, float]:
        """Where a front's board begins and ends, z being where the carcass ends."""
        return (z - self.recess - self.front, z - self.recess) if self.inset else (z, z + self.front)


def pick(rng: np.random.Generator, weights: dict[str, float]) -> str:
    p = np.array(list(weights.values()))
    return str(rng.choice(list(weights), p=p / p.sum()))


def handle(rng: np.random.Generator, s: Style, at: np.ndarray, span: float, vertical: bool) -> list[Mesh]:
    """The meshes of a handle centred at `at` [3] on a front that faces +z, along y if vertical, else along x."""
    d, t, half = s.reach, s.thick, span / 2
    bend = lambda along, out: np.array([0.0, along, out] if vertical else [along, 0.0, out])

    def bar(lo: float, hi: float, z0: float, z1: float, width: float) -> Mesh:
        across = np.array([width / 2, 0, 0] if vertical else [0, width / 2, 0])
        return box(at + bend(lo, z0) - across, at + bend(hi, z1) + across)

    if s.handle == "knob":
        r, neck = float(np.clip(rng.uniform(0.35, 0.65) * d, 0.015, 0.04)), rng.uniform(0.4, 0.7)
        if s.round:
            ball = [(r * np.sin(a), d * (0.72 - 0.28 * np.cos(a))) for a in np.linspace(0.35, np.pi - 0.2, 7)]
            return [lathe([(neck * r, 0), (neck * r, 0.5 * d)], at, 2), lathe(ball, at, 2)]
        return [lathe([(0.8 * r, 0), (neck * r, 0.4 * d), (r, 0.55 * d), (r, 0.9 * d), (0.7 * r, d)], at, 2)]
    if s.handle == "lip":
        return [bar(-half, half, 0, 0.8 * d, 0.8 * t)]
    if s.handle == "arc":
        a = np.linspace(0, np.pi, 13)
        sharp = rng.uniform(0.45, 1.0)
        path = [at + bend(-half * np.cos(x), (d - t / 2) * np.sin(x) ** sharp) for x in a]
        return [sweep(np.array(path), t * rng.uniform(0.5, 1.1), t / 2)]
    inset = 0.0 if s.handle == "rail" else rng.uniform(0.05, 0.25) * span
    posts = [(-half + inset, -half + inset + t), (half - inset - t, half - inset)]
    if s.round:
        long = rod(at + bend(-half, d - t / 2), at + bend(half, d - t / 2), t / 2)
        feet = [rod(at + bend((a + b) / 2, 0), at + bend((a + b) / 2, d - t / 2), 0.35 * t) for a, b in posts]
    else:
        width = t * rng.uniform(0.8, 1.8)
        long = bar(-half, half, d - t, d, width)
        feet = [bar(a, b, 0, d - t, 0.7 * width) for a, b in posts]
    return [long, *feet]


def face(rng: np.random.Generator, style: str, r: Rect, z0: float, z1: float) -> dict[str, list[Mesh]]:
    """The boards of a door or drawer front, by "board" and "glass"."""
    rim = min(0.24 * min(r.width, r.height), rng.uniform(0.05, 0.1))
    hole, t = r.shrink(rim), z1 - z0
    if style == "slab" or min(hole.width, hole.height) < 0.04:
        return {"board": [board(r, z0, z1)]}
    if style == "raised":
        field = [place(corners(q), 2, z) for q, z in ((hole, z1), (hole.shrink(0.015), z1 + relief(t)))]
        return {"board": [board(r, z0, z1), loft(field)]}
    rails = [
        board(Rect(r.x0, r.y0, hole.x0, r.y1), z0, z1),
        board(Rect(hole.x1, r.y0, r.x1, r.y1), z0, z1),
        board(Rect(hole.x0, r.y0, hole.x1, hole.y0), z0, z1),
        board(Rect(hole.x0, hole.y1, hole.x1, r.y1), z0, z1),
    ]
    if style == "glass":
        return {"board": [frame(r, hole, 2, z0, z1)], "glass": [board(hole, z0 + 0.4 * t, z0 + 0.6 * t)]}
    if style == "louvre":
        n = int(np.clip(hole.height / 0.07, 3, 12))
        y = np.linspace(hole.y0, hole.y1, n + 1)
        slat = lambda a, b: np.array([[a, z0 + 0.1 * t], [a + 0.2 * (b - a), z1], [b, z0 + 0.4 * t]])
        return {"board": rails + [prism(slat(a, b), 0, hole.x0, hole.x1) for a, b in pairwise(y)]}
    return {"board": [*rails, board(hole, z0, z0 + 0.55 * t)]}


def relief(thickness: float) -> float:
    """How far the field of a raised face stands out."""
    return min(0.3 * thickness, 0.008)


def hinge(side: str, r: Rect, z: float, upper: float) -> Joint:
    """A joint on one edge of a front at depth z that swings the far edge towards +z."""
    c = r.centre
    at = {"right": (r.x1, c[1]), "left": (r.x0, c[1]), "bottom": (c[0], r.y0), "top": (c[0], r.y1)}[side]
    axis = {"right": (0, 1, 0), "left": (0, -1, 0), "bottom": (1, 0, 0), "top": (-1, 0, 0)}[side]
    return Joint(np.array([*at, z]), np.array(axis, float), upper)


def front_handle(rng: np.random.Generator, s: Style, r: Rect, z: float, side: str | None) -> list[Mesh]:
    """A handle where people put it: near the edge that opens, or in the middle of a drawer (side None)."""
    if s.handle == "none":
        return []
    upright = side in ("left", "right")
    along, across = (r.height, r.width) if upright else (r.width, r.height)
    span = min(max(s.length * along, 0.05), 0.96 * along)
    if side is None:
        twin = s.handle != "lip" and span < 0.25 * along and along > 0.7
        y = r.y1 - s.thick if s.handle == "lip" else r.centre[1] + rng.choice([0, 0, 0.25]) * r.height
        xs = r.centre[0] + along * np.array([-0.25, 0.25] if twin else [0.0])
        return [m for x in xs for m in handle(rng, s, np.array([x, y, z]), span, False)]
    margin = s.thick if s.handle == "lip" else min(0.25 * across, s.thick + rng.uniform(0.02, 0.06))
    free = {"left": r.x1 - margin, "right": r.x0 + margin, "top": r.y0 + margin, "bottom": r.y1 - margin}[side]
    if upright:
        room = (r.height - span) / 2 * 0.9
        y = r.centre[1] + room * rng.choice([-0.8, 0, 0, 0.3, 0.8])
        return handle(rng, s, np.array([free, y, z]), span, True)
    return handle(rng, s, np.array([r.centre[0], free, z]), span, False)


def door(rng: np.random.Generator, s: Style, body: Link, r: Rect, z: float, side: str, outer: bool, leaf="") -> Link:
    """A door whose front board fills r, behind (inset) or before (overlay) the plane z where the carcass ends.

    The axis is on the front edge, about which a board turns without touching what is beside or behind it; on an
    outer edge it may lie deeper, flush with the carcass's side, and the door may open further than 90 degrees.
    """
    z0, z1 = s.depths(z)
    deep = outer and not s.inset and (s.front > 0.05 or rng.random() < 0.7)
    axis = z0 + s.front * rng.choice([0.0, 0.0 if s.front > 0.05 else 0.5]) if deep else z1
    link = Link("hinge rotation_door", "cabinet_door", body)
    edge = r.shrink(-s.gap / 2) if deep else r
    wide = outer and side in ("left", "right") and not (s.inset and s.recess)
    link.joint = hinge(side, edge, float(axis), s.swing if wide else np.pi / 2)
    for what, meshes in face(rng, s.face, r, z0, z1).items():
        link.add((leaf or "cabinet_door_surface") if what == "board" else "glass", *meshes)
    link.add("handle", *front_handle(rng, s, r, z1, side))
    return link


def porthole(rng: np.random.Generator, s: Style, body: Link, cell: Rect, z: float, side: str, leaf: str) -> Link:
    """A round door, or one with round corners, at the hole of a panel that fills `cell`; often hollow as a dish is.

    The panel ends at z, or with the carcass's recess behind it.
    """
    z0, z1 = s.depths(z)
    r = cell.shrink(rng.uniform(0.03, 0.12) * min(cell.width, cell.height))
    if rng.random() < 0.7:
        spare = np.array([r.width, r.height]) - min(r.width, r.height)
        r = r.shrink(*spare / 2)
    half = min(r.width, r.height) / 2
    radius = half * rng.choice([1.0, rng.uniform(0.3, 1.0)], p=[0.7, 0.3])
    rim = half * rng.uniform(0.1, 0.25)
    inner, floor = r.shrink(rim), r.shrink(rim + half * rng.uniform(0.2, 0.4))
    # An inset leaf's far edge swings out past the hole's.
    slit = max(s.gap, 0.6 * s.front**2 / half)
    hole, front = (r.shrink(-slit), z1) if s.inset else (r.shrink(0.7 * rim), z0)
    ring = lambda q: rounded(q, radius * min(q.width, q.height) / (2 * half), start=0)
    body.add("frame", plate(cell, ring(hole), 2, front - s.board, front))

    # The floor of a dish must pass the hole as well, turning about the leaf's front edge on the hinge's side.
    across = [(q.width if side in ("left", "right") else q.height) / 2 for q in (r, hole, floor)]
    room = np.sqrt(max((across[0] + across[1] - 0.01) ** 2 - (across[0] + across[2]) ** 2, 0))
    wall = 0.012
    dish = min(rng.choice([0.0, rng.uniform(0.2, 1.0)], p=[0.3, 0.7]) * half, room - wall)
    rings = [(r, z0), (r, z1)]
    if dish > 0:
        back = min(z1 - dish - wall, z0)
        rings = [(floor, back), (inner, z0), *rings, (inner, z1), (floor, z1 - dish)]
    link = Link("hinge rotation_door", "cabinet_door", body)
    link.joint = hinge(side, r, z1, np.pi / 2 if s.inset else max(s.swing, np.pi / 2))
    link.add(leaf, loft([place(ring(q), 2, at) for q, at in rings]))
    if s.handle != "none":
        c, upright = r.centre, side in ("left", "right")
        reach = np.array([r.width, r.height]) / 2 - rim / 2
        toward = {"left": (1, 0), "right": (-1, 0), "bottom": (0, 1), "top": (0, -1)}[side]
        at = np.array([*(c + toward * reach), z1])
        link.add("handle", *handle(rng, s, at, 0.4 * half, upright))
    return link


def drawer(rng: np.random.Generator, s: Style, body: Link, front: Rect, inside: Rect, back: float, z: float) -> Link:
    """A drawer: a front board filling `front` and an open box within the cell `inside`, from depth `back` to z."""
    z0, z1 = s.depths(z)
    depth = (z0 - back) * rng.uniform(0.75, 0.97)
    low = inside.shrink(0.01, 0.012)
    low = low._replace(y1=low.y0 + low.height * rng.uniform(0.5, 0.95))
    wall = min(rng.uniform(0.012, 0.03), 0.2 * min(low.width, low.height))
    link = Link("slider drawer", "drawer", body)
    link.joint = Joint(
        np.array([*front.centre, (z0 + z1) / 2]) if rng.random() < 0.7 else np.zeros(3),
        np.array([0.0, 0.0, 1.0]),
        float(min(depth * rng.choice([rng.uniform(0.45, 0.95), 1.0], p=[0.8, 0.2]), 1.0)),
    )
    style = s.face if s.face in ("slab", "shaker", "raised") else "slab"
    for meshes in face(rng, style, front, z0, z1).values():
        link.add("drawer_front", *meshes)
    rear = z0 - depth
    link.add("drawer_side", board(low._replace(x1=low.x0 + wall), rear, z0))
    link.add("drawer_side", board(low._replace(x0=low.x1 - wall), rear, z0))
    link.add("drawer_back", board(low.shrink(wall, 0), rear, rear + wall))
    link.add("drawer_bottom", board(low.shrink(wall, 0)._replace(y1=low.y0 + wall), rear + wall, z0))
    link.add("handle", *front_handle(rng, s, front, z1, None))
    return link


def carcass(body: Link, r: Rect, back: float, z: float, t: float, top: bool = True) -> None:
    """Five boards around r, open at the front."""
    body.add("vertical_side_panel", board(r._replace(x1=r.x0 + t), back, z))
    body.add("vertical_side_panel", board(r._replace(x0=r.x1 - t), back, z))
    body.add("bottom_panel", board(r.shrink(t, 0)._replace(y1=r.y0 + t), back, z))
    body.add("back_panel", board(r.shrink(t), back, back + 0.5 * t))
    if top:
        body.add("top_panel", board(r.shrink(t, 0)._replace(y0=r.y1 - t), back, z))
    else:
        body.add("frame_horizontal_bar", board(r.shrink(t, 0)._replace(y0=r.y1 - t), z - 0.1, z))


def feet(rng: np.random.Generator, kind: str, r: Rect, lo: float, hi: float, width: float) -> list[Mesh]:
    """Four legs under the rectangle r of x and z, from y = lo to hi."""
    inset = width * rng.uniform(0.55, 1.2)
    spots = [(x, z) for x in (r.x0 + inset, r.x1 - inset) for z in (r.y0 + inset, r.y1 - inset)]
    c, half, h = r.centre, width / 2, hi - lo
    legs = []
    for x, z in spots:
        foot = Rect(x - half, z - half, x + half, z + half)
        if kind == "square":
            legs.append(prism(corners(foot), 1, lo, hi))
        elif kind == "tapered":
            legs.append(loft([place(corners(q), 1, y) for q, y in ((foot.shrink(0.2 * width), lo), (foot, hi))]))
        elif kind == "turned":
            profile = [(0.5, 0), (0.7, 0.1), (0.45, 0.16), (0.55, 0.3), (0.95, 0.65), (0.6, 0.75), (1, 0.8), (1, 1)]
            legs.append(lathe([(half * a, h * b) for a, b in profile], np.array([x, lo, z]), 1, sides=12))
        elif kind == "splayed":
            out = 0.12 * h * np.sign([x - c[0], z - c[1]])
            legs.append(loft([place(rounded(q, half), 1, y) for q, y in ((_moved(foot, out), lo), (foot, hi))]))
        else:
            legs.append(prism(rounded(foot, half, 12), 1, lo, hi))
    return legs


def _moved(r: Rect, by: np.ndarray) -> Rect:
    return Rect(r.x0 + by[0], r.y0 + by[1], r.x1 + by[0], r.y1 + by[1])


def turned(links: list[Link], angle: float) -> list[Link]:
    """Turn links about y, in place. angle: rad."""
    c, s = np.cos(angle), np.sin(angle)
    r = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    for link in links:
        link.leaves = [(name, [Mesh(m.vertices @ r.T, m.faces) for m in meshes]) for name, meshes in link.leaves]
        if link.joint is not None:
            link.joint = Joint(r @ link.joint.origin, r @ link.joint.axis, link.joint.upper)
    return links


def mirrored(meshes: list[Mesh], z: float) -> list[Mesh]:
    """Meshes seen in a mirror at depth z."""
    return [Mesh(m.vertices * [1, 1, -1] + [0, 0, 2 * z], m.faces[:, ::-1]) for m in meshes]
