"""The splits of a converted folder, and the training splits of more of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vatmart_jax.data.banks import SceneBank, ViewBank
from vatmart_jax.data.cache import DataError
from vatmart_jax.envs.env import Env, EnvConfig, Task
from vatmart_jax.errors import UserError
from vatmart_jax.physics import PhysicsConfig

SPLITS = ("train", "test_shapes", "test_categories")


class Data:
    """The banks of one converted folder, and the training splits of more of them."""

    def __init__(self, folder: Path, *more: Path):
        """Raises BankError where the banks are missing or damaged, DataError where they cannot be trained on together:
        their arrays do not fit, or `more` would train on a test object."""
        self.folder = folder
        self._scenes, self._views = _banks(folder)
        if more:
            self._join(more)

    def _join(self, more: Sequence[Path]) -> None:
        scenes, views = [self._scenes], [self._views]
        tests = set(self._scenes.object_id[np.isin(self._scenes.split, SPLITS[1:])])
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
            self._scenes = SceneBank.joined(scenes)
            self._views = ViewBank.joined(views, [len(bank) for bank in scenes])
        except ValueError as e:
            folders = ", ".join(map(str, (self.folder, *more)))
            raise DataError(f"{folders}: cannot be trained on together: {e}; convert them with the same flags") from e

    def env(self, split: str, task: Task, impl: str, config: EnvConfig, physics: PhysicsConfig) -> Env:
        """The environment of one split. Raises DataError where the split has nothing for the task."""
        chosen = np.flatnonzero(self._scenes.split == split)
        if len(chosen) == 0:
            raise DataError(f"{self.folder}: has no object of the split {split}; see splits.json")
        try:
            return Env(self._scenes.select(chosen), self._views.of_scenes(chosen), task, impl, config, physics)
        except UserError as e:
            raise DataError(f"{self.folder}, split {split}: {e}") from e


def _banks(folder: Path) -> tuple[SceneBank, ViewBank]:
    return SceneBank.load(folder / "scenes.npz"), ViewBank.load(folder / "views.npz")
