"""Materials and pictures of OBJ files reach model.xml; what is missing or outside the folder leaves a plain colour."""

from __future__ import annotations

import io
from pathlib import Path

import mujoco
import numpy as np
import pytest
from generated import with_hulls
from PIL import Image

from conversion.cache_key import object_key
from conversion.config import ConvertConfig, MjcfConfig, ReadConfig, ViewConfig
from conversion.convert import convert
from conversion.mjcf import VISUAL_GROUP, to_mjcf
from conversion.model import ArticulatedObject
from conversion.readers import read_object, reader_of
from conversion.readers.materials import read_mtl, read_png
from mjcf_assets.procedural.generate import generate

# An upright square with a picture, its lower half in both windings, and a triangle of another material.
MESH = """mtllib door.mtl
v 0 0 0\nv 0 1 0\nv 0 1 1\nv 0 0 1\nv 0 2 0
vt 0 0\nvt 2 0\nvt 2 1\nvt 0 1
usemtl wood
f 1/1 2/2 3/3 4/4
f 3/3 2/2 1/1
usemtl green
f 2 5 3
"""
TEXTURES = ReadConfig(textures=True)
MTL = "newmtl wood\nKd 0.5 0.5 0.5\nmap_Kd ../images/wood.jpg\nnewmtl green\nKd 0 1 0\nd 0.5\n"


def write(folder: Path, mtl: str = MTL) -> Path:
    (folder / "textured_objs").mkdir(parents=True)
    (folder / "images").mkdir()
    (folder / "textured_objs" / "door.obj").write_text(MESH)
    (folder / "textured_objs" / "door.mtl").write_text(mtl)
    picture = np.zeros((800, 400, 3), np.uint8)
    picture[:400], picture[400:] = (255, 0, 0), (0, 0, 255)  # red above blue
    Image.fromarray(picture).save(folder / "images" / "wood.jpg", quality=95)
    (folder / "mobility.urdf").write_text(
        '<robot name="r"><link name="base"><visual name="door-1"><geometry>'
        '<mesh filename="textured_objs/door.obj" scale="1 2 1"/></geometry></visual></link></robot>'
    )
    return folder


def model_of(obj: ArticulatedObject) -> mujoco.MjModel:
    return to_mjcf(with_hulls(obj), MjcfConfig()).compile()


def test_every_material_of_a_leaf_is_a_geom_with_its_picture_or_colour(tmp_path):
    model = model_of(read_object(write(tmp_path / "1"), TEXTURES))
    geoms = np.flatnonzero(model.geom_group == VISUAL_GROUP)
    wood, green = (model.mat(i) for i in model.geom_matid[geoms])
    assert (model.ntex, model.nmat, len(geoms)) == (1, 2, 2)
    assert wood.rgba == pytest.approx([1, 1, 1, 1]) and wood.texid.max() == 0
    assert green.rgba == pytest.approx([0, 1, 0, 0.5]) and green.texid.max() == -1
    assert (model.tex_height[0], model.tex_width[0]) == (512, 256)


def test_texture_coordinates_stay_with_their_corners(tmp_path):
    obj = read_object(write(tmp_path / "1"), TEXTURES)
    (visual,) = obj.links["base"].visuals
    assert visual.materials is not None
    assert len(visual.faces) == len(visual.materials.uv) == 3  # the square twice, less the copy, and the triangle
    assert 2 * visual.materials.uv[:2, :, 1] == pytest.approx(2 * visual.vertices[visual.faces[:2]][..., 2])
    assert visual.materials.uv[:2, :, 0] == pytest.approx(visual.vertices[visual.faces[:2]][..., 1])
    model = model_of(obj)
    mesh = model.mesh(model.geom_dataid[np.flatnonzero(model.geom_group == VISUAL_GROUP)[0]])
    rows = slice(mesh.faceadr[0], mesh.faceadr[0] + mesh.facenum[0])
    points = model.mesh_texcoord[mesh.texcoordadr[0] :][model.mesh_facetexcoord[rows]]
    corners = model.mesh_vert[mesh.vertadr[0] :][model.mesh_face[rows]]
    along, up = np.ptp(corners, axis=(0, 1)).argsort()[[2, 1]]  # MuJoCo turns a mesh to its inertia
    assert abs(np.corrcoef(points[..., 0].ravel(), corners[..., along].ravel())[0, 1]) == pytest.approx(1)
    assert abs(np.corrcoef(points[..., 1].ravel(), corners[..., up].ravel())[0, 1]) == pytest.approx(1)
    assert np.ptp(points[..., 0]) == pytest.approx(2)  # pictures repeat


def test_of_two_sides_of_a_face_the_one_with_a_picture_stays(tmp_path):
    folder = write(tmp_path / "1")
    (folder / "textured_objs" / "door.obj").write_text(
        MESH.split("usemtl")[0] + "usemtl green\nf 3 2 1\nusemtl wood\nf 1/1 2/2 3/3\nusemtl green\nf 1 3 4\n"
    )
    model = model_of(read_object(folder, TEXTURES))
    shown = {model.mat(model.geom_matid[g]).texid.max(): model.mesh_facenum[model.geom_dataid[g]]
             for g in np.flatnonzero(model.geom_group == VISUAL_GROUP)}  # fmt: skip
    assert shown == {0: 2, -1: 2}  # one triangle each, both sides


