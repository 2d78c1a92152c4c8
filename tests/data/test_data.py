"""Data: of several runs that prepare it at once one converts and the others wait; what more folders add."""

import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vatmart_jax import __version__
from vatmart_jax.data.cache import DataError, bundled_folder, converted_folder
from vatmart_jax.data.dataset import SPLITS, Data
from vatmart_jax.workflows.prepare import prepare


def test_runs_that_start_at_once_prepare_one_after_the_other(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    inside, most, found, informed = 0, 0, [], []

    def convert(out: Path) -> None:
        nonlocal inside, most
        inside += 1
        most = max(most, inside)
        time.sleep(0.05)
        inside -= 1

    def run() -> None:
        found.append(converted_folder(tmp_path / "objects", convert, informed.append))

    threads = [threading.Thread(target=run) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == 1 and len(found) == 4 and len(set(found)) == 1
    assert len(informed) == 3 and all("waiting for another run" in line for line in informed)


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
        splits = data.splits()
        found[name] = [data.scenes.object_id[splits[split]].tolist() for split in SPLITS]
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


def test_views_that_are_made_now_have_the_points_that_a_run_reads(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "objects" / "1").mkdir(parents=True)
    (tmp_path / "objects" / "1" / "mobility.urdf").write_text("")
    asked = []

    class Nothing:
        failed = ()

    def convert(sources, out, config):
        asked.append((sources, config.view.points))
        return Nothing

    monkeypatch.setattr("vatmart_jax.workflows.prepare.convert", convert)
    prepare(tmp_path / "objects", num_points=12_345)
    assert asked == [([tmp_path / "objects"], 12_345)]


def test_a_converted_folder_is_never_touched(cabinets, tmp_path, monkeypatch):
    monkeypatch.setattr("vatmart_jax.workflows.prepare.convert", None)
    cabinets[0].save(tmp_path / "scenes.npz")
    assert prepare(tmp_path, num_points=12_345) == tmp_path


def test_bundled_objects_are_made_again_for_another_version_of_the_generator():
    assert bundled_folder(1, 50, 0) != bundled_folder(2, 50, 0)
    assert __version__ not in bundled_folder(1, 50, 0).name
