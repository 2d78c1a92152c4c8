"""Components of the procedural objects: links and joints, doors, drawers, handles, carcasses, legs, controls.

Frame and units as in `solids`; lengths fit objects whose bounding box has a diagonal of about 2.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from mjcf_assets.procedural.solids import (
    Mesh,
    Rect,
    board,
    box,
    corners,
    frame,
    lathe,
    loft,
    plate,
    prism,
    ring_at,
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
    def sample(cls, rng: np.random.Generator, handles: Mapping[str, float], faces: Mapping[str, float]) -> Style:
        """A random style; handles and faces: kinds with their weights."""
        reach = float(np.clip(rng.lognormal(np.log(0.047), 0.45), 0.012, 0.095))
        # From a generator of their own: portholes and sheets came later, and objects without them are to stay the same.
        later = rng.spawn(1)[0]
        porthole = bool(later.random() < 0.15)
        sheet = float(later.uniform(0.003, 0.012)) if later.random() < 0.3 else 0.0
        return cls(
            handle=weighted_choice(rng, handles),
            reach=reach,
            thick=float(np.clip(rng.lognormal(np.log(0.02), 0.4), 0.01, 0.6 * reach)),
            length=float(rng.choice([rng.uniform(0.12, 0.35), rng.uniform(0.3, 0.95)], p=[0.5, 0.5])),
            round=bool(rng.random() < 0.5),
            face=weighted_choice(rng, faces),
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


def weighted_choice(rng: np.random.Generator, weights: Mapping[str, float]) -> str:
    """One of the keys, as likely as its weight."""
    p = np.array(list(weights.values()))
    return str(rng.choice(list(weights), p=p / p.sum()))


def handle(rng: np.random.Generator, style: Style, at: np.ndarray, span: float, vertical: bool) -> list[Mesh]:
    """The meshes of a handle centred at `at` [3] on a front that faces +z, along y if vertical, else along x."""
    d, t, half = style.reach, style.thick, span / 2

    def offset(along: float, out: float) -> np.ndarray:
        return np.array([0.0, along, out] if vertical else [along, 0.0, out])

    def bar(lo: float, hi: float, z0: float, z1: float, width: float) -> Mesh:
        across = np.array([width / 2, 0, 0] if vertical else [0, width / 2, 0])
        return box(at + offset(lo, z0) - across, at + offset(hi, z1) + across)

    if style.handle == "knob":
        r, neck = float(np.clip(rng.uniform(0.35, 0.65) * d, 0.015, 0.04)), rng.uniform(0.4, 0.7)
        if style.round:
            ball = [(r * np.sin(a), d * (0.72 - 0.28 * np.cos(a))) for a in np.linspace(0.35, np.pi - 0.2, 7)]
            return [lathe([(neck * r, 0), (neck * r, 0.5 * d)], at, 2), lathe(ball, at, 2)]
        return [lathe([(0.8 * r, 0), (neck * r, 0.4 * d), (r, 0.55 * d), (r, 0.9 * d), (0.7 * r, d)], at, 2)]
    if style.handle == "lip":
        return [bar(-half, half, 0, 0.8 * d, 0.8 * t)]
    if style.handle == "arc":
        a = np.linspace(0, np.pi, 13)
        sharp = rng.uniform(0.45, 1.0)
        path = [at + offset(-half * np.cos(x), (d - t / 2) * np.sin(x) ** sharp) for x in a]
        return [sweep(np.array(path), t * rng.uniform(0.5, 1.1), t / 2)]
    inset = 0.0 if style.handle == "rail" else rng.uniform(0.05, 0.25) * span
    posts = [(-half + inset, -half + inset + t), (half - inset - t, half - inset)]
    if style.round:
        long = rod(at + offset(-half, d - t / 2), at + offset(half, d - t / 2), t / 2)
        feet = [rod(at + offset((a + b) / 2, 0), at + offset((a + b) / 2, d - t / 2), 0.35 * t) for a, b in posts]
    else:
        width = t * rng.uniform(0.8, 1.8)
        long = bar(-half, half, d - t, d, width)
        feet = [bar(a, b, 0, d - t, 0.7 * width) for a, b in posts]
    return [long, *feet]


def front_panel(rng: np.random.Generator, kind: str, rect: Rect, z0: float, z1: float) -> dict[str, list[Mesh]]:
    """The boards of a door or drawer front, by "board" and "glass"."""
    rim = min(0.24 * min(rect.width, rect.height), rng.uniform(0.05, 0.1))
    hole, t = rect.shrink(rim), z1 - z0
    if kind == "slab" or min(hole.width, hole.height) < 0.04:
        return {"board": [board(rect, z0, z1)]}
    if kind == "raised":
        field = [ring_at(corners(q), 2, z) for q, z in ((hole, z1), (hole.shrink(0.015), z1 + relief(t)))]
        return {"board": [board(rect, z0, z1), loft(field)]}
    rails = [
        board(Rect(rect.x0, rect.y0, hole.x0, rect.y1), z0, z1),
        board(Rect(hole.x1, rect.y0, rect.x1, rect.y1), z0, z1),
        board(Rect(hole.x0, rect.y0, hole.x1, hole.y0), z0, z1),
        board(Rect(hole.x0, hole.y1, hole.x1, rect.y1), z0, z1),
    ]
    if kind == "glass":
        return {"board": [frame(rect, hole, 2, z0, z1)], "glass": [board(hole, z0 + 0.4 * t, z0 + 0.6 * t)]}
    if kind == "louvre":
        n = int(np.clip(hole.height / 0.07, 3, 12))
        y = np.linspace(hole.y0, hole.y1, n + 1)
        slats = [np.array([[a, z0 + 0.1 * t], [a + 0.2 * (b - a), z1], [b, z0 + 0.4 * t]]) for a, b in pairwise(y)]
        return {"board": rails + [prism(slat, 0, hole.x0, hole.x1) for slat in slats]}
    return {"board": [*rails, board(hole, z0, z0 + 0.55 * t)]}


def relief(thickness: float) -> float:
    """How far the field of a raised face stands out."""
    return min(0.3 * thickness, 0.008)


def hinge(side: str, rect: Rect, z: float, upper: float) -> Joint:
    """A joint on one edge of a front at depth z that swings the far edge towards +z."""
    c = rect.centre
    at = {"right": (rect.x1, c[1]), "left": (rect.x0, c[1]), "bottom": (c[0], rect.y0), "top": (c[0], rect.y1)}[side]
    axis = {"right": (0, 1, 0), "left": (0, -1, 0), "bottom": (1, 0, 0), "top": (-1, 0, 0)}[side]
    return Joint(np.array([*at, z]), np.array(axis, float), upper)


def front_handle(rng: np.random.Generator, style: Style, rect: Rect, z: float, side: str | None) -> list[Mesh]:
    """A handle where people put it: near the edge that opens, or in the middle of a drawer (side None)."""
    if style.handle == "none":
        return []
    upright = side in ("left", "right")
    along, across = (rect.height, rect.width) if upright else (rect.width, rect.height)
    span = min(max(style.length * along, 0.05), 0.96 * along)
    if side is None:
        twin = style.handle != "lip" and span < 0.25 * along and along > 0.7
        y = rect.y1 - style.thick if style.handle == "lip" else rect.centre[1] + rng.choice([0, 0, 0.25]) * rect.height
        xs = rect.centre[0] + along * np.array([-0.25, 0.25] if twin else [0.0])
        return [m for x in xs for m in handle(rng, style, np.array([x, y, z]), span, False)]
    margin = style.thick if style.handle == "lip" else min(0.25 * across, style.thick + rng.uniform(0.02, 0.06))
    free = {"left": rect.x1 - margin, "right": rect.x0 + margin, "top": rect.y0 + margin, "bottom": rect.y1 - margin}[
        side
    ]
    if upright:
        room = (rect.height - span) / 2 * 0.9
        y = rect.centre[1] + room * rng.choice([-0.8, 0, 0, 0.3, 0.8])
        return handle(rng, style, np.array([free, y, z]), span, True)
    return handle(rng, style, np.array([rect.centre[0], free, z]), span, False)


def door(
    rng: np.random.Generator, style: Style, body: Link, rect: Rect, *,
    z: float, side: str, outer: bool, leaf: str = "cabinet_door_surface",
) -> Link:  # fmt: skip
    """A door whose front board fills rect, behind (inset) or before (overlay) the plane z where the carcass ends.

    The axis is on the front edge, about which a board turns without touching what is beside or behind it; on an
    outer edge it may lie deeper, flush with the carcass's side, and the door may open further than 90 degrees.
    """
    z0, z1 = style.depths(z)
    deep = outer and not style.inset and (style.front > 0.05 or rng.random() < 0.7)
    axis = z0 + style.front * rng.choice([0.0, 0.0 if style.front > 0.05 else 0.5]) if deep else z1
    link = Link("hinge rotation_door", "cabinet_door", body)
    edge = rect.shrink(-style.gap / 2) if deep else rect
    wide = outer and side in ("left", "right") and not (style.inset and style.recess)
    link.joint = hinge(side, edge, float(axis), style.swing if wide else np.pi / 2)
    for what, meshes in front_panel(rng, style.face, rect, z0, z1).items():
        link.add(leaf if what == "board" else "glass", *meshes)
    link.add("handle", *front_handle(rng, style, rect, z1, side))
    return link


def porthole(rng: np.random.Generator, style: Style, body: Link, cell: Rect, *, z: float, side: str, leaf: str) -> Link:
    """A round door, or one with round corners, at the hole of a panel that fills `cell`; often hollow as a dish is.

    The panel ends at z, or with the carcass's recess behind it.
    """
    z0, z1 = style.depths(z)
    r = cell.shrink(rng.uniform(0.03, 0.12) * min(cell.width, cell.height))
    if rng.random() < 0.7:
        spare = np.array([r.width, r.height]) - min(r.width, r.height)
        r = r.shrink(*spare / 2)
    half = min(r.width, r.height) / 2
    radius = half * rng.choice([1.0, rng.uniform(0.3, 1.0)], p=[0.7, 0.3])
    rim = half * rng.uniform(0.1, 0.25)
    inner, floor = r.shrink(rim), r.shrink(rim + half * rng.uniform(0.2, 0.4))
    # An inset leaf's far edge swings out past the hole's.
    slit = max(style.gap, 0.6 * style.front**2 / half)
    hole, front = (r.shrink(-slit), z1) if style.inset else (r.shrink(0.7 * rim), z0)

    def outline(q: Rect) -> np.ndarray:
        return rounded(q, radius * min(q.width, q.height) / (2 * half), start=0)

    body.add("frame", plate(cell, outline(hole), 2, front - style.board, front))

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
    link.joint = hinge(side, r, z1, np.pi / 2 if style.inset else max(style.swing, np.pi / 2))
    link.add(leaf, loft([ring_at(outline(q), 2, at) for q, at in rings]))
    if style.handle != "none":
        c, upright = r.centre, side in ("left", "right")
        reach = np.array([r.width, r.height]) / 2 - rim / 2
        toward = {"left": (1, 0), "right": (-1, 0), "bottom": (0, 1), "top": (0, -1)}[side]
        at = np.array([*(c + toward * reach), z1])
        link.add("handle", *handle(rng, style, at, 0.4 * half, upright))
    return link


def drawer(
    rng: np.random.Generator, style: Style, body: Link, front: Rect, inside: Rect, *, back: float, z: float
) -> Link:
    """A drawer: a front board filling `front` and an open box within the cell `inside`, from depth `back` to z."""
    z0, z1 = style.depths(z)
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
    kind = style.face if style.face in ("slab", "shaker", "raised") else "slab"
    for meshes in front_panel(rng, kind, front, z0, z1).values():
        link.add("drawer_front", *meshes)
    rear = z0 - depth
    link.add("drawer_side", board(low._replace(x1=low.x0 + wall), rear, z0))
    link.add("drawer_side", board(low._replace(x0=low.x1 - wall), rear, z0))
    link.add("drawer_back", board(low.shrink(wall, 0), rear, rear + wall))
    link.add("drawer_bottom", board(low.shrink(wall, 0)._replace(y1=low.y0 + wall), rear + wall, z0))
    link.add("handle", *front_handle(rng, style, front, z1, None))
    return link


def carcass(body: Link, rect: Rect, back: float, z: float, t: float, top: bool = True) -> None:
    """Five boards around rect, open at the front."""
    body.add("vertical_side_panel", board(rect._replace(x1=rect.x0 + t), back, z))
    body.add("vertical_side_panel", board(rect._replace(x0=rect.x1 - t), back, z))
    body.add("bottom_panel", board(rect.shrink(t, 0)._replace(y1=rect.y0 + t), back, z))
    body.add("back_panel", board(rect.shrink(t), back, back + 0.5 * t))
    if top:
        body.add("top_panel", board(rect.shrink(t, 0)._replace(y0=rect.y1 - t), back, z))
    else:
        body.add("frame_horizontal_bar", board(rect.shrink(t, 0)._replace(y0=rect.y1 - t), z - 0.1, z))


def legs(rng: np.random.Generator, kind: str, rect: Rect, lo: float, hi: float, width: float) -> list[Mesh]:
    """Four legs under the rectangle rect of x and z, from y = lo to hi."""
    inset = width * rng.uniform(0.55, 1.2)
    spots = [(x, z) for x in (rect.x0 + inset, rect.x1 - inset) for z in (rect.y0 + inset, rect.y1 - inset)]
    c, half, h = rect.centre, width / 2, hi - lo
    legs = []
    for x, z in spots:
        foot = Rect(x - half, z - half, x + half, z + half)
        if kind == "square":
            legs.append(prism(corners(foot), 1, lo, hi))
        elif kind == "tapered":
            legs.append(loft([ring_at(corners(q), 1, y) for q, y in ((foot.shrink(0.2 * width), lo), (foot, hi))]))
        elif kind == "turned":
            profile = [(0.5, 0), (0.7, 0.1), (0.45, 0.16), (0.55, 0.3), (0.95, 0.65), (0.6, 0.75), (1, 0.8), (1, 1)]
            legs.append(lathe([(half * a, h * b) for a, b in profile], np.array([x, lo, z]), 1, sides=12))
        elif kind == "splayed":
            out = 0.12 * h * np.sign([x - c[0], z - c[1]])
            legs.append(loft([ring_at(rounded(q, half), 1, y) for q, y in ((_shifted(foot, out), lo), (foot, hi))]))
        else:
            legs.append(prism(rounded(foot, half, 12), 1, lo, hi))
    return legs


def _shifted(r: Rect, by: np.ndarray) -> Rect:
    return Rect(r.x0 + by[0], r.y0 + by[1], r.x1 + by[0], r.y1 + by[1])


def rotate_about_y(links: list[Link], angle: float) -> list[Link]:
    """Turn links about y, in place. angle: rad."""
    c, s = np.cos(angle), np.sin(angle)
    r = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    for link in links:
        link.leaves = [(name, [Mesh(m.vertices @ r.T, m.faces) for m in meshes]) for name, meshes in link.leaves]
        if link.joint is not None:
            link.joint = Joint(r @ link.joint.origin, r @ link.joint.axis, link.joint.upper)
    return links


def mirror_in_depth(meshes: list[Mesh], z: float) -> list[Mesh]:
    """Meshes seen in a mirror at depth z."""
    return [Mesh(m.vertices * [1, 1, -1] + [0, 0, 2 * z], m.faces[:, ::-1]) for m in meshes]


def face_up(meshes: list[Mesh], at: np.ndarray) -> list[Mesh]:
    """Meshes made at the origin of a front that faces +z, moved to `at` [3] on a surface that faces +y."""
    return [Mesh(m.vertices[:, [0, 2, 1]] * [1, 1, -1] + at, m.faces) for m in meshes]


def sample_size(rng: np.random.Generator, *ranges: tuple[float, float]) -> np.ndarray:
    """Random proportions, as a size [3] with a diagonal of 2."""
    size = np.array([rng.uniform(*r) for r in ranges])
    return 2 * size / np.linalg.norm(size)


def set_semantics(link: Link, kind: str, name: str) -> None:
    """Name a link as its category does: kind in semantics.txt, name in mobility_v2.json."""
    link.kind, link.name = kind, name


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
