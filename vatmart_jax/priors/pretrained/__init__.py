"""Priors that come with the package, by name: one run folder each, without what only a run needs to go on.

All but `generated-*` were trained on PartNet-Mobility's objects: see README.md beside this file for its terms.
"""

from __future__ import annotations

from pathlib import Path

from vatmart_jax.errors import UserError

FOLDER = Path(__file__).parent


def names() -> list[str]:
    """What can be given where a run folder is expected."""
    return sorted(path.parent.name for path in FOLDER.glob("*/config.json"))


def run_folder(run: Path) -> Path:
    """`run` itself where there is such a folder, else the pretrained one of that name.

    Raises UserError where there is neither.
    """
    if run.is_dir():
        return run
    if str(run) in names():
        return FOLDER / str(run)
    known = f", nor pretrained priors ({', '.join(names())})" if names() else ""
    raise UserError(f"{run}: no such run folder{known}; give the --out folder of `vatmart train`")


def is_external(folder: Path) -> bool:
    """Whether a folder is of a pretrained set whose training objects are not in the package."""
    return folder.resolve().parent == FOLDER.resolve() and not folder.name.startswith("generated-")
