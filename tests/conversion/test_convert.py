"""Many objects at once: what one of them does stays its own affair, and nothing is done twice."""

from __future__ import annotations

import json
import os
import shutil
from collections import Counter
from dataclasses import fields, replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from conversion import cache_key
from conversion import convert as convert_module
from conversion.config import ConvertConfig, DecomposeConfig, ViewConfig
from conversion.convert import convert
from conversion.finger_clearance import check_finger_clearance
from conversion.model import ConvertedObject, ObjectError
from conversion.scene_budget import within_budget
from conversion.scenes import scene_bank, scene_specs
from conversion.splits import default_split
from mjcf_assets.procedural.generate import generate
from vatmart_jax.data.banks import SceneBank, ViewBank

QUICK = ConvertConfig(view=ViewConfig(views=1, points=64, contacts=16), variants=2)


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    """Four objects, one of them broken, and splits for two."""
    out = tmp_path_factory.mktemp("source")
    names = generate(out, 4, seed=5)
    (out / names[1] / "mobility.urdf").write_text("<robot")
    (out / "splits.json").write_text(json.dumps({"extra": {"Any": [names[0]]}, "train": {"Any": [names[2]]}}))
    return out


@pytest.fixture(scope="module")
def result(source, tmp_path_factory):
    out = tmp_path_factory.mktemp("converted") / "out"
    return convert([source], out, QUICK, jobs=2), out


def objects_in(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir() if p.is_dir())


def test_a_broken_object_is_listed_and_the_others_are_converted(source, result):
    outcome, out = result
    good = [n for n in objects_in(source) if n != outcome.failed[0]["id"]]
    assert (outcome.objects, outcome.converted, len(outcome.failed)) == (4, 3, 1)
    assert "mobility.urdf: not XML" in outcome.failed[0]["reason"]
    assert objects_in(out) == good
    for name in good:
        files = {p.name for p in (out / name).iterdir()}
        assert files == {"assets", "model.xml", "object.npz", "picture.png", "report.json", "scenes.npz"}
        assert mujoco.MjModel.from_xml_path(str(out / name / "model.xml")).nbody > 1
    assert not [p for p in out.rglob("*") if p.name.endswith(".part")]


def test_banks_hold_every_part_of_every_object(result):
    _, out = result
    scenes, views = SceneBank.load(out / "scenes.npz"), ViewBank.load(out / "views.npz")
    expected = {(n, p.link) for n in objects_in(out) for p in ConvertedObject.load(out / n).parts}
    assert {*zip(scenes.object_id.tolist(), scenes.part.tolist(), strict=True)} == expected
    expected = [(scene, task) for scene in range(len(scenes)) for task in (1, -1)]
    times = {key: 3 if scenes.split[key[0]] == "train" else 1 for key in expected}
    assert Counter(zip(views.scene.tolist(), views.direction.tolist(), strict=True)) == times
    assert np.diff(scenes.static_start).max() <= QUICK.decompose.static_budget
    assert np.diff(scenes.part_start).max() <= QUICK.decompose.part_budget


def test_splits_come_from_the_source_or_the_category(source, result):
    _, out = result
    table = json.loads((out / "splits.json").read_text())
    split = {i: s for s, categories in table.items() for ids in categories.values() for i in ids}
    given = json.loads((source / "splits.json").read_text())
    assert split[given["extra"]["Any"][0]] == "extra"
    assert split[given["train"]["Any"][0]] == "train"
    rest = next(i for i in split if i not in (given["extra"]["Any"][0], given["train"]["Any"][0]))
    assert split[rest] == default_split(ConvertedObject.load(out / rest).obj.category, rest)


def test_default_splits_follow_the_paper():
    assert default_split("Safe", "1") == "test_categories"
    assert default_split("Oven", "1") == "extra"
    shares = [default_split("Door", str(i)) == "test_shapes" for i in range(1000)]
    assert 0.15 < np.mean(shares) < 0.25


