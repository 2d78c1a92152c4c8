"""`vatmart export`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from vatmart_jax.cli.common import JsonFlag, names
from vatmart_jax.errors import require_positive
from vatmart_jax.priors.export import FORMATS, export
from vatmart_jax.priors.pretrained import run_folder
from vatmart_jax.priors.priors import Priors


@dataclass(frozen=True)
class Export:
    """Write the priors of a run into a folder that needs nothing else."""

    source: Annotated[Positional[Path], arg(metavar="RUN")]
    """run folder of `vatmart train`, a folder of priors, or the name of pretrained ones, such as push-door"""
    out: Path
    format: str = "flax,stablehlo"
    """flax (loads with Priors.load), stablehlo (loads with jax.export.deserialize), or both"""
    proposals: int = 100
    """trajectories that the StableHLO function returns"""
    json: JsonFlag = False

    def run(self) -> dict[str, Any]:
        formats = names("--format", self.format, FORMATS)
        require_positive("--proposals", self.proposals)
        files = export(Priors.load(run_folder(self.source)), self.out, formats, self.proposals)
        return {"files": [str(f) for f in files]}
