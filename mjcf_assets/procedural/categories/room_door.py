"""Doors of rooms, in their frames."""

from __future__ import annotations

import numpy as np

from mjcf_assets.procedural.components import (
    Link,
    Style,
    door,
    front_panel,
    lever,
    mirror_in_depth,
    rotate_about_y,
    sample_size,
    set_semantics,
)
from mjcf_assets.procedural.solids import Rect, box, lathe, prism


def room_door(rng: np.random.Generator) -> list[Link]:
    """One or two leaves in a frame without a wall, opening towards its front or away from it."""
    faces = {"slab": 2, "shaker": 2, "raised": 1, "glass": 1.5, "louvre": 0.5}
    style = Style.sample(rng, {"bar": 1.5, "arc": 1, "knob": 2, "rail": 0.5, "none": 3}, faces)
    style.inset, style.front, style.gap = True, style.sheet or rng.uniform(0.02, 0.06), max(style.gap, 0.008)
    style.length = min(style.length, 0.4)
    double = rng.random() < 0.35
    w, h, d = sample_size(rng, (0.6, 1.1) if double else (0.35, 0.65), (1, 1), (0.04, 0.14))
    style.recess = float(rng.choice([0.0, rng.uniform(0, max(d - style.front, 0))]))
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
        for what, meshes in front_panel(rng, "glass", side_panel, 0.3 * d, 0.7 * d).items():
            body.add("fixed_part" if what == "board" else "glass", *meshes)
    z0, z1 = style.depths(d)
    if rng.random() < 0.3:
        body.add("fixed_part", box((jamb, 0, 0), (w - jamb, 0.012, max(z0 - 0.01, 0.01))))
    x = inside.centre[0]
    rects = [(inside, str(rng.choice(["left", "right"])))]
    if double:
        rects = [(inside._replace(x1=x), "left"), (inside._replace(x0=x), "right")]
        if rng.random() < 0.3:
            del rects[int(rng.integers(2))]  # a doorway wider than its one leaf
    links = []
    levers = style.handle == "none" and rng.random() < 0.7
    both_sides = rng.random() < 0.5
    for r, side in rects:
        front = r.shrink(style.gap, 0)._replace(y0=0.015, y1=r.y1 - style.gap)
        link = door(rng, style, body, front, z=d, side=side, outer=False, leaf="surface_board")
        set_semantics(link, "hinge rotation_door", "surface_board")
        links.append(link)
        if both_sides and link.leaves[-1][0] == "handle":
            link.add("handle", *mirror_in_depth(link.leaves[-1][1], (z0 + z1) / 2))
        hinge_x = front.x1 if side == "right" else front.x0
        for y in (0.15, 0.85) if style.recess == 0 and rng.random() < 0.5 else ():
            at = np.array([hinge_x, front.y0 + y * front.height - 0.04, d])
            link.add("hinge", lathe([(0.9 * style.gap, 0), (0.9 * style.gap, 0.08)], at, 1))
        if levers:
            sign = 1.0 if side == "left" else -1.0
            at = np.array([front.x1 - 0.05 if side == "left" else front.x0 + 0.05, front.centre[1], z1])
            turn = lever(rng, link, at + np.array([0, 0, 0.011]), min(0.15, 0.4 * front.width), -sign, "movable_part")
            rose = [lathe([(0.028, 0), (0.024, 0.01)], at, 2)]
            if both_sides:
                rose += mirror_in_depth(rose, (z0 + z1) / 2)
                turn.add("movable_part", *mirror_in_depth(turn.leaves[0][1], (z0 + z1) / 2))
            link.add("fixed_part", *rose)
            links.append(turn)
    return rotate_about_y([*links, body], np.pi if rng.random() < 0.4 else 0.0)