def test_a_second_run_does_nothing(source, result):
    outcome, out = result
    before = {p: p.stat().st_mtime_ns for p in out.rglob("*") if p.name != "convert.json"}
    assert replace(convert([source], out, QUICK), seconds=0) == replace(outcome, seconds=0)
    assert {p: p.stat().st_mtime_ns for p in out.rglob("*") if p.name != "convert.json"} == before


def written(out: Path) -> set[str]:
    """Files of a converted folder that were written since `mark`."""
    return {p.name for p in out.rglob("*") if p.is_file() and p.stat().st_mtime_ns != MARK}


MARK = 10**18


def mark(out: Path) -> None:
    """Make every file look old."""
    for path in out.rglob("*"):
        os.utime(path, ns=(MARK, MARK))


@pytest.fixture
def folder(result, source, tmp_path) -> Path:
    """A copy of the converted folder whose files look old."""
    shutil.copytree(result[1], tmp_path / "out")
    mark(tmp_path / "out")
    return tmp_path / "out"


def with_points(points: int) -> ConvertConfig:
    return replace(QUICK, view=replace(QUICK.view, points=points))


def test_fewer_points_leave_everything_alone_and_more_render_again_without_converting(source, folder):
    convert([source], folder, with_points(32), jobs=1)
    assert written(folder) == {"convert.json"}
    before = ViewBank.load(folder / "views.npz")
    convert([source], folder, with_points(80), jobs=1)
    assert written(folder) == {"convert.json", "views.npz"}
    after = ViewBank.load(folder / "views.npz")
    np.testing.assert_array_equal(after.points[:, :64], before.points)
    mark(folder)
    convert([source], folder, QUICK, jobs=1)
    assert written(folder) == {"convert.json"}


def test_a_changed_renderer_renders_again_and_a_changed_converter_converts(source, folder, monkeypatch):
    monkeypatch.setattr(cache_key, "VIEWS_VERSION", -1)
    convert([source], folder, QUICK, jobs=1)
    assert written(folder) == {"convert.json", "views.npz"}
    monkeypatch.setattr(cache_key, "CONVERSION_VERSION", -1)
    convert([source], folder, QUICK, jobs=2)
    assert {"object.npz", "model.xml", "scenes.npz", "views.npz"} <= written(folder)


def test_an_object_that_ran_out_of_time_is_tried_again(source, tmp_path):
    good = sorted(p.name for p in source.iterdir() if p.is_dir())[2:]
    sources, out = [source / name for name in good], tmp_path / "out"
    with pytest.raises(ObjectError, match=r"took longer than 0\.01 s of processor time; raise --time-limit"):
        convert(sources, out, replace(QUICK, time_limit=0.01), jobs=2)
    assert not out.exists()
    assert not convert(sources[:1], out, QUICK, jobs=1).failed
    short = convert(sources, out, replace(QUICK, time_limit=0.01), jobs=1)
    assert [f["id"] for f in short.failed] == good[1:]
    assert "processor time" in short.failed[0]["reason"]
    again = convert(sources, out, QUICK, jobs=1)
    assert not again.failed and again.converted == 2


