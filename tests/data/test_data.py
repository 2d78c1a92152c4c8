"""Data: of several runs that prepare it at once one converts and the others wait; what more folders add."""

import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vatmart_jax.data.dataset import SPLITS, Data, DataError, prepare
from vatmart_jax.envs import TASKS, EnvConfig
from vatmart_jax.physics import PhysicsConfig


def test_runs_that_start_at_once_prepare_one_after_the_other(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    inside, most, found, said = 0, 0, [], []

    def convert(source: Path, out: Path) -> None:
        nonlocal inside, most
        inside += 1
        most = max(most, inside)
        time.sleep(0.05)
        inside -= 1

    def run() -> None:
        found.append(prepare(None, convert, lambda out: out.mkdir(exist_ok=True), said.append))

    threads = [threading.Thread(target=run) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == 1 and len(found) == 4 and len(set(found)) == 1
    assert len(said) == 3 and all("waiting for another run" in line for line in said)


def test_more_folders_add_their_training_splits_and_nothing_else(cabinets, tmp_path):
    bank, views = cabinets
    renamed = replace(bank, object_id=np.array([f"more-{i}" for i in bank.object_id]))
    for folder, scenes in (("own", bank), ("more", renamed)):
        (tmp_path / folder).mkdir()
        scenes.save(tmp_path / folder / "scenes.npz")
        views.save(tmp_path / folder / "views.npz")
    folders = tmp_path / "own", tmp_path / "more"
    found = {}
    for name, data in (("one", Data(folders[0])), ("both", Data(*folders))):
        envs = (data.env(split, TASKS["push-drawer"], "c", EnvConfig(num_envs=4), PhysicsConfig()) for split in SPLITS)
        found[name] = [env.bank.object_id.tolist() for env in envs]
    assert found["both"][0] == found["one"][0] + [f"more-{i}" for i in found["one"][0]]
    assert found["both"][1:] == found["one"][1:]
    tested = found["one"][1][0]
    replace(bank, object_id=np.full(len(bank), tested)).save(tmp_path / "more" / "scenes.npz")
    with pytest.raises(DataError, match=f"more: would train on {tested}, which .*own has for the test"):
        Data(*folders)
    renamed.save(tmp_path / "more" / "scenes.npz")
    replace(views, points=views.points[:, :10]).save(tmp_path / "more" / "views.npz")
    with pytest.raises(DataError, match=r"own, .*more: cannot be trained on together: their views differ"):
        Data(*folders)
