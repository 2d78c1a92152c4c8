"""Trained priors: load, save, predict, export."""

from __future__ import annotations

from pathlib import Path

from vatmart_jax.priors.pretrained import run_folder
from vatmart_jax.priors.priors import Prediction, Priors, PriorsConfig, PriorsError

__all__ = ["Prediction", "Priors", "PriorsConfig", "PriorsError", "load_priors"]


def load_priors(path: Path | str) -> Priors:
    """Priors of a run folder, of a folder of priors, or pretrained ones by name, such as push-door.

    Raises UserError where there is none.
    """
    return Priors.load(run_folder(Path(path)))
