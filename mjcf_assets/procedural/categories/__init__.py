"""The categories of procedural objects: each a function that makes the links of one object from random numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mjcf_assets.procedural.categories.appliances import microwave, refrigerator
from mjcf_assets.procedural.categories.lidded_box import lidded_box
from mjcf_assets.procedural.categories.room_door import room_door
from mjcf_assets.procedural.categories.safe import safe
from mjcf_assets.procedural.categories.storage import storage_furniture
from mjcf_assets.procedural.categories.table import table
from mjcf_assets.procedural.categories.washing_machine import washing_machine
from mjcf_assets.procedural.components import Link


@dataclass(frozen=True)
class Category:
    """How objects of a category are made, which split they are in, and its number in the ids of restricted sets."""

    make: Callable[[np.random.Generator], list[Link]]  # the links of one object, its body last
    number: int  # 1 to 99, in ids; never that of another category, nor of one there was
    test_shape_every: int | None  # one in this many objects is a test shape, others train; None: a test category


CATEGORIES = {
    "StorageFurniture": Category(storage_furniture, number=1, test_shape_every=4),
    "Door": Category(room_door, number=2, test_shape_every=4),
    "Microwave": Category(microwave, number=3, test_shape_every=4),
    "Refrigerator": Category(refrigerator, number=4, test_shape_every=4),
    "Safe": Category(safe, number=5, test_shape_every=None),
    "Table": Category(table, number=6, test_shape_every=None),
    "WashingMachine": Category(washing_machine, number=7, test_shape_every=None),
    "Box": Category(lidded_box, number=8, test_shape_every=5),
}
