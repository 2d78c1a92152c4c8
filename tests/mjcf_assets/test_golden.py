"""Objects of a seed are a data set that results refer to: their meshes and semantics stay the same bytes."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from mjcf_assets.procedural.generate import generate

# Index of an object of seed 0, its category, and the hash of its semantics.txt and meshes. One of each category.
GOLDEN = {
    0: ("StorageFurniture", "358bcb929acc4700"),
    1: ("Refrigerator", "5301fbb6d6fe5798"),
    3: ("Table", "84e6b3f1ceef8319"),
    4: ("Microwave", "e3287ec08e0626fc"),
    6: ("Door", "1ca8024c8361881c"),
    7: ("Safe", "56449af3f44ca02a"),
    9: ("WashingMachine", "59981d6c02cf588c"),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("golden")
    generate(out, 10, seed=0)
    return out


def digest(folder: Path) -> str:
    files = [folder / "semantics.txt", *sorted((folder / "textured_objs").iterdir())]
    content = hashlib.sha256()
    for file in files:
        content.update(file.name.encode() + b"\n" + file.read_bytes())
    return content.hexdigest()[:16]


@pytest.mark.parametrize("index", GOLDEN)
def test_objects_of_a_seed_stay_the_same(folder, index):
    category, expected = GOLDEN[index]
    path = folder / f"9000{index:05d}"
    assert f'"model_cat": "{category}"' in (path / "meta.json").read_text()
    assert digest(path) == expected
