"""Columns of SceneBank and ViewBank that the environments read, under the names of either version of the banks."""

from __future__ import annotations

from typing import Any

import numpy as np

from vatmart_jax.data import banks
from vatmart_jax.data.banks import SLIDE, SceneBank, ViewBank
from vatmart_jax.physics.scene_model import joint_range

__all__ = ["direction", "joint_pos", "joint_range", "part_kind", "scene_table"]


def part_kind(bank: SceneBank) -> np.ndarray:
    """[S] str: door, drawer, lid; by joint type where the bank has no such column."""
    return getattr(bank, "part_kind", np.where(bank.joint_type == SLIDE, "drawer", "door"))


def joint_pos(views: ViewBank) -> np.ndarray:
    """[V] float32, rad or unit lengths away from closed."""
    return views.joint_pos if hasattr(views, "joint_pos") else views.q


def direction(views: ViewBank) -> np.ndarray:
    """[V] int: +1 drawn for tasks that open, -1 for those that close."""
    return views.direction if hasattr(views, "direction") else np.where(views.opening, 1, -1)


def scene_table(bank: SceneBank) -> Any:
    """The joints on device: axis [S, 3], anchor [S, 3], range [S]."""
    return banks.SceneTable.from_bank(bank) if hasattr(banks, "SceneTable") else banks.Scenes.of(bank)
