"""Banks of hulls that are boxes, as box banks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vatmart_jax.data.banks import SceneBank


def as_boxes(bank: SceneBank) -> SceneBank:
    """The same Scenes with oriented boxes, for hulls that are boxes about their origins."""
    sizes = np.stack([bank.hull(g).max(0) for g in range(len(bank.hull_start) - 1)])
    empty = {"hull_vertices": np.zeros((0, 3), np.float32), "hull_start": np.zeros(1, np.int32)}
    return replace(bank, collision="box", box_size=sizes, **empty)
