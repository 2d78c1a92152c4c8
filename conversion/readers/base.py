"""The protocol of object readers, and the folder they read from."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from conversion.config import ReadConfig
from conversion.model import ArticulatedObject, ObjectError

MAX_COORDINATE = 1e3  # objects are normalised to about 2 unit lengths; anything near this is damage
MAX_FILE_BYTES = 256 * 2**20
HANDLE_WORDS = ("handle", "knob", "pull")


class ObjectReader(Protocol):
    """How the objects of one data set are read. Register an instance in `conversion.readers.READERS`.

    An object comes out in the object frame of this project: z up, front towards -x, extents of 1 to 2 unit lengths.
    """

    name: str

    def detects(self, folder: Path) -> bool:
        """Whether this folder is an object of this reader's layout. Must not raise."""
        ...

    def files(self, folder: Path, config: ReadConfig) -> Iterable[Path]:
        """Every file below the folder that `read` may open: what the cache key hashes."""
        ...

    def read(self, folder: Path, config: ReadConfig) -> ArticulatedObject:
        """Raises ObjectError in one line that names the file, the thing and the remedy."""
        ...


def is_handle(name: str) -> bool:
    """Whether a visual or link of this name is a handle, knob or pull."""
    return any(word in name.lower() for word in HANDLE_WORDS)


@dataclass
class ObjectFolder:
    """One object folder: files by name, none of them outside of it, and errors that name the file."""

    folder: Path
    config: ReadConfig
    notes: list[str] = field(default_factory=list)

    def error(self, what: str, file: str) -> ObjectError:
        return ObjectError(f"{self.folder.name}/{file}: {what}")

    def path(self, name: str, user: str) -> Path:
        """The file of this name inside the folder; one that leads out of it is refused, whatever the way."""
        path = self.folder / name
        try:
            inside = path.resolve().is_relative_to(self.folder.resolve())
        except (OSError, RuntimeError, ValueError):  # loops of links, NUL bytes, names too long
            inside = False
        if not inside or Path(name).is_absolute():
            raise self.error(f"path {name!r} leaves the object's folder; use one inside it", user)
        if path.is_file() and path.stat().st_size > MAX_FILE_BYTES:
            raise self.error(f"larger than {MAX_FILE_BYTES >> 20} MiB; simplify it", name)
        return path

    def note(self, what: str) -> None:
        """Once, however many files give rise to it."""
        if what not in self.notes:
            self.notes.append(what)

    def text(self, name: str) -> str | None:
        """A small side file, or None where it is missing or unreadable: nothing depends on one alone."""
        try:
            return self.path(name, name).read_text(errors="replace")
        except (OSError, ObjectError):
            return None

    def json(self, name: str) -> Any:
        try:
            return json.loads(self.text(name) or "null")
        except (ValueError, RecursionError):
            self.notes.append(f"{name} is not JSON, ignored")
            return None