def test_views_that_are_not_finished_leave_the_banks_as_they_were(source, folder, monkeypatch):
    before = [(folder / name).read_bytes() for name in ("scenes.npz", "views.npz")]

    def stopped(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(convert_module, "render_views", stopped)
    with pytest.raises(KeyboardInterrupt):
        convert([source], folder, with_points(500), jobs=1)
    assert [(folder / name).read_bytes() for name in ("scenes.npz", "views.npz")] == before
    assert not list(folder.rglob("*.part"))


def test_only_what_changed_is_made_again(source, result, tmp_path):
    _, converted = result
    out, copy = tmp_path / "out", tmp_path / "source"
    shutil.copytree(converted, out)
    shutil.copytree(source, copy)
    names = objects_in(out)
    before = {n: (out / n / "object.npz").stat().st_mtime_ns for n in names}
    mesh = next((copy / names[0] / "textured_objs").glob("*.obj"))
    mesh.write_text(mesh.read_text() + "# changed\n")
    convert([copy], out, QUICK, jobs=1)
    changed = [n for n in names if (out / n / "object.npz").stat().st_mtime_ns != before[n]]
    assert changed == names[:1]


def test_an_object_that_became_broken_is_no_longer_there(result, source, tmp_path):
    _, converted = result
    out = tmp_path / "out"
    shutil.copytree(converted, out)
    names = objects_in(out)
    for name in names[:2]:
        shutil.copytree(source / name, tmp_path / name)
    (tmp_path / names[0] / "mobility.urdf").unlink()
    outcome = convert([tmp_path / names[0], tmp_path / names[1]], out, QUICK, jobs=1)
    assert [f["id"] for f in outcome.failed] == [names[0]]
    assert not (out / names[0]).exists()
    assert set(SceneBank.load(out / "scenes.npz").object_id) <= {names[1]}


def test_a_single_object_that_fails_raises_its_reason_and_leaves_nothing(source, result, tmp_path):
    outcome, _ = result
    with pytest.raises(ObjectError) as caught:
        convert([source / outcome.failed[0]["id"]], tmp_path / "out", QUICK, jobs=1)
    assert str(caught.value) == outcome.failed[0]["reason"]
    assert not (tmp_path / "out").exists()
    with pytest.raises(ObjectError, match="no such folder; name PartNet-Mobility object folders"):
        convert([tmp_path / "nowhere"], tmp_path / "out", QUICK)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ObjectError, match=r"no mobility\.urdf in it"):
        convert([tmp_path / "empty"], tmp_path / "out", QUICK, jobs=1)


def test_merged_scenes_keep_their_parts_and_poses(result):
    _, out = result
    loaded = [ConvertedObject.load(out / name) for name in objects_in(out)]
    # The one with the fewest parts: every Scene is merged for itself, which takes a second or two.
    for converted in sorted(loaded, key=lambda o: len(o.parts) or 99)[:1]:
        specs = scene_specs(converted, 2, 0)
        bank = scene_bank(specs, "hull")
        tight, changed = within_budget(bank, specs, DecomposeConfig(static_budget=12, part_budget=6), 0)
        assert {(c.scene, c.side) for c in changed if c.side == "static"} == {
            (s, "static") for s in np.flatnonzero(np.diff(bank.static_start) > 12)
        }
        assert np.diff(tight.static_start).max() <= 12 and np.diff(tight.part_start).max() <= 6
        for f in fields(SceneBank):
            if f.name in (
                "object_id",
                "part",
                "variant",
                "part_pos",
                "part_quat",
                "axis",
                "joint_range",
                "urdf_closed",
            ):
                assert np.array_equal(getattr(tight, f.name), getattr(bank, f.name))
        loose, unchanged = within_budget(bank, specs, DecomposeConfig(static_budget=999, part_budget=999), 0)
        assert not unchanged
        assert (loose.instance_pos == bank.instance_pos).all()


def test_the_bank_of_all_is_their_scenes_one_after_the_other(result):
    _, out = result
    banks = [SceneBank.load(out / n / "scenes.npz") for n in objects_in(out)]
    whole, first = SceneBank.load(out / "scenes.npz"), 0
    for bank in banks:
        again = whole.select(np.arange(first, first + len(bank)))
        alone = bank.select(np.arange(len(bank)))
        for f in fields(SceneBank):
            a, b = getattr(again, f.name), getattr(alone, f.name)
            assert np.array_equal(a, b), f.name
        first += len(bank)
    assert first == len(whole)


def test_the_page_names_every_object_and_refusal(result):
    outcome, out = result
    page = (out / "report.html").read_text()
    for name in objects_in(out):
        assert f'src="{name}/picture.png"' in page
    assert f"<b>{outcome.failed[0]['id']}</b> refused" in page
    assert (out / "contact_sheet.png").stat().st_size > 1000


def test_hulls_leave_room_for_fingers_behind_real_handles(real_objects, tmp_path):
    convert([real_objects / "45194"], tmp_path, replace(QUICK, view=ViewConfig(views=0)), jobs=1)
    converted = ConvertedObject.load(tmp_path / "45194")
    found = [h for p in converted.parts for h in check_finger_clearance(converted.obj, p, converted.hulls[p.link])]
    assert len(found) == 4
    assert all(h.clear_in_mesh and h.clear_in_hulls for h in found)
