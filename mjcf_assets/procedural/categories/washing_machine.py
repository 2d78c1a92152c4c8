"""Washing machines, loaded from the front or from above."""

from __future__ import annotations

import numpy as np

from mjcf_assets.procedural.components import Joint, Link, button, knob, sample_size
from mjcf_assets.procedural.solids import Rect, board, box, circle, corners, frame, lathe, plate, prism, rounded, sweep


def washing_machine(rng: np.random.Generator) -> list[Link]:
    """A washing machine with a round door in its front, or with a lid."""
    w, h, d = sample_size(rng, (0.65, 1.0), (1, 1), (0.6, 0.95))
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