def test_without_the_flag_links_have_colours_by_role(tmp_path):
    obj = read_object(write(tmp_path / "1"))
    model = model_of(obj)
    assert obj.links["base"].visuals[0].materials is None
    assert (model.ntex, model.nmat, (model.geom_group == VISUAL_GROUP).sum()) == (0, 0, 1)


@pytest.mark.parametrize("name", ["wood.png", "../../secret.png", "/etc/passwd", "../images/link.png", "\0"])
def test_a_picture_that_is_missing_or_outside_leaves_a_plain_colour_and_a_note(tmp_path, name):
    folder = write(tmp_path / "1", MTL.replace("../images/wood.jpg", name))
    Image.new("RGB", (4, 4)).save(tmp_path / "secret.png")
    (folder / "images" / "link.png").symlink_to(tmp_path / "secret.png")
    obj = read_object(folder, TEXTURES)
    model = model_of(obj)
    assert model.ntex == 0 and model.mat(0).rgba == pytest.approx([0.5, 0.5, 0.5, 1])
    assert len(obj.notes) == 1 and "plain colour" in obj.notes[0] and "\n" not in obj.notes[0]


def test_a_material_library_that_is_missing_is_noted(tmp_path):
    folder = write(tmp_path / "1")
    (folder / "textured_objs" / "door.mtl").unlink()
    obj = read_object(folder, TEXTURES)
    assert model_of(obj).nmat == 0
    assert obj.notes == ("material library 'door.mtl' not readable inside the folder, plain colours",)


@pytest.mark.parametrize("line", ["f 1/9 2/-9 3/2", "vt nan nan\nf 1/5 2/5 3/5", "f 1 2//1 3/", "usemtl\nf 1 2 3"])
def test_corners_without_a_usable_coordinate_take_one(tmp_path, line):
    folder = write(tmp_path / "1")
    (folder / "textured_objs" / "door.obj").write_text(MESH.split("f ")[0] + line + "\nf 2 3 4\n")
    obj = read_object(folder, TEXTURES)
    assert np.isfinite(obj.links["base"].visuals[0].materials.uv).all()
    model_of(obj)


def test_lines_of_a_library_that_cannot_be_read_count_for_nothing():
    text = "Kd 1 1 1\nnewmtl a\nKd x y z\nd 0\nnewmtl b c\nKd 2 -1 0.5\nmap_Kd -s 1 1 1 dir\\p.png\nmap_Kd\nd\n"
    assert read_mtl(text) == {"a": ((0.8, 0.8, 0.8, 1.0), None), "b c": ((1.0, 0.0, 0.5, 1.0), "dir/p.png")}


def test_what_is_no_picture_is_said(tmp_path):
    picture = io.BytesIO()
    Image.effect_noise((64, 64), 50).save(picture, "PNG")
    for data in (b"", b"no picture", picture.getvalue()[:500]):
        (tmp_path / "a.png").write_bytes(data)
        with pytest.raises(ValueError, match="no readable image"):
            read_png(tmp_path / "a.png", 512)


def keys(folder: Path) -> list[str]:
    """Of conversions without and with textures."""
    configs = [ConvertConfig(read=ReadConfig(textures=t)) for t in (False, True)]
    return [object_key(folder, reader_of(folder), config, None) for config in configs]


def test_a_changed_picture_is_converted_again_where_textures_are_asked_for(tmp_path):
    folder = write(tmp_path / "1")
    before = keys(folder)
    Image.new("RGB", (4, 4)).save(folder / "images" / "wood.jpg")
    after = keys(folder)
    assert before[0] == after[0] and before[1] != after[1]


def test_the_flag_writes_pictures_beside_the_meshes(tmp_path):
    generate(tmp_path / "src", 1, seed=3)
    (folder,) = (p for p in (tmp_path / "src").iterdir() if p.is_dir())
    mesh = next(p for p in sorted(folder.rglob("*.obj")))
    mesh.with_suffix(".mtl").write_text("newmtl wood\nmap_Kd wood.png\n")
    Image.new("RGB", (4, 4), (200, 100, 0)).save(mesh.parent / "wood.png")
    mesh.write_text(f"mtllib {mesh.stem}.mtl\nusemtl wood\n{mesh.read_text()}")
    config = ConvertConfig(read=TEXTURES, view=ViewConfig(views=1, points=64, contacts=16), variants=1)
    convert([tmp_path / "src"], tmp_path / "out", config, jobs=1)
    out = tmp_path / "out" / folder.name
    assert (out / "assets" / "texture_0.png").is_file()
    assert mujoco.MjModel.from_xml_path(str(out / "model.xml")).ntex == 1
