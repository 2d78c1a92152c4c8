"""Files and folders that are there complete or not at all: written beside their place, then moved into it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def whole(path: Path | str) -> Iterator[Path]:
    """Where to write a file: what the block leaves there becomes `path`, unless the block raises.

    The name ends in .part, whatever the suffix of `path`: say the format to what would guess it.
    """
    path = Path(path)
    part = path.with_name(f"{path.name}.part")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: Path | str) -> Iterator[Path]:
    """A new folder to write into: it becomes `path` (in place of one that is there), unless the block raises."""
    path = Path(path)
    part, old = (path.with_name(f".{path.name}.{end}") for end in ("part", "old"))
    _remove(part, old)  # what a killed process left
    try:
        part.mkdir(parents=True)
        yield part
        if path.exists():
            path.replace(old)
        part.replace(path)
    finally:
        _remove(part, old)


def write_bytes(path: Path, content: bytes) -> None:
    with whole(path) as part:
        part.write_bytes(content)


def write_text(path: Path, text: str) -> None:
    write_bytes(path, text.encode())


def write_json(path: Path, value: Any) -> None:
    write_text(path, json.dumps(value, indent=2) + "\n")


def _remove(*folders: Path) -> None:
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)
