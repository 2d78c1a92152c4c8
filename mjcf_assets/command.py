"""`vatmart generate`: the flags and what they do."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from mjcf_assets.output_folder import GeneratorError
from mjcf_assets.procedural.generate import generate
from mjcf_assets.stretch import anisotropic_copies


@dataclass(frozen=True)
class Generate:
    """Make objects in PartNet-Mobility's layout, the same ones for the same seed."""

    out: Path
    count: int | None = None
    """objects, default 200; with --stretch copies of each, default 4"""
    stretch: Path | None = None
    """instead of procedural objects, copies of the training objects in this folder, stretched along their axes"""
    categories: str | None = None
    """of procedural objects, joined by commas, such as Box,Safe; default the seven of the paper"""
    seed: int = 0
    json: Annotated[bool, arg(help="print one JSON object as the last line of standard output")] = False

    def run(self) -> dict[str, Any]:
        """Make the objects; returns what `--json` prints. Raises GeneratorError."""
        start = time.monotonic()
        if self.stretch is not None and self.categories is not None:
            raise GeneratorError(
                "--categories: of no use with --stretch, whose objects are those of a folder; drop one"
            )
        if self.stretch is None:
            categories = None if self.categories is None else self.categories.split(",")
            ids = generate(self.out, 200 if self.count is None else self.count, self.seed, categories)
        else:
            ids = anisotropic_copies(self.stretch, self.out, 4 if self.count is None else self.count, self.seed)
        return {"objects": len(ids), "seconds": round(time.monotonic() - start, 2)}
