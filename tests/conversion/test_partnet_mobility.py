"""Object folders are read as they are, or refused in one line; doors and drawers are told from the rest."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import pytest
import yourdfpy
from hypothesis import given, settings
from hypothesis import strategies as st

from conversion.config import ReadConfig
from conversion.model import ArticulatedObject, ConvertedObject, ConvexShape, ObjectError
from conversion.part_detection import detect_parts
from conversion.readers.mesh_reader import clean
from conversion.readers.partnet_mobility import read_object

CUBE = """v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1
f 1 4 3 2\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n"""


def box_obj(low: tuple, high: tuple) -> str:
    corners = [line.split()[1:] for line in CUBE.splitlines() if line.startswith("v")]
    vertices = np.array(low) + np.array(corners, float) * (np.array(high) - low)
    return "\n".join(f"v {x} {y} {z}" for x, y, z in vertices) + "\n" + CUBE[CUBE.index("f") :]


def visual(name: str, file: str, scale: str = "") -> str:
    scale = f' scale="{scale}"' if scale else ""
    return f'<visual name="{name}"><geometry><mesh filename="{file}"{scale}/></geometry></visual>'


def write(folder: Path, joints: str, links: dict[str, str], meshes: dict[str, str], semantics: str = "") -> Path:
    (folder / "textured_objs").mkdir(parents=True)
    for name, text in meshes.items():
        (folder / "textured_objs" / name).write_text(text)
    body = "".join(f'<link name="{name}">{inner}</link>' for name, inner in links.items())
    (folder / "mobility.urdf").write_text(f'<?xml version="1.0"?><robot name="r">{body}{joints}</robot>')
    if semantics:
        (folder / "semantics.txt").write_text(semantics)
    return folder


def joint(name: str, child: str, kind: str, limit: str = "", parent: str = "base", rest: str = "") -> str:
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{rest}{limit}</joint>'


def limit(lower: float | str, upper: float | str) -> str:
    return f'<limit lower="{lower}" upper="{upper}"/>'


@pytest.fixture
def cupboard(tmp_path: Path) -> Path:
    """An open carcass, front towards -x, with a door hinged at y = 0, whose handle is a helper link, and a drawer."""
    boards = {
        "left.obj": ((0, 0, 0), (1, 0.05, 1)),
        "right.obj": ((0, 0.95, 0), (1, 1, 1)),
        "back.obj": ((0.95, 0, 0), (1, 1, 1)),
        "top.obj": ((0, 0, 0.95), (1, 1, 1)),
        "door.obj": ((-0.03, 0, 0), (0, 1, 0.6)),
        "front.obj": ((-0.03, 0, 0.6), (0, 1, 1)),
        "tray.obj": ((0, 0.1, 0.62), (0.8, 0.9, 0.64)),
        "bar.obj": ((-0.09, 0.85, 0.2), (-0.07, 0.87, 0.5)),
    }
    links = {
        "base": "",
        "link_2": "".join(visual(f"board-{k}", f"textured_objs/{k}.obj") for k in ("left", "right", "back", "top")),
        "link_0": visual("door_panel-1", "textured_objs/door.obj"),
        "helper": visual("bar", "textured_objs/bar.obj"),
        "pull": visual("handle-7", "textured_objs/bar.obj", "1 1 0.5"),
        "link_1": visual("drawer_front-2", "textured_objs/front.obj") + visual("tray", "textured_objs/tray.obj"),
    }
    joints = (
        joint("joint_2", "link_2", "fixed")
        + joint("joint_0", "link_0", "revolute", limit(0, 1.5), "link_2", '<axis xyz="0 0 2"/>')
        + joint("joint_h", "helper", "fixed", parent="link_0", rest='<origin xyz="0 0.01 0"/>')
        + joint("joint_p", "pull", "fixed", parent="link_0")
        + joint("joint_1", "link_1", "prismatic", limit(0, 0.7), "link_2", '<axis xyz="-1 0 0"/>')
    )
    semantics = "link_0 hinge rotation_door\nlink_1 slider drawer\nlink_2 heavy furniture_body\n"
    return write(tmp_path / "100", joints, links, {k: box_obj(*v) for k, v in boards.items()}, semantics)


def edit(folder: Path, old: str, new: str) -> None:
    urdf = folder / "mobility.urdf"
    text = urdf.read_text()
    assert old in text
    urdf.write_text(text.replace(old, new))


def refusal(folder: Path, **options) -> str:
    with pytest.raises(ObjectError) as caught:
        read_object(folder, ReadConfig(**options))
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_links_joints_and_parts_are_what_the_folder_says(cupboard):
    obj = read_object(cupboard)
    assert list(obj.groups) == ["base", "link_0", "link_1"]
    assert obj.groups["link_0"] == ["link_0", "helper", "pull"]
    assert obj.joints["link_0"].axis == pytest.approx([0, 0, 1])
    assert [v.is_handle for v in obj.group_visuals("link_0")] == [False, False, True]
    found, left_out = detect_parts(obj)
    assert [(p.joint, p.kind, p.closed, p.sign, p.joint_range) for p in found] == [
        ("joint_0", "door", 0, 1, 1.5),
        ("joint_1", "drawer", 0, 1, 0.7),
    ]
    assert left_out == []


def test_visuals_of_fixed_children_stand_where_their_joints_put_them(cupboard):
    bar = read_object(cupboard).group_visuals("link_0")[1].vertices
    assert bar.min(axis=0) == pytest.approx([-0.09, 0.86, 0.2])


def test_mesh_scale_and_visual_origin_apply_in_that_order(cupboard):
    edit(
        cupboard, '<visual name="handle-7">', '<visual name="handle-7"><origin xyz="0 0 1" rpy="0 0 1.5707963267949"/>'
    )
    pull = next(v for v in read_object(cupboard).links["pull"].visuals)
    assert pull.vertices.min(axis=0) == pytest.approx([-0.87, -0.09, 1.1])


def test_primitives_become_meshes(cupboard):
    mesh = '<mesh filename="textured_objs/bar.obj" scale="1 1 0.5"/>'
    for primitive, extent in (
        ('<box size="1 2 3"/>', (1, 2, 3)),
        ('<cylinder radius="0.5" length="2"/>', (1, 1, 2)),
        ('<sphere radius="0.5"/>', (1, 1, 1)),
    ):
        edit(cupboard, mesh, primitive)
        vertices = read_object(cupboard).links["pull"].visuals[0].vertices
        assert np.ptp(vertices, axis=0) == pytest.approx(extent, abs=0.02)
        mesh = primitive


@pytest.mark.parametrize(
    "faces",
    ["f 1 2 3 4 5 6\n", "f 1/1/1 2/2/2 3/3/3 4/4/4 5//5 6\n", "f -6 -5 -4 -3 -2 -1\n", "f 1 2 3 \\\n4 5 6\n"],
    ids=["polygon", "with normals", "counted from the end", "continued line"],
)
def test_obj_dialects_give_the_same_triangles(cupboard, faces):
    ring = "".join(f"v {np.cos(a)} {np.sin(a)} 0 1 1 1\n" for a in np.arange(6) * np.pi / 3)
    (cupboard / "textured_objs" / "bar.obj").write_text("# text\no thing\n" + ring + "vn 0 0 1\n" + faces)
    assert len(read_object(cupboard).links["helper"].visuals[0].faces) == 4


def test_a_face_stored_twice_or_without_area_is_read_once_or_not():
    v = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0], [2, 0, 0]], float)
    vertices, faces = clean(v, np.array([[0, 1, 2], [2, 1, 3], [0, 1, 4], [1, 1, 2]]))
    assert len(faces) == 1
    assert len(vertices) == 3


@pytest.fixture(scope="module")
def oracles(real_objects) -> list[tuple[ArticulatedObject, yourdfpy.URDF]]:
    names = ("45194", "101808", "101612")
    urdfs = [yourdfpy.URDF.load(str(real_objects / n / "mobility.urdf"), load_meshes=False) for n in names]
    return [(read_object(real_objects / name), urdf) for name, urdf in zip(names, urdfs, strict=True)]


# In steps, because the oracle's scene graph (trimesh) leaves a pose as it is where it would change by less than 1e-8.
@settings(max_examples=20, deadline=None)
@given(st.lists(st.integers(0, 1000).map(lambda k: k / 1000), min_size=40, max_size=40))
def test_forward_kinematics_agree_with_yourdfpy(oracles, shares):
    for obj, oracle in oracles:
        moving = [j for j in obj.joints.values() if j.type != "fixed"]
        values = {}
        for joint_, share in zip(moving, shares, strict=False):
            lower, upper = (joint_.lower, joint_.upper) if joint_.limited else (-9.0, 9.0)
            values[joint_.name] = lower + share * (upper - lower)
        oracle.update_cfg({n: values[n] for n in oracle.actuated_joint_names})
        for link, pose in obj.link_poses(values).items():
            assert pose == pytest.approx(oracle.get_transform(link), abs=1e-12)


def test_limits_that_are_swapped_infinite_or_empty_are_made_sense_of(cupboard):
    edit(cupboard, limit(0, 1.5), limit(1.5, 0))
    edit(cupboard, limit(0, 0.7), limit("-inf", "inf"))
    obj = read_object(cupboard)
    assert (obj.joints["link_0"].lower, obj.joints["link_0"].upper) == (0, 1.5)
    assert not obj.joints["link_1"].limited
    assert any("swapped" in note for note in obj.notes)
    edit(cupboard, limit("-inf", "inf"), limit(0.3, 0.3))
    moved = read_object(cupboard).joints["link_1"]
    assert moved.type == "fixed"
    assert moved.origin[:3, 3] == pytest.approx([-0.3, 0, 0])


def test_the_axis_of_a_slide_is_a_direction_and_another_length_is_noted(cupboard):
    edit(cupboard, '<axis xyz="-1 0 0"/>', '<axis xyz="-0.1 0 0"/>')
    obj = read_object(cupboard)
    assert obj.joints["link_1"].axis == pytest.approx([-1, 0, 0])
    assert any("axis of length 0.1, taken as a direction" in note for note in obj.notes)


@pytest.mark.parametrize(
    ("old", "new", "semantics", "reason"),
    [
        ("revolute", "continuous", None, "turns without end"),
        ("joint_0", "joint_0", "knob", "is a knob"),
        ("joint_0", "joint_0", "wheel", "is a wheel"),
        (limit(0, 1.5), limit(0, 0.1), None, "travels only 0.1"),
        ("door_panel-1", "movable_part-1", None, None),  # the helpers on it are handles too, but its own panel is one
    ],
)
def test_what_is_no_door_is_left_out_with_a_reason(cupboard, old, new, semantics, reason):
    edit(cupboard, old, new)
    if semantics:
        text = (cupboard / "semantics.txt").read_text()
        (cupboard / "semantics.txt").write_text(text.replace("rotation_door", semantics))
    found, left_out = detect_parts(read_object(cupboard))
    assert [p.joint for p in found] == ["joint_1"]
    assert left_out == [("joint_0", reason or "consists of movable_part")]


def test_a_tiny_link_without_semantics_is_no_door(cupboard):
    (cupboard / "semantics.txt").unlink()
    (cupboard / "textured_objs" / "door.obj").write_text(box_obj((-0.03, 0, 0), (0, 0.02, 0.02)))
    (cupboard / "textured_objs" / "bar.obj").write_text(box_obj((-0.03, 0, 0), (0, 0.02, 0.02)))
    _, left_out = detect_parts(read_object(cupboard))
    assert left_out[0][1].startswith("is small")


@pytest.mark.parametrize(
    ("lower", "upper", "closed", "sign"),
    [(-1.5, 0, 0, -1), (0.0, 1.5, 0, 1), (-0.4, 1.1, 0, 1), (-1.1, 0.4, 0, -1)],
)
@pytest.mark.parametrize("axis", ["0 0 2", "0 0 -1"])
def test_a_door_modelled_closed_is_closed_at_zero_whatever_the_range(cupboard, lower, upper, closed, sign, axis):
    edit(cupboard, limit(0, 1.5), limit(lower, upper))
    edit(cupboard, '<axis xyz="0 0 2"/>', f'<axis xyz="{axis}"/>')
    door = detect_parts(read_object(cupboard))[0][0]
    assert (door.closed, door.sign) == (closed, sign)
    assert door.joint_range == pytest.approx(max(upper, -lower))


@pytest.mark.parametrize("ajar", [0.5, 1.5])
def test_a_door_modelled_ajar_or_open_is_closed_where_it_covers_the_opening(cupboard, ajar):
    """Its range is [-ajar, 1.5 - ajar], so that 0 is inside the range, or its open end."""
    turn = f'<origin rpy="0 0 {ajar}"/>'
    edit(cupboard, '<axis xyz="0 0 2"/>', turn + '<axis xyz="0 0 2"/>')
    edit(cupboard, limit(0, 1.5), limit(-ajar, 1.5 - ajar))
    door = detect_parts(read_object(cupboard))[0][0]
    assert (door.closed, door.sign, door.joint_range) == (pytest.approx(-ajar), 1, pytest.approx(1.5))


def test_real_parts_open_the_way_they_look(real_objects):
    """Read from pictures: a dishwasher and a room door modelled open, flaps that hang outside, ajar drawers."""
    expected = {
        "12428": [(-1.57, 1)],
        "8877": [(-1.57, 1)],
        "101619": [(-0.52, 1)],
        "22692": [(0, 1), (0, 1)],
        "32354": [(-0.12, 1), (-0.07, 1), (0, 1)],
        "45194": [(0, 1)] * 4,
    }
    for name, ends in expected.items():
        found, _ = detect_parts(read_object(real_objects / name))
        assert [(round(p.closed, 2), p.sign) for p in found] == [(pytest.approx(c, abs=0.01), s) for c, s in ends], name


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("</robot>", "", "100/mobility.urdf: not XML (.*); download the object again"),
        ("<robot name", "<model name", "100/mobility.urdf: not XML .*"),
        (limit(0, 1.5), "", r"joint 'joint_0' has no limit; give it one or pass --continuous-range"),
        (limit(0, 1.5), limit("nan", 1), "joint 'joint_0' has limit .*; expected two numbers"),
        (limit(0, 1.5), limit("0", "many"), "not a readable URDF .*; repair it"),
        (limit(0, 1.5), limit(0, 1e9), "joint 'joint_0' has limit .*; expected radians or unit lengths"),
        ('type="prismatic"', 'type="floating"', "joint 'joint_1' has type 'floating'; use fixed, revolute, .*"),
        ('<axis xyz="0 0 2"/>', '<axis xyz="0 0 0"/>', "joint 'joint_0' has axis .*; expected three finite numbers.*"),
        ('<origin xyz="0 0.01 0"/>', '<origin xyz="nan 0 0"/>', "joint 'joint_h' has an origin that is not finite.*"),
        ('<origin xyz="0 0.01 0"/>', '<origin xyz="1e6 0 0"/>', "joint 'joint_h' has an origin .* beyond 1000; .*"),
        (
            '<child link="link_1"/>',
            '<child link="base"/>',
            "link 'base' is part of a cycle; the joints must form one tree",
        ),
        ('<child link="link_1"/>', '<child link="link_0"/>', "link 'link_0' hangs on two joints; keep one"),
        ('<child link="link_1"/>', '<child link="gone"/>', "names link 'gone', which is not there; add it"),
        ('name="joint_1"', 'name="joint_0"', "joint name 'joint_0' is empty or used twice; rename it"),
        (
            "textured_objs/door.obj",
            "textured_objs/no.obj",
            "link 'link_0': 1 of 1 meshes missing; restore them or pass .*",
        ),
        ("textured_objs/door.obj", "../door.obj", "path '../door.obj' leaves the object's folder; use one inside it"),
        ("textured_objs/door.obj", "/etc/hostname", "path '/etc/hostname' leaves the object's folder; .*"),
        (
            "textured_objs/door.obj",
            "textured_objs/door.dae",
            "mesh format '.dae' is not read|meshes missing",
        ),
        ('filename="textured_objs/door.obj"', 'file="x"', "link 'link_0' has a mesh without filename; give it one"),
        ('scale="1 1 0.5"', 'scale="1 nan 1"', "link 'pull': mesh scale .*; expected one or three numbers"),
        ('scale="1 1 0.5"', 'scale="1 1 1e9"', "link 'pull', visual 'handle-7': coordinates .* beyond 1000 .*"),
    ],
)
def test_a_broken_urdf_is_refused_in_one_line(cupboard, old, new, message):
    edit(cupboard, old, new)
    line = refusal(cupboard)
    assert line.startswith("100/")
    assert re.search(message, line), line


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "mesh is empty, it has no faces; restore it or remove it from the URDF"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "a face names a vertex beyond the 3 there are; restore the mesh"),
        ("v 0 0\nf 1 1 1\n", "line 1 'v 0 0' is no OBJ line; restore the mesh"),
        ("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "coordinates not finite or beyond 1000 unit lengths; repair them"),
        ("v 0 0 1e30\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "coordinates not finite or beyond 1000 unit lengths; repair them"),
    ],
    ids=["empty", "face beyond", "short vertex", "nan", "huge"],
)
def test_a_broken_mesh_is_refused_in_one_line(cupboard, text, message):
    (cupboard / "textured_objs" / "door.obj").write_text(text)
    line = refusal(cupboard)
    assert line.startswith("100/textured_objs/door.obj: ")
    assert message in line


def test_a_link_out_of_the_folder_is_refused(cupboard, tmp_path):
    (tmp_path / "secret.obj").write_text(CUBE)
    mesh = cupboard / "textured_objs" / "door.obj"
    mesh.unlink()
    mesh.symlink_to(tmp_path / "secret.obj")
    assert "leaves the object's folder" in refusal(cupboard)
    mesh.unlink()
    mesh.symlink_to(mesh)
    assert "leaves the object's folder" in refusal(cupboard)


def test_a_pipe_in_place_of_a_mesh_counts_as_missing(cupboard):
    mesh = cupboard / "textured_objs" / "door.obj"
    mesh.unlink()
    os.mkfifo(mesh)
    assert "1 of 1 meshes missing" in refusal(cupboard)


def test_entities_do_not_read_other_files(cupboard, tmp_path):
    (tmp_path / "secret").write_text("joint_secret")
    edit(cupboard, "<robot", f'<!DOCTYPE r [<!ENTITY s SYSTEM "{tmp_path / "secret"}">]><robot')
    edit(cupboard, '<link name="base"></link>', '<link name="base">&s;</link>')
    assert "not XML" in refusal(cupboard)


def test_a_folder_without_urdf_is_refused_and_the_other_name_accepted(cupboard, tmp_path):
    (cupboard / "mobility.urdf").rename(cupboard / "mobility_vhacd.urdf")
    assert len(read_object(cupboard).links) == 6
    (tmp_path / "empty").mkdir()
    assert refusal(tmp_path / "empty").endswith("no mobility.urdf in it; name a PartNet-Mobility object folder")


def test_missing_meshes_are_refused_by_name_or_on_request_noted(cupboard):
    (cupboard / "textured_objs" / "tray.obj").unlink()
    line = refusal(cupboard)
    assert "tray.obj: link 'link_1': 1 of 2 meshes missing" in line and "--allow-missing" in line
    obj = read_object(cupboard, ReadConfig(allow_missing=True))
    assert len(obj.links["link_1"].visuals) == 1
    assert any("1 of 2 meshes missing, left out: textured_objs/tray.obj" in note for note in obj.notes)


def test_side_files_may_be_missing_or_broken(cupboard):
    (cupboard / "semantics.txt").unlink()
    (cupboard / "meta.json").write_text("{")
    obj = read_object(cupboard)
    assert obj.category == "Unknown"
    assert [p.kind for p in detect_parts(obj)[0]] == ["door", "drawer"]
    (cupboard / "meta.json").write_text('{"model_cat": "Safe"}')
    (cupboard / "mobility_v2.json").write_text('[{"id": 0, "name": "knob"}]')
    obj = read_object(cupboard)
    assert obj.category == "Safe"
    assert detect_parts(obj)[1] == [("joint_0", "is a knob")]


def test_a_converted_object_is_loaded_as_it_was_saved(cupboard, tmp_path):
    obj = read_object(cupboard)
    found, left_out = detect_parts(obj)
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    plain = ConvexShape(vertices=corners, is_handle=False)
    boxed = ConvexShape(vertices=np.tile(corners, (2, 1)), is_handle=True, box_pose=np.eye(4), box_size=np.full(3, 0.5))
    hulls = {"base": [plain], "link_0": [boxed, plain], "link_1": []}
    left_out = [*left_out, ("j", "why")]
    saved = ConvertedObject(obj=obj, hulls=hulls, parts=found, left_out=left_out, split="extra")
    saved.save(tmp_path)
    loaded = ConvertedObject.load(tmp_path)
    assert loaded.parts == saved.parts
    assert (loaded.left_out, loaded.split) == (saved.left_out, saved.split)
    assert list(loaded.obj.links) == list(obj.links)
    for name, pose in obj.link_poses({"joint_0": 0.3}).items():
        assert loaded.obj.link_poses({"joint_0": 0.3})[name] == pytest.approx(pose)
    for name, link in obj.links.items():
        for a, b in zip(link.visuals, loaded.obj.links[name].visuals, strict=True):
            assert (a.name, a.is_handle, a.file) == (b.name, b.is_handle, b.file)
            assert b.vertices == pytest.approx(a.vertices, abs=1e-6)
            assert (a.faces == b.faces).all()
    assert [len(loaded.hulls[k]) for k in hulls] == [1, 2, 0]
    assert loaded.hulls["link_0"][0].box_size == pytest.approx(boxed.box_size)
    assert loaded.hulls["link_0"][1].box_size is None
    data = (tmp_path / "object.npz").read_bytes()
    (tmp_path / "object.npz").write_bytes(data[:200])
    with pytest.raises(ObjectError, match="not a converted object"):
        ConvertedObject.load(tmp_path)
