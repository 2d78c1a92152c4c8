"""The categories of procedural objects: each a function that makes the links of one object from random numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mjcf_assets.procedural.categories.appliances import microwave, refrigerator
from mjcf_assets.procedural.categories.room_door import room_door
from mjcf_assets.procedural.categories.safe import safe
from mjcf_assets.procedural.categories.storage import storage_furniture
from mjcf_assets.procedural.categories.table import table
from mjcf_assets.procedural.categories.washing_machine import washing_machine
from mjcf_assets.procedural.components import Link


@dataclass(frozen=True)
class Category:
    """How objects of a category are made and which split they are in."""

    make: Callable[[np.random.Generator], list[Link]]  # the links of one object, its body last
    test_shape_every: int | None  # one in this many objects is a test shape, others train; None: a test category


CATEGORIES = {
    "StorageFurniture": Category(storage_furniture, 4),
    "Door": Category(room_door, 4),
    "Microwave": Category(microwave, 4),
    "Refrigerator": Category(refrigerator, 4),
    "Safe": Category(safe, None),
    "Table": Category(table, None),
    "WashingMachine": Category(washing_machine, None),
}
