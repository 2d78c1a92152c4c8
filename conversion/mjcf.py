# MuJoCo's compiled names are invisible to pyright.
# pyright: reportAttributeAccessIssue=false

"""A converted object as a complete MJCF model that is useful by itself.

Written as XML here rather than by MjSpec: MuJoCo's writer keeps six digits, which is 1e-5 in a link's pose.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from conversion.config import MjcfConfig
from conversion.model import ConvertedObject, Joint, Material, ObjectError, Visual
from conversion.palette import BODY, HANDLE, PARTS

VISUAL_GROUP, COLLISION_GROUP = 2, 3


@dataclass(frozen=True, kw_only=True)
class Mjcf:
    xml: str
    assets: dict[str, bytes]  # file name below assets/ -> content

    def write(self, folder: Path) -> None:
        """model.xml and assets/ into an existing folder."""
        (folder / "assets").mkdir()
        for name, data in self.assets.items():
            (folder / "assets" / name).write_bytes(data)
        (folder / "model.xml").write_text(self.xml)

    def compile(self) -> mujoco.MjModel:
        """Raises ObjectError where MuJoCo refuses the model."""
        try:
            return mujoco.MjModel.from_xml_string(self.xml, {f"assets/{k}": v for k, v in self.assets.items()})
        except ValueError as e:
            raise ObjectError(f"MuJoCo does not compile the model: {' '.join(str(e).split())}") from None


def to_mjcf(converted: ConvertedObject, config: MjcfConfig) -> Mjcf:
    """One body per link and one joint per moving joint, under the URDF's names (a link `world` becomes `world_`).

    Geoms of the object never collide with each other: hulls of neighbours touch, and MuJoCo does not filter pairs
    whose parent is welded to the world. Weight is compensated: annotations know no springs and no latches, without
    which flaps and lids would fall open. Keyframes `closed` and `open` set doors, drawers and lids, all else at 0.
    """
    obj = converted.obj
    root = Element("mujoco", model=f"{obj.category}_{obj.id}")
    compiler = SubElement(root, "compiler", angle="radian", meshdir="assets", autolimits="false")
    SubElement(root, "option", integrator="implicitfast")
    default = SubElement(root, "default")
    SubElement(
        default, "joint", damping=_text(config.joint_damping), frictionloss=_text(config.joint_friction),
        armature="0.001", solreflimit="0.01 1", solimplimit="0.95 0.99 0.001",
    )  # fmt: skip
    visual = SubElement(default, "default", {"class": "visual"})
    SubElement(visual, "geom", type="mesh", group=str(VISUAL_GROUP), contype="0", conaffinity="0", mass="0")
    collision = SubElement(default, "default", {"class": "collision"})
    SubElement(
        collision, "geom", type="mesh", group=str(COLLISION_GROUP), contype="0", conaffinity="1",
        density=_text(config.density), friction=f"{_text(config.friction)} 0.005 0.0001", rgba="0.4 0.6 0.9 0.4",
    )  # fmt: skip
    custom, asset = SubElement(root, "custom"), SubElement(root, "asset")
    world = SubElement(root, "worldbody")
    bodies: dict[str, Element] = {}
    assets: dict[str, bytes] = {}
    materials: dict[Material, str] = {}
    textures: dict[bytes, str] = {}
    geom_names: Counter[str] = Counter()
    colors = {p.link: _rgba(PARTS[i % len(PARTS)]) for i, p in enumerate(converted.parts)}

    def unique(name: str) -> str:
        geom_names[name] += 1
        return name if geom_names[name] == 1 else f"{name}.{geom_names[name] - 1}"

    def named(material: Material) -> str:
        if material not in materials:
            materials[material] = f"material_{len(materials)}"
            element = SubElement(asset, "material", name=materials[material], rgba=_text(material.rgba))
            if material.png is not None:
                if material.png not in textures:
                    textures[material.png] = f"texture_{len(textures)}"
                    compiler.set("texturedir", "assets")
                    assets[f"{textures[material.png]}.png"] = material.png
                    SubElement(
                        asset, "texture", name=textures[material.png], type="2d", file=f"{textures[material.png]}.png"
                    )
                element.set("texture", textures[material.png])
        return materials[material]

    for name, link in obj.links.items():
        joint = obj.joints.get(name)
        body = SubElement(world if joint is None else bodies[joint.parent], "body", name=_body_name(name))
        bodies[name] = body
        if joint is not None:
            _place(body, joint.origin)
            if joint.type != "fixed":
                body.set("gravcomp", "1")
                _joint(body, joint)
        if link.semantics:
            SubElement(custom, "text", name=f"semantics:{name}", data=link.semantics)
        color = colors.get(obj.group_root(name), _rgba(BODY))
        for v in link.visuals:
            for vertices, faces, uv, material in _pieces(v):
                mesh = f"visual_{len(assets)}"
                assets[f"{mesh}.obj"] = _obj(vertices, faces, uv)
                SubElement(asset, "mesh", name=mesh, file=f"{mesh}.obj", inertia="shell")
                geom = SubElement(body, "geom", {"class": "visual"}, name=unique(f"{name}/{v.name}"), mesh=mesh)
                if material is None:
                    geom.set("rgba", _rgba(HANDLE) if v.is_handle else color)
                else:
                    geom.set("material", named(material))
    for group, hulls in converted.hulls.items():
        home, frame = _home(converted, group)
        for i, hull in enumerate(hulls):
            label = f"{home}/{'handle' if hull.is_handle else 'hull'}_{i}"
            geom = SubElement(bodies[home], "geom", {"class": "collision"}, name=unique(label))
            if hull.box_pose is not None:
                geom.set("type", "box")
                geom.set("size", _text(hull.box_size))
                _place(geom, frame @ hull.box_pose)
            else:
                points = hull.vertices @ frame[:3, :3].T + frame[:3, 3]
                geom.set("mesh", label)
                SubElement(asset, "mesh", name=label, vertex=_text(points), inertia="convex")
        if not hulls and group != obj.root:  # MuJoCo wants mass on whatever moves
            SubElement(bodies[group], "inertial", pos="0 0 0", mass="0.001", diaginertia="1e-6 1e-6 1e-6")
    ElementTree.indent(root)
    draft = Mjcf(xml=ElementTree.tostring(root, encoding="unicode"), assets=assets)
    if not converted.parts:
        return draft
    # The order of qpos is MuJoCo's, so keyframes need the compiled model.
    model = draft.compile()
    keyframe = SubElement(root, "keyframe")
    qpos = np.zeros(model.nq)
    for joint in obj.joints.values():
        if joint.type != "fixed":
            qpos[model.joint(joint.name).qposadr[0]] = np.clip(0.0, joint.lower, joint.upper)
    for key, opening in (("closed", 0.0), ("open", 1.0)):
        for part in converted.parts:
            qpos[model.joint(part.joint).qposadr[0]] = part.closed + part.sign * part.joint_range * opening
        SubElement(keyframe, "key", name=key, qpos=_text(qpos))
    ElementTree.indent(root)
    return Mjcf(xml=ElementTree.tostring(root, encoding="unicode"), assets=assets)


def _rgba(color: tuple[float, float, float]) -> str:
    return " ".join(f"{x:.2f}" for x in color) + " 1"


def _body_name(link: str) -> str:
    return "world_" if link == "world" else link


def _text(values) -> str:
    return " ".join(f"{x:.10g}" for x in np.ravel(values))


def _place(element: Element, pose: np.ndarray) -> None:
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    element.set("pos", _text(pose[:3, 3]))
    element.set("quat", _text([w, x, y, z]))


def _joint(body: Element, joint: Joint) -> None:
    kind = "slide" if joint.type == "prismatic" else "hinge"
    element = SubElement(body, "joint", name=joint.name, type=kind, axis=_text(joint.axis))
    element.set("limited", str(joint.limited).lower())
    if joint.limited:
        element.set("range", _text([joint.lower, joint.upper]))


def _home(converted: ConvertedObject, group: str) -> tuple[str, np.ndarray]:
    """The link whose body carries a group's hulls, and the group's frame in that of the link.

    A moving group's is its root. The world's is the link most is seen of, for its root is an empty `base`.
    """
    obj = converted.obj
    if group != obj.root:
        return group, np.eye(4)
    home = max(obj.groups[group], key=lambda name: len(obj.links[name].visuals))
    return home, np.linalg.inv(obj.link_poses()[home])


def _pieces(visual: Visual) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray | None, Material | None]]:
    """Vertices, faces, texture coordinates [m, 3, 2] of their corners, and material: MuJoCo has one per geom."""
    of_faces = visual.materials
    if of_faces is None:
        yield visual.vertices, visual.faces, None, None
        return
    for i in np.unique(of_faces.index):
        rows, material = of_faces.index == i, of_faces.materials[i]
        used, faces = np.unique(visual.faces[rows], return_inverse=True)
        uv = of_faces.uv[rows] if material is not None and material.png is not None else None
        yield visual.vertices[used], faces.reshape(-1, 3), uv, material


def _obj(vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray | None) -> bytes:
    """Both sides of every face, on vertices of their own: windings of the dataset are random, renderers cull."""
    if len(vertices) == 3:  # MuJoCo wants four
        vertices = np.concatenate([vertices, vertices[:1]])
    n = len(vertices)
    both = np.concatenate([vertices, vertices])
    corners = np.concatenate([faces, faces[:, ::-1] + n]) + 1
    lines = [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in both]
    if uv is None:
        lines += [f"f {a} {b} {c}" for a, b, c in corners]
    else:
        points, index = np.unique(np.concatenate([uv, uv[:, ::-1]]).reshape(-1, 2), axis=0, return_inverse=True)
        lines += [f"vt {x:.7g} {y:.7g}" for x, y in points]
        pairs = zip(corners, index.reshape(-1, 3) + 1, strict=True)
        lines += [f"f {a}/{i} {b}/{j} {c}/{k}" for (a, b, c), (i, j, k) in pairs]
    return "\n".join(lines).encode() + b"\n"
