"""PartNet-Mobility's on-disk layout of one object."""

from __future__ import annotations

import json
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from mjcf_assets.procedural.components import Link
from vatmart_jax.files import whole_folder


def write_object(folder: Path, category: str, links: list[Link], rng: np.random.Generator) -> None:
    """One object folder, complete or not at all. The links come in any order, the body is the one without a parent."""
    if rng.random() < 0.5:
        links = [links[-1], *links[:-1]]
    points = np.concatenate([m.vertices for link in links for _, meshes in link.leaves for m in meshes])
    lo, hi = points.min(0), points.max(0)
    # The dataset's objects fill a unit sphere, more or less, and stand a little off its centre.
    scale = rng.uniform(2.0, 2.08) / float(np.linalg.norm(hi - lo))
    centre = (lo + hi) / 2 + rng.normal(0, 0.015, 3)
    index = {id(link): i for i, link in enumerate(links)}
    origin = [
        np.zeros(3) if link.joint is None or not link.joint.origin.any() else scale * (link.joint.origin - centre)
        for link in links
    ]
    with whole_folder(folder) as part:
        (part / "textured_objs").mkdir()
        urdf, semantics, mobility = [], [], []
        objs = parts = 0
        for i, link in enumerate(links):
            parent = -1 if link.parent is None else index[id(link.parent)]
            base = np.zeros(3) if parent < 0 else origin[parent]
            visuals, names = [], []
            for name, meshes in link.leaves:
                parts += 1
                names.append({"id": parts, "name": name, "children": []})
                for mesh in meshes:
                    objs += 1
                    file = f"textured_objs/original-{objs}.obj"
                    text = _obj(f"{name}-{objs}", scale * (mesh.vertices - centre), mesh.faces)
                    (part / file).write_text(text)
                    visuals.append((f"{name}-{parts}", file))
            semantics.append(f"link_{i} {link.kind}")
            urdf += _link(i, visuals, -origin[i]) + _joint(i, link, parent, origin[i] - base, scale)
            mobility.append({
                "id": i, "parent": parent, "joint": link.kind.split()[0], "name": link.name, "parts": names,
                "jointData": _joint_data(link, origin[i], scale),
            })  # fmt: skip
        (part / "mobility.urdf").write_text(
            "\n".join(
                ['<?xml version="1.0" ?>', f'<robot name="partnet_{folder.name}">', '\t<link name="base"/>', *urdf]
            )
            + "\n</robot>\n"
        )
        (part / "semantics.txt").write_text("\n".join(semantics) + "\n")
        (part / "mobility_v2.json").write_text(json.dumps(mobility))
        meta = {"model_id": folder.name, "anno_id": folder.name, "user_id": "procedural", "time_in_sec": "0",
                "version": "1", "model_cat": category}  # fmt: skip
        (part / "meta.json").write_text(json.dumps(meta))
        box_ = {"min": (scale * (lo - centre)).round(6).tolist(), "max": (scale * (hi - centre)).round(6).tolist()}
        (part / "bounding_box.json").write_text(json.dumps(box_))


def _obj(name: str, vertices: np.ndarray, faces: np.ndarray) -> str:
    lines = [f"o {name}", *("v {:.6f} {:.6f} {:.6f}".format(*v) for v in vertices)]
    return "\n".join([*lines, *("f {} {} {}".format(*f) for f in faces + 1)]) + "\n"


def _xyz(v: np.ndarray) -> str:
    return '"' + " ".join(repr(float(x) + 0.0) for x in v) + '"'


def _link(i: int, visuals: list[tuple[str, str]], origin: np.ndarray) -> list[str]:
    lines = [f'\t<link name="link_{i}">']
    for tag in ("visual", "collision"):
        for name, file in visuals:
            lines += [
                f"\t\t<{tag} name={quoteattr(name)}>" if tag == "visual" else f"\t\t<{tag}>",
                f"\t\t\t<origin xyz={_xyz(origin)}/>",
                "\t\t\t<geometry>",
                f'\t\t\t\t<mesh filename="{file}"/>',
                "\t\t\t</geometry>",
                f"\t\t</{tag}>",
            ]
    return [*lines, "\t</link>"]


def _joint(i: int, link: Link, parent: int, xyz: np.ndarray, scale: float) -> list[str]:
    slide = link.kind.startswith("slider")
    if link.joint is None:
        kind, middle = "fixed", [f'\t\t<origin rpy="1.570796326794897 0 -1.570796326794897" xyz={_xyz(xyz)}/>']
    else:
        kind = "continuous" if link.joint.upper is None else "prismatic" if slide else "revolute"
        middle = [f"\t\t<origin xyz={_xyz(xyz)}/>", f"\t\t<axis xyz={_xyz(link.joint.axis)}/>"]
    lines = [f'\t<joint name="joint_{i}" type="{kind}">', *middle, f'\t\t<child link="link_{i}"/>']
    lines.append(f'\t\t<parent link="{"base" if parent < 0 else f"link_{parent}"}"/>')
    if link.joint is not None and link.joint.upper is not None:
        lines.append(f'\t\t<limit lower="0.0" upper="{float(link.joint.upper * (scale if slide else 1))}"/>')
    return [*lines, "\t</joint>"]


def _joint_data(link: Link, origin: np.ndarray, scale: float) -> dict:
    if link.joint is None:
        return {}
    upper = link.joint.upper
    b = 0 if upper is None else upper * scale if link.kind.startswith("slider") else float(np.degrees(upper))
    return {
        "axis": {"origin": origin.tolist(), "direction": link.joint.axis.tolist()},
        "limit": {"a": 0, "b": b, "noLimit": upper is None},
    }
