"""A data set of another layout: one file with a reader, named in VATMART_PLUGINS, and `convert` takes its objects."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from conversion.config import ConvertConfig, ViewConfig
from conversion.convert import convert
from conversion.model import ConvertedObject
from conversion.readers import READERS
from vatmart_jax.data.banks import SceneBank, ViewBank
from vatmart_jax.registry import PLUGINS, load_plugins

PLUGIN = '''
import json

import numpy as np
import trimesh

from conversion.model import ArticulatedObject, Joint, Link, ObjectError, Visual
from conversion.readers import READERS
from conversion.readers.base import is_handle


class JsonBoxes:
    """Objects made of boxes: boxes.json with links, their boxes (low and high corners), and slides along an axis."""

    name = "json-boxes"

    def detects(self, folder):
        return (folder / "boxes.json").is_file()

    def files(self, folder, config):
        return [folder / "boxes.json"]

    def read(self, folder, config):
        try:
            table = json.loads((folder / "boxes.json").read_text())
        except ValueError as e:
            raise ObjectError(f"{folder.name}/boxes.json: not JSON ({e})") from None
        links = {name: self._link(name, boxes) for name, boxes in table["links"].items()}
        joints = {
            child: Joint(
                name=f"slide_{child}", type="prismatic", parent=next(iter(links)), child=child, origin=np.eye(4),
                axis=np.array(axis, float), lower=0.0, upper=0.5,
            )
            for child, axis in table["slides"].items()
        }
        return ArticulatedObject(id=folder.name, category="Toy", folder=folder, links=links, joints=joints)

    def _link(self, name, boxes):
        meshes = [trimesh.creation.box(bounds=bounds) for bounds in boxes.values()]
        visuals = tuple(
            Visual(name=box, vertices=np.array(mesh.vertices), faces=np.array(mesh.faces), is_handle=is_handle(box),
                   file=None)
            for box, mesh in zip(boxes, meshes)
        )
        return Link(name=name, semantics="", visuals=visuals)


READERS.register("json-boxes", JsonBoxes())
'''
CABINET = {
    "links": {
        "body": {
            "bottom": [[0, 0, 0], [0.5, 0.6, 0.02]],
            "top": [[0, 0, 0.38], [0.5, 0.6, 0.4]],
            "back": [[0.48, 0, 0], [0.5, 0.6, 0.4]],
        },
        "drawer": {
            "front": [[-0.02, 0, 0.02], [0, 0.6, 0.38]],
            "tray": [[0, 0.05, 0.05], [0.45, 0.55, 0.07]],
            "handle": [[-0.06, 0.25, 0.2], [-0.04, 0.35, 0.22]],
        },
    },
    "slides": {"drawer": [-1, 0, 0]},
}
QUICK = ConvertConfig(view=ViewConfig(views=1, points=64, contacts=16))


@pytest.fixture
def source(tmp_path, monkeypatch) -> Iterator[Path]:
    """Two good objects of the new layout and a broken one; the plugin is loaded as the command would."""
    (tmp_path / "json_boxes.py").write_text(PLUGIN)
    monkeypatch.setenv(PLUGINS, str(tmp_path / "json_boxes.py"))
    for name, text in (("1", json.dumps(CABINET)), ("2", json.dumps(CABINET)), ("3", "{")):
        (tmp_path / "objects" / name).mkdir(parents=True)
        (tmp_path / "objects" / name / "boxes.json").write_text(text)
    yield tmp_path / "objects"
    READERS.unregister("json-boxes")


def test_convert_reads_objects_of_a_reader_that_a_plugin_adds(source, tmp_path):
    out = tmp_path / "out"
    result = convert([source], out, QUICK, jobs=2)
    assert (result.objects, result.converted) == (3, 2)
    assert result.failed[0]["reason"].startswith("3/boxes.json: not JSON")
    scenes, views = SceneBank.load(out / "scenes.npz"), ViewBank.load(out / "views.npz")
    assert scenes.part_kind.tolist() == ["drawer", "drawer"] and scenes.category.tolist() == ["Toy", "Toy"]
    np.testing.assert_allclose(scenes.axis, [[-1, 0, 0]] * 2)
    assert set(views.scene) == {0, 1} and views.contact_handle.any()
    assert ConvertedObject.load(out / "1").parts[0].joint_range == 0.5


def test_its_files_are_what_a_changed_object_is_told_by(source, tmp_path):
    out = tmp_path / "out"
    convert([source], out, QUICK, jobs=1)
    before = {name: (out / name / "object.npz").stat().st_mtime_ns for name in ("1", "2")}
    (source / "1" / "notes.txt").write_text("not a file that the reader opens")
    wider = json.loads(json.dumps(CABINET).replace("0.6", "0.7"))
    (source / "2" / "boxes.json").write_text(json.dumps(wider))
    convert([source], out, QUICK, jobs=1)
    changed = {name for name in before if (out / name / "object.npz").stat().st_mtime_ns != before[name]}
    assert changed == {"2"}


def test_nothing_is_loaded_because_of_what_a_folder_holds(source, tmp_path, monkeypatch):
    monkeypatch.delenv(PLUGINS)
    load_plugins()
    assert READERS.names() == ("partnet-mobility",)
