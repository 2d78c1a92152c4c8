"""Boxes: their lids close them from above, and open upwards about an edge without touching the body."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh
from penetration import penetration_depth, posed

from conversion.model import ArticulatedObject
from conversion.readers.partnet_mobility import read_object
from mjcf_assets.procedural.categories.lidded_box import lidded_box
from mjcf_assets.procedural.generate import generate
from mjcf_assets.procedural.solids import Mesh

COUNT = 20


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("boxes")
    generate(out, COUNT, seed=0, categories=["Box"])
    return out


@pytest.fixture(scope="module")
def boxes(folder) -> list[ArticulatedObject]:
    return [read_object(p) for p in sorted(folder.glob("8*"))]


def lids(obj: ArticulatedObject) -> list[str]:
    """The links that are lids, by the words for them in semantics.txt."""
    lines = (obj.folder / "semantics.txt").read_text().splitlines()
    return [line.split()[0] for line in lines if line.endswith("hinge rotation_lid")]


def triangles(obj: ArticulatedObject, links: list[str], values: dict[str, float]) -> trimesh.Trimesh:
    """The visual meshes of some links as one, in the object frame (z up, front towards -x)."""
    poses = obj.link_poses(values)
    visuals = [(v, poses[k]) for k in links for v in obj.links[k].visuals]
    meshes = [trimesh.Trimesh(posed(v.vertices, pose), v.faces, process=False) for v, pose in visuals]
    return trimesh.util.concatenate(meshes)


def seen_from_above(obj: ArticulatedObject, values: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """What a grid of points over the body shows from above: where it is a lid, and how high it is, in 0..1 of the
    body's height; [n] each."""
    (body,) = [k for k in obj.links if k != "base" and k not in lids(obj)]
    below, above = triangles(obj, [body], values), triangles(obj, lids(obj), values)
    lo, hi = below.bounds
    x, y = (np.linspace(a, b, 14)[1:-1] for a, b in zip(lo[:2], hi[:2], strict=True))
    start = np.array([[a, b, 10] for a in x for b in y])
    heights = []
    for mesh in (below, above):
        at, ray, _ = mesh.ray.intersects_location(start, np.tile([0.0, 0, -1], (len(start), 1)), multiple_hits=False)
        height = np.full(len(start), -np.inf)
        height[ray] = (at[:, 2] - lo[2]) / (hi[2] - lo[2])
        heights.append(height)
    return heights[1] > heights[0], np.maximum(*heights)


def test_lids_are_hinged_on_the_rim_and_open_by_90_to_135_degrees(boxes):
    for obj in boxes:
        joints = {
            j.find("child").attrib["link"]: j for j in ElementTree.parse(obj.folder / "mobility.urdf").iter("joint")
        }
        (body,) = [k for k in obj.links if k != "base" and k not in lids(obj)]
        lo, hi = triangles(obj, [body], {}).bounds
        at_back = []
        for link in lids(obj):
            joint, limit = obj.joints[link], joints[link].find("limit").attrib
            assert joints[link].attrib["type"] == "revolute" and float(limit["lower"]) == 0
            assert 90 - 1e-6 <= np.degrees(float(limit["upper"])) <= 135 + 1e-6
            pose = obj.link_poses()[link]
            np.testing.assert_allclose(np.abs(pose[:3, :3] @ joint.axis), [0, 1, 0], atol=1e-6)
            assert abs(pose[2, 3] - hi[2]) < 0.01
            # Rounded corners leave the middle of an edge a little inside the bounds.
            to_front, to_back = np.abs(pose[0, 3] - [lo[0], hi[0]])
            assert min(to_front, to_back) < 2e-3
            at_back.append(to_back < 2e-3)
        assert at_back[0] and len(at_back) in (1, 2)
    assert {len(lids(obj)) for obj in boxes} == {1, 2}


def test_closed_lids_cover_the_box_from_above(boxes):
    for obj in boxes:
        lid, height = seen_from_above(obj, {})
        assert lid.mean() > 0.9 and height[lid].min() > 0.999


def test_every_lid_opens_upwards_and_the_floor_shows(boxes):
    for obj in boxes:
        opened = {obj.joints[k].name: obj.joints[k].upper for k in lids(obj)}
        for link in lids(obj):
            heights = [
                triangles(obj, [link], {obj.joints[link].name: share * obj.joints[link].upper}).vertices[:, 2].max()
                for share in (0.0, 0.2, 0.5)
            ]
            assert heights[0] < heights[1] < heights[2]
        lid, height = seen_from_above(obj, opened)
        # The skirt of a cap that stands upright reaches over part of the box.
        assert lid.mean() < 0.6 and (height[~lid] < 0.5).mean() > 0.7


def test_lids_swing_clear_of_the_body_and_of_each_other(boxes):
    """No vertex of a lid enters a leaf of the rest by more than 3 mm, nor one of the rest a lid."""
    for obj in boxes:
        for link in lids(obj):
            for share in (0.0, 0.1, 0.3, 0.6, 1.0):
                poses = obj.link_poses({obj.joints[link].name: share * obj.joints[link].upper})
                moving = [Mesh(posed(v.vertices, poses[link]), v.faces) for v in obj.links[link].visuals]
                rest = [
                    Mesh(posed(v.vertices, poses[k]), v.faces)
                    for k in obj.links if k != link for v in obj.links[k].visuals
                ]  # fmt: skip
                for some, others in ((moving, rest), (rest, moving)):
                    points = np.concatenate([m.vertices for m in some])
                    for mesh in others:
                        assert penetration_depth(points, mesh) < 3e-3, (obj.id, link, share)


def test_meshes_are_closed_and_wound_outwards():
    with_handle = 0
    for seed in range(60):
        links = lidded_box(np.random.default_rng(seed))
        with_handle += any(name == "handle" for link in links[:-1] for name, _ in link.leaves)
        assert [link.kind for link in links] == ["hinge rotation_lid"] * (len(links) - 1) + ["free box_body"]
        for link in links:
            for name, meshes in link.leaves:
                for mesh in meshes:
                    solid = trimesh.Trimesh(mesh.vertices, mesh.faces)
                    assert solid.is_watertight and solid.volume > 0, (seed, name)
    assert 30 < with_handle < 58


def test_one_box_in_five_is_a_test_shape(folder):
    splits = json.loads((folder / "splits.json").read_text())
    assert splits["test_shapes"]["Box"] == [f"80000800{i:03d}" for i in range(1, COUNT, 5)]
    assert len(splits["train"]["Box"]) == COUNT - COUNT // 5
    assert not splits["test_categories"] and not splits["extra"]
    assert {json.loads((p / "meta.json").read_text())["model_cat"] for p in folder.glob("8*")} == {"Box"}
