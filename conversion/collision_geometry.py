"""The one door to collision geometry: hulls or boxes of a rigid group that leave room for fingers behind handles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from conversion.box_fitting import fit_boxes
from conversion.config import DecomposeConfig
from conversion.decompose import decompose, merge_hulls
from conversion.finger_clearance import Handle, check_finger_clearance
from conversion.model import ArticulatedObject, ConvexShape, Part
from conversion.surface import Surface

FINER = 1, 3, 8  # shares of the handles' tolerances that are tried in turn


def collision_geometry(
    obj: ArticulatedObject, part: Part | None, surface: Surface, budget: int, config: DecomposeConfig
) -> tuple[list[ConvexShape], list[Handle]]:
    """At most `budget` hulls of one group (or twice as many boxes), and the handles on it where it is a part's.

    Handles through which a finger would no longer pass are made finer, and what is beside them too.
    """
    best: tuple[list[ConvexShape], list[Handle]] = [], []
    fewest = np.inf
    for finer in FINER:
        fine = replace(
            config,
            handle_tolerance=config.handle_tolerance / finer,
            handle_merge_tolerance=config.handle_merge_tolerance / finer,
        )
        shapes = decompose(surface, budget, fine)
        if config.collision == "box":
            shapes = fit_boxes(surface, shapes, 2 * budget, fine)
        handles = check_finger_clearance(obj, part, shapes) if part else []
        lost = sum(h.clear_in_mesh and not h.clear_in_hulls for h in handles)
        if lost < fewest:
            best, fewest = (shapes, handles), lost
        if not lost:
            break
    return best


def merged_geometry(
    surface: Surface, shapes: list[ConvexShape], budget: int, config: DecomposeConfig
) -> tuple[list[int], list[ConvexShape]]:
    """Shapes of several groups as at most `budget`: which of them stay as they are, and new ones for the others.

    Merged boxes become boxes again, which may take more than the budget.
    """
    kept, new = merge_hulls(surface, shapes, budget, config)
    return kept, fit_boxes(surface, new, 2 * len(new), config) if config.collision == "box" else new
