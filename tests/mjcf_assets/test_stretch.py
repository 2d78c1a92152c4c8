"""Stretched copies: the closed object is stretched, its parts stay rigid and are found as in the original."""

from __future__ import annotations

import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from conversion.part_detection import detect_parts
from conversion.readers.partnet_mobility import read_object
from mjcf_assets.output_folder import GeneratorError
from mjcf_assets.procedural.generate import generate
from mjcf_assets.stretch import MAX_LOG_FACTOR, anisotropic_copies
from vatmart_jax.cli.main import main


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("originals")
    generate(out, 14, seed=0)
    return out


@pytest.fixture(scope="module")
def copies(source, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("copies")
    main(["generate", "--out", str(out), "--stretch", str(source), "--count", "2"])
    return out


def posed(obj, values) -> np.ndarray:
    """All vertices [n, 3] in the object frame."""
    poses = obj.link_poses(values)
    return np.concatenate(
        [v.vertices @ poses[k][:3, :3].T + poses[k][:3, 3] for k, link in obj.links.items() for v in link.visuals]
    )


def training(source: Path) -> dict[str, str]:
    table = json.loads((source / "splits.json").read_text())["train"]
    return {name: category for category, names in table.items() for name in names}


def test_every_training_object_has_its_copies_and_no_other_has(source, copies):
    originals, made = training(source), training(copies)
    assert made == {f"{name}x{k}": category for name, category in originals.items() for k in range(2)}
    assert {p.name for p in copies.iterdir()} == {*made, "splits.json"}


def test_the_closed_object_is_stretched_and_its_parts_are_the_same(source, copies):
    for name in training(source):
        original = read_object(source / name)
        found, _ = detect_parts(original)
        factors = []
        for k in range(2):
            copy = read_object(copies / f"{name}x{k}")
            before, after = posed(original, {}), posed(copy, {})
            factor = np.ptp(after, axis=0) / np.ptp(before, axis=0)
            # Reading sorts the vertices of a mesh, and near ties can change places: match each with its own.
            mesh = np.concatenate(
                [
                    np.full(len(v.vertices), i)
                    for i, v in enumerate(v for x in original.links.values() for v in x.visuals)
                ]
            )[:, None]
            found_at = cKDTree(np.hstack([after, mesh])).query(np.hstack([before * factor, mesh]))[1]
            assert len(np.unique(found_at)) == len(before) == len(after)
            np.testing.assert_allclose(after[found_at], before * factor, atol=2e-3)
            assert (np.abs(np.log(factor)) <= 2 * MAX_LOG_FACTOR).all() and abs(np.log(factor).sum()) < 1e-2
            factors.append(factor)
            again, _ = detect_parts(copy)
            assert [(p.link, p.kind, p.sign) for p in again] == [(p.link, p.kind, p.sign) for p in found]
            for a, b in zip(found, again, strict=True):
                assert b.joint_range == pytest.approx(a.joint_range) if a.kind == "door" else b.joint_range > 0
        assert np.abs(factors[0] - factors[1]).max() > 0.01


def test_an_open_drawer_goes_as_far_as_its_own_depth_allows(source, copies):
    """The end of a slide's range is stretched with the object: the open object is stretched, too."""
    seen = 0
    for name in training(source):
        original, copy = read_object(source / name), read_object(copies / f"{name}x0")
        slides = {p.joint: p.closed + p.sign * p.joint_range for p in detect_parts(original)[0] if p.kind == "drawer"}
        ends = {p.joint: p.closed + p.sign * p.joint_range for p in detect_parts(copy)[0] if p.kind == "drawer"}
        if slides:
            factor = np.ptp(posed(copy, {}), axis=0) / np.ptp(posed(original, {}), axis=0)
            np.testing.assert_allclose(posed(copy, ends), posed(original, slides) * factor, atol=3e-3)
            seen += 1
    assert seen


def test_the_same_seed_makes_the_same_copies_and_more_of_them_leave_the_first_alone(source, copies, tmp_path):
    anisotropic_copies(source, tmp_path / "more", 3, seed=0)
    anisotropic_copies(source, tmp_path / "other", 1, seed=1)
    for name in training(source):
        urdf = f"{name}x0/mobility.urdf"
        assert (tmp_path / "more" / urdf).read_bytes() == (copies / urdf).read_bytes()
        assert (tmp_path / "other" / urdf).read_bytes() != (copies / urdf).read_bytes()


def damaged(source: Path, out: Path, old: str, new: str) -> Path:
    """A copy of `source` whose first training object's URDF has every `old` replaced."""
    shutil.copytree(source, out)
    urdf = out / sorted(training(source))[0] / "mobility.urdf"
    text = urdf.read_text()
    assert re.search(old, text)
    urdf.write_text(re.sub(old, new, text))
    return out


def test_an_object_with_a_frame_askew_gets_no_copies(source, tmp_path):
    """Turned and stretched, it would be sheared."""
    name = sorted(training(source))[0]
    bent = damaged(source, tmp_path / "bent", r"<origin xyz=", '<origin rpy="0 0.4 0" xyz=')
    made = anisotropic_copies(bent, tmp_path / "out", 1, seed=0)
    assert f"{name}x0" not in made and len(made) == len(training(source)) - 1


@pytest.mark.parametrize(
    ("old", "new"), [("<robot", "<robo"), ('xyz="[^"]*"', 'xyz="one 2 3"'), ("<parent ", "<father ")]
)
def test_a_broken_urdf_is_named_and_nothing_half_written_stays(source, tmp_path, old, new):
    broken = damaged(source, tmp_path / "broken", old, new)
    name = sorted(training(source))[0]
    with pytest.raises(GeneratorError, match=f"{name}/mobility.urdf: cannot be stretched"):
        anisotropic_copies(broken, tmp_path / "out", 1, seed=0)
    assert not (tmp_path / "out" / f"{name}x0").exists()


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (None, "no readable list"),
        ("[]", "no readable list"),
        ('{"test_shapes": {}}', "no readable list"),
        ('{"train": {"Door": ["../away"]}}', "no folder beside it"),
        ('{"train": {"Door": ["missing"]}}', "no folder beside it"),
    ],
)
def test_a_list_of_objects_that_cannot_be_used_is_refused(tmp_path, table, message):
    (tmp_path / "away").mkdir()
    (tmp_path / "from").mkdir()
    if table is not None:
        (tmp_path / "from" / "splits.json").write_text(table)
    with pytest.raises(GeneratorError, match=rf"from/splits.json: .*{message}"):
        anisotropic_copies(tmp_path / "from", tmp_path / "out", 1, seed=0)
    assert not (tmp_path / "out").exists()


def test_other_objects_in_the_folder_and_numbers_out_of_range_are_refused(source, tmp_path):
    with pytest.raises(GeneratorError, match="expected 1 <= count"):
        anisotropic_copies(source, tmp_path / "out", 0, seed=0)
    with pytest.raises(GeneratorError, match="holds other objects"):
        anisotropic_copies(source, source, 1, seed=0)


def test_links_to_files_elsewhere_are_not_followed(source, tmp_path):
    shutil.copytree(source, tmp_path / "from")
    name = sorted(training(source))[0]
    (tmp_path / "secret.obj").write_text("v 0 0 0")
    os.symlink(tmp_path / "secret.obj", tmp_path / "from" / name / "textured_objs" / "secret.obj")
    anisotropic_copies(tmp_path / "from", tmp_path / "out", 1, seed=0)
    assert (tmp_path / "out" / f"{name}x0" / "textured_objs" / "secret.obj").is_symlink()
