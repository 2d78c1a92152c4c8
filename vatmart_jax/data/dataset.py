"""The splits of a converted folder, and the training splits of more of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vatmart_jax.data.banks import SceneBank, ViewBank
from vatmart_jax.data.cache import DataError

SPLITS = ("train", "test_shapes", "test_categories")


class Data:
    """The banks of one converted folder, and the training splits of more of them."""

    def __init__(self, folder: Path, *more: Path):
        """Raises BankError where the banks are missing or damaged, DataError where they cannot be trained on together:
        their arrays do not fit, or `more` would train on a test object."""
        self.folder = folder
        self.scenes, self.views = _banks(folder)
        if more:
            self._join(more)

    def _join(self, more: Sequence[Path]) -> None:
        scenes, views = [self.scenes], [self.views]
        tests = set(self.scenes.object_id[np.isin(self.scenes.split, SPLITS[1:])])
        for other in more:
            bank, its_views = _banks(other)
            chosen = np.flatnonzero(bank.split == SPLITS[0])
            if seen := sorted(tests & set(bank.object_id[chosen])):
                raise DataError(
                    f"{other}: would train on {seen[0]}, which {self.folder} has for the test; see splits.json of both"
                )
            scenes.append(bank.select(chosen))
            views.append(its_views.of_scenes(chosen))
        try:
            self.scenes = SceneBank.concatenate(scenes)
            self.views = ViewBank.concatenate(views, [len(bank) for bank in scenes])
        except ValueError as e:
            folders = ", ".join(map(str, (self.folder, *more)))
            raise DataError(f"{folders}: cannot be trained on together: {e}; convert them with the same flags") from e

    def splits(self) -> dict[str, np.ndarray]:
        """The Scenes [n] int of each of SPLITS that has some."""
        found = {split: np.flatnonzero(self.scenes.split == split) for split in SPLITS}
        return {split: scenes for split, scenes in found.items() if len(scenes)}


def _banks(folder: Path) -> tuple[SceneBank, ViewBank]:
    return SceneBank.load(folder / "scenes.npz"), ViewBank.load(folder / "views.npz")
