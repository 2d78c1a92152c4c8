"""Object readers by name. A folder is read by the first registered one that detects it."""

from __future__ import annotations

from pathlib import Path

from conversion.config import ReadConfig
from conversion.model import ArticulatedObject
from conversion.readers.base import ObjectReader
from vatmart_jax.registry import Registry

READERS: Registry[ObjectReader] = Registry("object reader")
READERS.register("partnet-mobility", "conversion.readers.partnet_mobility:READER")


def is_object(folder: Path) -> bool:
    """Whether any reader detects this folder."""
    return any(READERS.get(name).detects(folder) for name in READERS.names())


def reader_of(folder: Path) -> ObjectReader:
    """The reader of a folder; where none detects it, PartNet-Mobility's, whose errors name what is missing."""
    detected = (READERS.get(name) for name in READERS.names() if READERS.get(name).detects(folder))
    return next(detected, READERS.get("partnet-mobility"))


def read_object(folder: Path, config: ReadConfig | None = None) -> ArticulatedObject:
    """Read one object folder with the reader that detects it. Raises ObjectError."""
    return reader_of(folder).read(Path(folder), config or ReadConfig())
