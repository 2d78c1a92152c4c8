"""PartNet-Mobility's on-disk layout of one object.

Meshes and joints are written in PartNet's mesh frame (see `solids`), scaled so that the object's diagonal is about 2;
the joint of the body turns them into the URDF's root frame, which is z up with the front towards -x.
"""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from mjcf_assets.procedural.components import Link
from vatmart_jax.atomic_io import atomic_directory

# Roll, pitch, yaw from PartNet's mesh frame to the URDF's root frame, as the data set writes it.
_BODY_RPY = "1.570796326794897 0 -1.570796326794897"


def write_object(folder: Path, category: str, links: list[Link], rng: np.random.Generator) -> None:
    """Write one object folder, complete or not at all.

    links: in any order, the body last. rng: draws the order of the links, the object's size and its offset from the
    origin.
    """
    if rng.random() < 0.5:
        links = [links[-1], *links[:-1]]
    points = np.concatenate([m.vertices for link in links for _, meshes in link.leaves for m in meshes])
    lo, hi = points.min(0), points.max(0)
    # The dataset's objects fill a unit sphere, more or less, and stand a little off its centre.
    scale = rng.uniform(2.0, 2.08) / float(np.linalg.norm(hi - lo))
    centre = (lo + hi) / 2 + rng.normal(0, 0.015, 3)
    index = {id(link): i for i, link in enumerate(links)}
    origins = [
        np.zeros(3) if link.joint is None or not link.joint.origin.any() else scale * (link.joint.origin - centre)
        for link in links
    ]
    robot = ElementTree.Element("robot", name=f"partnet_{folder.name}")
    ElementTree.SubElement(robot, "link", name="base")
    semantics, mobility = [], []
    with atomic_directory(folder) as part:
        (part / "textured_objs").mkdir()
        n_meshes = n_leaves = 0
        for i, link in enumerate(links):
            parent = -1 if link.parent is None else index[id(link.parent)]
            parent_origin = np.zeros(3) if parent < 0 else origins[parent]
            visuals, leaves = [], []
            for name, meshes in link.leaves:
                n_leaves += 1
                leaves.append({"id": n_leaves, "name": name, "children": []})
                for mesh in meshes:
                    n_meshes += 1
                    file = f"textured_objs/original-{n_meshes}.obj"
                    text = _obj(f"{name}-{n_meshes}", scale * (mesh.vertices - centre), mesh.faces)
                    (part / file).write_text(text)
                    visuals.append((f"{name}-{n_leaves}", file))
            semantics.append(f"link_{i} {link.kind}")
            _add_link(robot, i, visuals, -origins[i])
            _add_joint(robot, i, link, parent=parent, xyz=origins[i] - parent_origin, scale=scale)
            mobility.append({
                "id": i, "parent": parent, "joint": link.kind.split()[0], "name": link.name, "parts": leaves,
                "jointData": _joint_data(link, origins[i], scale),
            })  # fmt: skip
        ElementTree.indent(robot, "\t")
        ElementTree.ElementTree(robot).write(part / "mobility.urdf", encoding="utf-8", xml_declaration=True)
        (part / "semantics.txt").write_text("\n".join(semantics) + "\n")
        (part / "mobility_v2.json").write_text(json.dumps(mobility))
        meta = {"model_id": folder.name, "anno_id": folder.name, "user_id": "procedural", "time_in_sec": "0",
                "version": "1", "model_cat": category}  # fmt: skip
        (part / "meta.json").write_text(json.dumps(meta))
        bounds = {"min": (scale * (lo - centre)).round(6).tolist(), "max": (scale * (hi - centre)).round(6).tolist()}
        (part / "bounding_box.json").write_text(json.dumps(bounds))


def _obj(name: str, vertices: np.ndarray, faces: np.ndarray) -> str:
    """A Wavefront OBJ file of vertices [n, 3] and triangles [m, 3], counted from 0."""
    lines = [f"o {name}", *("v {:.6f} {:.6f} {:.6f}".format(*v) for v in vertices)]
    return "\n".join([*lines, *("f {} {} {}".format(*f) for f in faces + 1)]) + "\n"


def _text(numbers: np.ndarray) -> str:
    return " ".join(repr(float(x) + 0.0) for x in numbers)  # no -0.0


def _add_link(robot: ElementTree.Element, i: int, visuals: list[tuple[str, str]], origin: np.ndarray) -> None:
    """Add link_i with its visuals (name, mesh file), each a collision as well. origin: of the meshes, link frame."""
    link = ElementTree.SubElement(robot, "link", name=f"link_{i}")
    for tag in ("visual", "collision"):
        for name, file in visuals:
            element = ElementTree.SubElement(link, tag, {"name": name} if tag == "visual" else {})
            ElementTree.SubElement(element, "origin", xyz=_text(origin))
            geometry = ElementTree.SubElement(element, "geometry")
            ElementTree.SubElement(geometry, "mesh", filename=file)


def _add_joint(robot: ElementTree.Element, i: int, link: Link, *, parent: int, xyz: np.ndarray, scale: float) -> None:
    """Add joint_i between link_i and its parent, `base` where that is -1. xyz: where it is, in the parent's frame."""
    slide = link.kind.startswith("slider")
    if link.joint is None:
        kind = "fixed"
    else:
        kind = "continuous" if link.joint.upper is None else "prismatic" if slide else "revolute"
    joint = ElementTree.SubElement(robot, "joint", name=f"joint_{i}", type=kind)
    if link.joint is None:
        ElementTree.SubElement(joint, "origin", rpy=_BODY_RPY, xyz=_text(xyz))
    else:
        ElementTree.SubElement(joint, "origin", xyz=_text(xyz))
        ElementTree.SubElement(joint, "axis", xyz=_text(link.joint.axis))
    ElementTree.SubElement(joint, "child", link=f"link_{i}")
    ElementTree.SubElement(joint, "parent", link="base" if parent < 0 else f"link_{parent}")
    if link.joint is not None and link.joint.upper is not None:
        upper = float(link.joint.upper * (scale if slide else 1))
        ElementTree.SubElement(joint, "limit", lower="0.0", upper=str(upper))


def _joint_data(link: Link, origin: np.ndarray, scale: float) -> dict:
    """`jointData` of mobility_v2.json: lengths scaled, angles in degrees."""
    if link.joint is None:
        return {}
    upper = link.joint.upper
    b = 0 if upper is None else upper * scale if link.kind.startswith("slider") else float(np.degrees(upper))
    return {
        "axis": {"origin": origin.tolist(), "direction": link.joint.axis.tolist()},
        "limit": {"a": 0, "b": b, "noLimit": upper is None},
    }
