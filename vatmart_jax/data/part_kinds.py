"""Kinds of moving parts: what joint they have, and how far a task moves them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vatmart_jax.registry import Registry

HINGE, SLIDE = 0, 1  # types of joints


@dataclass(frozen=True, kw_only=True)
class PartKind:
    """One kind of moving part, by the name that a SceneBank has in `part_kind`."""

    name: str
    joint_type: int  # HINGE or SLIDE
    goal_range: tuple[float, float]  # how far a task moves the part, rad or unit lengths (section 3 of the paper)
    relabel_range: float  # goals of the scorer's negatives are off by up to this much


_SWING = {"goal_range": (float(np.deg2rad(10)), float(np.deg2rad(70))), "relabel_range": float(np.deg2rad(45))}

PART_KINDS: Registry[PartKind] = Registry("part kind")
PART_KINDS.register("door", PartKind(name="door", joint_type=HINGE, **_SWING))
PART_KINDS.register("drawer", PartKind(name="drawer", joint_type=SLIDE, goal_range=(0.1, 0.7), relabel_range=0.45))
PART_KINDS.register("lid", PartKind(name="lid", joint_type=HINGE, **_SWING))
