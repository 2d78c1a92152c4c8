import pickle
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from boxes import as_boxes
from scipy.spatial.transform import Rotation

from vatmart_jax.data.banks import BankError, SceneBank, SceneTable, ViewBank


def assert_same(a, b):
    for field in fields(a):
        x, y = np.asarray(getattr(a, field.name)), np.asarray(getattr(b, field.name))
        assert x.dtype.kind == y.dtype.kind and x.shape == y.shape, field.name
        assert (x == y).all(), field.name


def solids(bank: SceneBank, scene: int) -> list[list[np.ndarray]]:
    """Vertices of a Scene's hulls, placed: of the object, then of the part."""
    out = []
    for start in (bank.static_start, bank.part_start):
        rows = range(start[scene], start[scene + 1])
        out.append([_placed(bank, row) for row in rows])
    return out


def _placed(bank: SceneBank, row: int) -> np.ndarray:
    turn = Rotation.from_quat(bank.instance_quat[row], scalar_first=True)
    return turn.apply(bank.hull(bank.instance_shape[row])) + bank.instance_pos[row]


def static_sizes(bank: SceneBank, scene: int) -> np.ndarray:
    """Half extents of a Scene's static boxes."""
    return bank.box_size[bank.instance_shape[bank.static_start[scene] : bank.static_start[scene + 1]]]


@pytest.mark.parametrize("convert", [lambda bank: bank, as_boxes], ids=["hull", "box"])
def test_scene_banks_come_back_from_their_file(cabinets, tmp_path, convert):
    bank = convert(cabinets[0])
    bank.save(tmp_path / "scenes.npz")
    loaded = SceneBank.load(tmp_path / "scenes.npz")
    assert_same(loaded, bank)
    assert isinstance(loaded.collision, str)
    assert [p.name for p in tmp_path.iterdir()] == ["scenes.npz"]


def test_view_banks_come_back_from_their_file(cabinets, tmp_path):
    cabinets[1].save(tmp_path / "views.npz")
    assert_same(ViewBank.load(tmp_path / "views.npz"), cabinets[1])


@pytest.mark.parametrize("chosen", [[3], [4, 1], [2, 2], list(range(6)), []])
def test_selected_scenes_keep_their_shape_and_use_every_hull(cabinets, chosen):
    bank, _ = cabinets
    part = bank.select(np.array(chosen, int))
    assert len(part) == len(chosen)
    for new, old in enumerate(chosen):
        for was, now in zip(solids(bank, old), solids(part, new), strict=True):
            np.testing.assert_array_equal(now, was)
        assert part.object_id[new] == bank.object_id[old] and part.joint_range[new] == bank.joint_range[old]
    assert sorted(set(part.instance_shape)) == list(range(len(part.hull_start) - 1))


def test_masks_select_as_indices_do_and_everything_selected_is_the_bank_itself(cabinets):
    bank, views = cabinets
    mask = bank.joint_type == 1
    assert_same(bank.select(mask), bank.select(np.flatnonzero(mask)))
    assert_same(views.select(views.direction > 0), views.select(np.flatnonzero(views.direction > 0)))
    assert_same(views.select(np.arange(len(views))), views)


def test_selected_boxes_keep_their_sizes(cabinets):
    bank = as_boxes(cabinets[0])
    part = bank.select(np.array([5]))
    rows = np.arange(bank.static_start[5], bank.static_start[6])
    np.testing.assert_array_equal(
        part.box_size[part.instance_shape[: len(rows)]], bank.box_size[bank.instance_shape[rows]]
    )


@pytest.mark.parametrize("chosen", [[3], [5, 0, 2], []])
def test_views_follow_their_scenes(cabinets, chosen):
    bank, views = cabinets
    chosen = np.array(chosen, int)
    part, seen = bank.select(chosen), views.of_scenes(chosen)
    assert len(seen) == np.isin(views.scene, chosen).sum()
    was = views.select(np.isin(views.scene, chosen))
    assert (part.object_id[seen.scene] == bank.object_id[was.scene]).all()
    assert (part.part[seen.scene] == bank.part[was.scene]).all()
    assert (seen.points == was.points).all()


def test_scenes_on_device_have_axes_in_the_object_frame(cabinets):
    bank, _ = cabinets
    scenes = SceneTable.from_bank(bank)
    for scene in range(len(bank)):
        expected = [-1, 0, 0] if bank.joint_type[scene] else [0, 0, -1 if scene == 0 else 1]
        np.testing.assert_allclose(scenes.axis[scene], expected, atol=1e-6)


