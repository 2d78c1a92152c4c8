"""Safes."""

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
    lever,
    relief,
    sample_size,
    set_semantics,
    weighted_choice,
)
from mjcf_assets.procedural.solids import Rect, board, hollow_block, lathe, rod


def safe(rng: np.random.Generator) -> list[Link]:
    """A safe with a thick door and a lock of dials, levers, wheels or buttons."""
    style = Style.sample(rng, {"none": 1}, {"slab": 3, "raised": 1})
    style.inset, style.front = bool(rng.random() < 0.6), style.sheet or rng.uniform(0.04, 0.1)
    style.swing = float(np.radians(rng.choice([90, 120, 160, 170])))
    w, h, d = sample_size(rng, (0.55, 1.15), (1, 1), (0.6, 1.1))
    body = Link("heavy safe_body", "base_body")
    low = rng.choice([0.0, rng.uniform(0.02, 0.1)])
    if low:
        body.add("base_body", *legs(rng, str(rng.choice(["square", "tapered"])), Rect(0, 0, w, d), 0, low, 0.12))
    shell = Rect(0, low, w, h)
    wall = rng.uniform(0.05, 0.12)
    hole = shell.shrink(wall)
    if rng.random() < 0.7:
        body.add("base_body", hollow_block(shell, hole, 0, wall, d, radius=rng.choice([0.0, 0.0, 0.06])))
    else:
        carcass(body, shell, 0, d, wall)
        body.leaves = [("base_body", meshes) for _, meshes in body.leaves]
    if rng.random() < 0.5:
        y = hole.y0 + hole.height * rng.uniform(0.35, 0.65)
        body.add("base_body", board(hole._replace(y0=y - 0.012, y1=y + 0.012), wall, style.depths(d)[0] - 0.06))
    style.gap = max(style.gap, 0.7 * style.front**2 / hole.width)
    front = hole.shrink(style.gap) if style.inset else shell.shrink(style.gap / 2)
    side = str(rng.choice(["left", "right"], p=[0.4, 0.6]))
    link = door(rng, style, body, front, z=d, side=side, outer=True, leaf="door")
    set_semantics(link, "hinge door", "door")
    z = style.depths(d)[1]
    if style.face == "raised":
        z += relief(style.front)
    sign = 1.0 if side == "left" else -1.0
    c = front.centre

    def spot(x: float, y: float) -> np.ndarray:
        """A point [3] on the door; x, y: shares of its width towards the free edge, of its height."""
        return np.array([c[0] + sign * x * front.width, c[1] + y * front.height, z])

    links = [link]
    lock = weighted_choice(
        rng, {"dial and lever": 2, "wheel and dial": 2, "keypad and lever": 2, "keypad": 1, "wheel": 1}
    )
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
