"""Where training data comes from: a converted folder, a folder of objects, or the bundled generated objects."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from filelock import FileLock, Timeout

from vatmart_jax import __version__
from vatmart_jax.data.banks import SceneBank, ViewBank
from vatmart_jax.envs import Env, EnvConfig, Task, make_env
from vatmart_jax.errors import UserError
from vatmart_jax.physics import PhysicsConfig

BUNDLED_COUNT, BUNDLED_SEED = 50, 0
SPLITS = ("train", "test_shapes", "test_categories")


_WANTED = "--data takes a folder of objects or what `vatmart convert` made of it"


class DataError(UserError):
    """A data folder cannot be used."""


def cache_folder() -> Path:
    """Where generated objects, conversions and compiled programs are kept between runs."""
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "vatmart_jax"


def prepare(
    data: Path | None,
    convert: Callable[[Path, Path], None],
    generate: Callable[[Path], None],
    say: Callable[[str], None] = lambda line: None,
) -> Path:
    """The converted folder (scenes.npz, views.npz) for `data`, made in the cache where it does not exist yet.

    Of several runs that want the same data at once, one makes it; the others `say` that they wait, and do.

    data: a converted folder, a folder of PartNet-Mobility objects, or None for the bundled objects.
    convert(source, out) and generate(out) do the work. Raises DataError where `data` is neither.
    """
    source = data or cache_folder() / f"objects-{__version__}-{BUNDLED_COUNT}-{BUNDLED_SEED}"
    if data is not None:
        if not data.is_dir():
            raise DataError(f"{data}: no such folder; {_WANTED}")
        if (data / "scenes.npz").is_file():
            return data
        if (data / "mobility.urdf").is_file() or not any(data.glob("*/mobility*.urdf")):
            raise DataError(f"{data}: holds neither scenes.npz nor object folders with a mobility.urdf; {_WANTED}")
    out = cache_folder() / "converted" / hashlib.sha256(str(source.resolve()).encode()).hexdigest()[:16]
    out.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(out.with_suffix(".lock"))
    try:
        held = lock.acquire(timeout=0)
    except Timeout:
        say(f"waiting for another run that converts {source}")
        held = lock.acquire()
    with held:
        if data is None:
            generate(source)
        convert(source, out)
    return out


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
            self._scenes = SceneBank.concatenate(scenes)
            self._views = ViewBank.concatenate(views, [len(bank) for bank in scenes])
        except ValueError as e:
            folders = ", ".join(map(str, (self.folder, *more)))
            raise DataError(f"{folders}: cannot be trained on together: {e}; convert them with the same flags") from e

    def env(self, split: str, task: Task, impl: str, config: EnvConfig, physics: PhysicsConfig) -> Env:
        """The environment of one split. Raises DataError where the split has nothing for the task."""
        chosen = np.flatnonzero(self._scenes.split == split)
        if len(chosen) == 0:
            raise DataError(f"{self.folder}: has no object of the split {split}; see splits.json")
        try:
            return make_env(self._scenes.select(chosen), self._views.of_scenes(chosen), task, impl, config, physics)
        except ValueError as e:
            raise DataError(f"{self.folder}, split {split}: {e}") from e


def _banks(folder: Path) -> tuple[SceneBank, ViewBank]:
    return SceneBank.load(folder / "scenes.npz"), ViewBank.load(folder / "views.npz")
