"""The folder that generated objects are written into."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from vatmart_jax.errors import UserError


class GeneratorError(UserError):
    """The arguments or the output folder cannot be used."""


def make_output_folder(out: Path, ids: Collection[str]) -> None:
    """Make the folder that is to hold the objects `ids`. Raises GeneratorError where it holds others."""
    out.mkdir(parents=True, exist_ok=True)
    others = sorted(p.parent.name for p in out.glob("*/mobility.urdf") if p.parent.name not in ids)
    if others:
        raise GeneratorError(f"{out}: holds other objects ({others[0]}, ...); choose an empty folder")