@pytest.mark.parametrize("convert", [lambda bank: bank, as_boxes], ids=["hull", "box"])
def test_files_of_format_1_load(cabinets, tmp_path, convert):
    """Every hinge is a door then; views had the normals of their points."""
    bank, views = convert(cabinets[0]), cabinets[1]
    old = {f.name: np.asarray(getattr(bank, f.name)) for f in fields(bank) if f.name != "part_kind"}
    old["width"] = old.pop("joint_range")
    np.savez(tmp_path / "scenes.npz", format=1, kind="scenes", **old)
    assert_same(SceneBank.load(tmp_path / "scenes.npz"), bank)
    old = {f.name: getattr(views, f.name) for f in fields(views)}
    old |= {"q": old.pop("joint_pos"), "opening": old.pop("direction") > 0, "normals": np.zeros_like(views.points)}
    np.savez(tmp_path / "views.npz", format=1, kind="views", **old)
    assert_same(ViewBank.load(tmp_path / "views.npz"), views)


def test_files_of_a_later_format_are_refused(cabinets, tmp_path):
    np.savez(tmp_path / "scenes.npz", format=3, kind="scenes")
    with pytest.raises(BankError, match=r"scenes\.npz: not a scenes bank of format 2"):
        SceneBank.load(tmp_path / "scenes.npz")


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_truncated_files_are_refused_by_name(cabinets, tmp_path, share):
    path = tmp_path / "scenes.npz"
    cabinets[0].save(path)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(BankError, match=r"scenes\.npz: damaged .* again with `vatmart convert`"):
        SceneBank.load(path)


def test_flipped_bytes_are_noticed(cabinets, tmp_path):
    path = tmp_path / "scenes.npz"
    cabinets[0].save(path)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(BankError, match="damaged"):
        SceneBank.load(path)


def test_files_of_another_kind_are_refused(cabinets, tmp_path):
    cabinets[1].save(tmp_path / "views.npz")
    with pytest.raises(BankError, match=r"views\.npz: not a scenes bank of format 2"):
        SceneBank.load(tmp_path / "views.npz")
    with pytest.raises(BankError, match="no such file"):
        SceneBank.load(tmp_path)
    np.save(tmp_path / "array.npy", np.zeros(3))
    with pytest.raises(BankError, match=r"array\.npy"):
        SceneBank.load(tmp_path / "array.npy")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(BankError, match=r"other\.npz: damaged"):
        ViewBank.load(tmp_path / "other.npz")


class Bomb:
    """Makes a file when it is unpickled."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_pickles_are_never_read(cabinets, tmp_path):
    arrays = {f.name: np.asarray(getattr(cabinets[1], f.name)) for f in fields(ViewBank)}
    bomb = np.empty(1, object)
    bomb[0] = Bomb(tmp_path / "exploded")
    np.savez(tmp_path / "views.npz", format=2, kind="views", **{**arrays, "scene": bomb})
    (tmp_path / "pickle.npz").write_bytes(pickle.dumps(bomb))
    for name in ("views.npz", "pickle.npz"):
        with pytest.raises(BankError, match="damaged"):
            ViewBank.load(tmp_path / name)
    assert not (tmp_path / "exploded").exists()


def test_a_save_that_fails_leaves_the_old_file_and_nothing_else(cabinets, tmp_path):
    path = tmp_path / "views.npz"
    cabinets[1].save(path)
    unwritable = np.empty(1, object)
    unwritable[0] = lambda: None
    with pytest.raises(Exception, match="pickle"):
        replace(cabinets[1], scene=unwritable).save(path)
    assert_same(ViewBank.load(path), cabinets[1])
    assert [p.name for p in tmp_path.iterdir()] == ["views.npz"]


@pytest.mark.parametrize("convert", [lambda bank: bank, as_boxes], ids=["hull", "box"])
def test_concatenated_banks_hold_the_scenes_and_views_of_each(cabinets, convert):
    bank, views = convert(cabinets[0]), cabinets[1]
    halves = np.array([4, 1, 0]), np.array([5, 2, 3])
    banks = [bank.select(half) for half in halves]
    order = np.concatenate(halves)
    joined = SceneBank.concatenate(banks)
    together = joined.select(np.arange(len(order)))
    if bank.collision == "hull":
        for new, old in enumerate(order):
            for was, now in zip(solids(bank, old), solids(joined, new), strict=True):
                np.testing.assert_array_equal(now, was)
    else:
        for new, old in enumerate(order):
            np.testing.assert_array_equal(static_sizes(joined, new), static_sizes(bank, old))
    assert_same(together, joined)  # every shape is used, once
    assert_same(SceneBank.concatenate([bank]), bank)
    found = ViewBank.concatenate([views.of_scenes(half) for half in halves], [len(half) for half in halves])
    assert len(found) == len(views)
    np.testing.assert_array_equal(np.sort(order[found.scene]), np.sort(views.scene))
    np.testing.assert_array_equal(found.points[0], views.points[views.scene == np.min(halves[0])][0])


def test_banks_that_do_not_fit_are_not_concatenated(cabinets):
    bank, views = cabinets
    with pytest.raises(ValueError, match=r"collision geometry differs \(box, hull\)"):
        SceneBank.concatenate([bank, as_boxes(bank)])
    with pytest.raises(ValueError, match="views differ in points and contacts"):
        ViewBank.concatenate([views, replace(views, points=views.points[:, :10])], [6, 6])
