"""Procedural articulated objects in PartNet-Mobility's own on-disk layout, in the seven categories of the paper.

They need no licence, and take the same road as real objects: `vatmart generate`, then `vatmart convert`. Object i of
a seed depends on the seed and i alone.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from mjcf_assets.output_folder import GeneratorError, make_output_folder
from mjcf_assets.procedural.categories import CATEGORIES
from mjcf_assets.procedural.partnet_writer import write_object
from vatmart_jax.files import write_text

# The order in which categories come: each of them early, and in proportions like those of the real set.
CYCLE = (
    "StorageFurniture", "Refrigerator", "StorageFurniture", "Table", "Microwave", "StorageFurniture", "Door", "Safe",
    "StorageFurniture", "WashingMachine", "Microwave", "StorageFurniture", "Refrigerator", "Table", "StorageFurniture",
    "Door", "Table", "StorageFurniture", "Safe", "Table",
)  # fmt: skip


def generate(out: Path, count: int, seed: int) -> list[str]:
    """Write `count` object folders and splits.json into `out`; returns the ids, which name the folders.

    One in four objects of a training category is a test shape; Safe, Table and WashingMachine are test categories.
    Raises GeneratorError where an argument is out of range or `out` is not empty of other objects.
    """
    out = Path(out)
    if not 1 <= count < 100_000 or seed < 0:
        raise GeneratorError(f"--count {count} --seed {seed}: expected 1 <= count < 100000 and seed >= 0")
    ids = [f"9{seed:03d}{i:05d}" for i in range(count)]
    make_output_folder(out, ids)
    splits = {name: {} for name in ("train", "test_shapes", "test_categories", "extra")}
    seen = dict.fromkeys(CYCLE, 0)
    for i, name in enumerate(ids):
        category = CYCLE[i % len(CYCLE)]
        seen[category] += 1
        every = CATEGORIES[category].test_shape_every
        split = "test_categories" if every is None else "test_shapes" if seen[category] % every == 2 else "train"
        splits[split].setdefault(category, []).append(name)
        rng = np.random.default_rng([seed, i])
        write_object(out / name, category, CATEGORIES[category].make(rng), rng)
    write_text(out / "splits.json", json.dumps(splits))
    return ids
