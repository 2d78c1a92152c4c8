"""Procedural articulated objects in PartNet-Mobility's own on-disk layout: the paper's seven categories, and boxes.

They need no licence and are used as real objects are: `vatmart generate`, then `vatmart convert`. Categories beyond
the paper's are made on request only, so that the objects of a seed stay the same as categories are added.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mjcf_assets.output_folder import GeneratorError, make_output_folder
from mjcf_assets.procedural.categories import CATEGORIES
from mjcf_assets.procedural.partnet_writer import write_object
from vatmart_jax.atomic_io import write_text

GENERATOR_VERSION = 1
"""Rises whenever the objects of a seed change: what is cached of them is made again."""

# The order in which categories come: each of them early, and in proportions like those of the real set.
CYCLE = (
    "StorageFurniture", "Refrigerator", "StorageFurniture", "Table", "Microwave", "StorageFurniture", "Door", "Safe",
    "StorageFurniture", "WashingMachine", "Microwave", "StorageFurniture", "Refrigerator", "Table", "StorageFurniture",
    "Door", "Table", "StorageFurniture", "Safe", "Table",
)  # fmt: skip


def generate(out: Path, count: int, seed: int, categories: Sequence[str] | None = None) -> list[str]:
    """Write `count` object folders and splits.json into `out`; returns the ids, which name the folders.

    categories: names in CATEGORIES, which take turns; default those of CYCLE. One in four objects of a training
    category is a test shape, one in five of Box; Safe, Table and WashingMachine are test categories. Raises
    GeneratorError where an argument is out of range or `out` is not empty of other objects.
    """
    out = Path(out)
    if not 1 <= count < 100_000 or seed < 0:
        raise GeneratorError(f"--count {count} --seed {seed}: expected 1 <= count < 100000 and seed >= 0")
    objects = _of_cycle(count, seed) if categories is None else _of_categories(count, seed, categories)
    make_output_folder(out, [x.id for x in objects])
    splits = {name: {} for name in ("train", "test_shapes", "test_categories", "extra")}
    for x in objects:
        category = CATEGORIES[x.category]
        every = category.test_shape_every
        split = "test_categories" if every is None else "test_shapes" if x.nth % every == 1 else "train"
        splits[split].setdefault(x.category, []).append(x.id)
        rng = np.random.default_rng(x.entropy)
        write_object(out / x.id, x.category, category.make(rng), rng)
    write_text(out / "splits.json", json.dumps(splits))
    return [x.id for x in objects]


class _Object(NamedTuple):
    id: str
    category: str
    nth: int  # of the set's objects of this category, from 0
    entropy: tuple[int, ...]  # what its random numbers are drawn from


def _of_cycle(count: int, seed: int) -> list[_Object]:
    """The seven categories in the proportions of CYCLE. Object i of a seed depends on the seed and i alone."""
    names = [CYCLE[i % len(CYCLE)] for i in range(count)]
    return [
        _Object(f"9{seed:03d}{i:05d}", name, n, (seed, i))
        for i, (name, n) in enumerate(zip(names, _ranks(names), strict=True))
    ]


def _of_categories(count: int, seed: int, categories: Sequence[str]) -> list[_Object]:
    """The categories in turn. Object n of a category depends on the seed, the category and n alone.

    No object of CYCLE has its id.
    """
    if isinstance(categories, str) or not categories or set(categories) - set(CATEGORIES):
        raise GeneratorError(f"categories {categories!r}: expected some of {', '.join(CATEGORIES)}")
    names = [categories[i % len(categories)] for i in range(count)]
    objects = []
    for name, n in zip(names, _ranks(names), strict=True):
        number = CATEGORIES[name].number
        objects.append(_Object(f"8{seed:03d}{number:02d}{n:05d}", name, n, (seed, n, number)))
    return objects


def _ranks(names: Sequence[str]) -> list[int]:
    """For each name how many of the same come before it."""
    seen = Counter()
    ranks = []
    for name in names:
        ranks.append(seen[name])
        seen[name] += 1
    return ranks
