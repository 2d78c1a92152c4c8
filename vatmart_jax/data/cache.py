"""The cache folder, and data prepared in it: of several runs that want the same data at once, one makes it."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path

from filelock import FileLock, Timeout

from vatmart_jax.errors import UserError

WANTED = "expected a folder of objects or what `vatmart convert` made of it"


class DataError(UserError):
    """A data folder cannot be used."""


def cache_folder() -> Path:
    """Where generated objects, conversions and compiled programs are kept between runs."""
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "vatmart_jax"


def bundled_folder(version: int, count: int, seed: int) -> Path:
    """Where the bundled objects lie that this version of the generator makes."""
    return cache_folder() / f"objects-v{version}-{count}-{seed}"


def is_converted(folder: Path) -> bool:
    """Whether the folder is what `vatmart convert` makes. Raises DataError where there is none."""
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder; {WANTED}")
    return (folder / "scenes.npz").is_file()


def converted_folder(
    source: Path, make: Callable[[Path], None], inform: Callable[[str], None] = lambda line: None
) -> Path:
    """The folder in the cache for what is converted from `source`, after `make(folder)` has brought it up to date.

    Of several processes that want it at once, one makes it; the others `inform` that they wait, and do.
    """
    out = cache_folder() / "converted" / hashlib.sha256(str(source.resolve()).encode()).hexdigest()[:16]
    out.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(out.with_suffix(".lock"))
    try:
        held = lock.acquire(timeout=0)
    except Timeout:
        inform(f"waiting for another run that converts {source}")
        held = lock.acquire()
    with held:
        make(out)
    return out
