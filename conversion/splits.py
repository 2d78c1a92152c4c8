"""Which split an object belongs to: what splits.json says, else its category."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

SPLITS = ("train", "test_shapes", "test_categories", "extra")
TRAIN_CATEGORIES = ("StorageFurniture", "Door", "Microwave", "Refrigerator")  # paper, section 4.1
TEST_CATEGORIES = ("Safe", "Table", "WashingMachine")


def read_splits(sources: Sequence[Path]) -> dict[str, str]:
    """Split by object id, from splits.json in a source folder or beside it."""
    out: dict[str, str] = {}
    for source in sources:
        for folder in (source, source.parent):
            table = read_json(folder / "splits.json")
            for split in SPLITS:
                for ids in (table.get(split) or {}).values():
                    out.update({str(i): split for i in ids})
    return out


def default_split(category: str, object_id: str) -> str:
    """The paper's categories; of the training ones, one object in five (by a hash of its id) is a test shape."""
    if category in TEST_CATEGORIES:
        return "test_categories"
    if category not in TRAIN_CATEGORIES:
        return "extra"
    return "test_shapes" if hashlib.sha256(object_id.encode()).digest()[0] % 5 == 0 else "train"


def read_json(path: Path) -> dict[str, Any]:
    """The object of a JSON file, {} where the file is missing or broken."""
    try:
        out = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return out if isinstance(out, dict) else {}
