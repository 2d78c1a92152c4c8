"""`vatmart convert`: the flags and what they do."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from conversion.config import ConvertConfig
from conversion.convert import convert
from conversion.model import ObjectError


@dataclass(frozen=True, kw_only=True)
class Convert:
    """Convert PartNet-Mobility objects to MJCF, reports and banks. What is up to date is left as it is."""

    src: Positional[tuple[Path, ...]]
    """object folders, or folders of such folders"""
    out: Path
    jobs: int | None = None
    """processes; default one per core"""
    json: Annotated[bool, arg(help="print one JSON object as the last line of standard output")] = False
    config: Annotated[ConvertConfig, arg(name="")] = field(default_factory=ConvertConfig)

    def run(self) -> dict[str, Any]:
        """Convert; returns what `--json` prints. Raises ObjectError."""
        if not self.src:
            raise ObjectError("no source; give one or more object folders, or folders of such folders")
        return asdict(convert(self.src, self.out, self.config, self.jobs))
