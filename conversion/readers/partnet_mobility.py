"""PartNet-Mobility object folders: `mobility.urdf`, its visual meshes and the annotation beside it.

A link frame is the URDF's; the object frame is the root link's (z up, front towards -x in the dataset's copies).
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import yourdfpy

from conversion.config import ReadConfig
from conversion.model import ArticulatedObject, Joint, Link, ObjectError, Visual
from conversion.readers.base import MAX_COORDINATE, ObjectFolder, is_handle
from conversion.readers.mesh_reader import MESH_SUFFIXES, MeshReader, cleaned, primitive

URDF_NAMES = ("mobility.urdf", "mobility_vhacd.urdf")
_SUFFIXES = (".urdf", ".json", ".txt", *MESH_SUFFIXES)
_TEXTURE_SUFFIXES = (".mtl", ".png", ".jpg", ".jpeg", ".bmp", ".gif")


class PartNetMobilityReader:
    """URDFs in PartNet-Mobility's layout: the data set's own, generated ones, and any other under the same names."""

    name = "partnet-mobility"

    def detects(self, folder: Path) -> bool:
        return any((folder / name).exists() for name in URDF_NAMES)

    def files(self, folder: Path, config: ReadConfig) -> Iterator[Path]:
        suffixes = _SUFFIXES + (_TEXTURE_SUFFIXES if config.textures else ())
        return (path for path in folder.rglob("*") if path.suffix.lower() in suffixes)

    def read(self, folder: Path, config: ReadConfig) -> ArticulatedObject:
        return read_object(folder, config)


READER = PartNetMobilityReader()


@np.errstate(invalid="ignore", over="ignore")  # what is not finite is refused by name
def read_object(folder: Path, config: ReadConfig | None = None) -> ArticulatedObject:
    """Read `mobility.urdf` (or `mobility_vhacd.urdf`), its visual meshes and the annotation beside it.

    Raises ObjectError.
    """
    source = ObjectFolder(Path(folder), config or ReadConfig())
    urdf = next((n for n in URDF_NAMES if source.path(n, n).is_file()), None)
    if urdf is None:
        raise ObjectError(f"{folder}: no mobility.urdf in it; name a PartNet-Mobility object folder")
    robot = _parse_urdf(source, urdf)
    joints = {}
    for j in robot.joints:
        if j.child in joints:
            raise source.error(f"link {j.child!r} hangs on two joints; keep one", urdf)
        joints[j.child] = _joint(source, urdf, j)
    order = _tree(source, urdf, [link.name for link in robot.links], joints)
    semantics = _semantics(source)
    by_name = {link.name: link for link in robot.links}
    meshes = MeshReader(source)
    links = {}
    for name in order:
        visuals = tuple(_visuals(meshes, urdf, by_name[name]))
        links[name] = Link(name=name, semantics=semantics.get(name, ""), visuals=visuals)
    if not any(link.visuals for link in links.values()):
        raise source.error("no link has a visual mesh with a surface; nothing to convert", urdf)
    meta = source.json("meta.json")
    category = meta.get("model_cat") if isinstance(meta, dict) else None
    return ArticulatedObject(
        id=source.folder.resolve().name,
        category=category if isinstance(category, str) and category else "Unknown",
        folder=source.folder,
        links=links,
        joints={name: joints[name] for name in order if name in joints},
        notes=tuple(dict.fromkeys(source.notes)),
    )


def _parse_urdf(source: ObjectFolder, urdf: str) -> yourdfpy.Robot:
    try:
        root = ElementTree.fromstring(source.path(urdf, urdf).read_bytes())
    except (ElementTree.ParseError, OSError, ValueError) as e:
        raise source.error(f"not XML ({e}); download the object again", urdf) from None
    if root.tag != "robot":
        raise source.error(f"root is <{root.tag}>, not <robot>; give a URDF", urdf)
    try:
        # Written again, it has no document type left: yourdfpy's parser would open files that one names.
        data = ElementTree.tostring(root)
        robot = yourdfpy.URDF.load(io.BytesIO(data), build_scene_graph=False, load_meshes=False).robot
    except Exception as e:  # yourdfpy raises whatever its parsing runs into
        raise source.error(f"not a readable URDF ({type(e).__name__}: {e}); repair it", urdf) from None
    for kind, names in (("link", [x.name for x in robot.links]), ("joint", [x.name for x in robot.joints])):
        seen = set()
        for name in names:
            if not name or name in seen:
                raise source.error(f"{kind} name {name!r} is empty or used twice; rename it", urdf)
            seen.add(name)
    if not robot.links:
        raise source.error("has no links", urdf)
    return robot


def _joint(source: ObjectFolder, urdf: str, j: yourdfpy.Joint) -> Joint:
    where = f"joint {j.name!r}"
    if j.type not in ("fixed", "revolute", "prismatic", "continuous"):
        raise source.error(f"{where} has type {j.type!r}; use fixed, revolute, prismatic or continuous", urdf)
    origin = np.eye(4) if j.origin is None else np.asarray(j.origin, np.float64)
    axis = np.array([1.0, 0, 0]) if j.axis is None else np.asarray(j.axis, np.float64)
    if not (np.isfinite(origin).all() and np.abs(origin).max() < MAX_COORDINATE):
        raise source.error(f"{where} has an origin that is not finite or beyond {MAX_COORDINATE:g}; repair it", urdf)
    norm = np.linalg.norm(axis) if axis.shape == (3,) else np.nan
    if j.type == "fixed":
        axis, lower, upper = np.array([1.0, 0, 0]), 0.0, 0.0
        return Joint(
            name=j.name,
            type="fixed",
            parent=j.parent,
            child=j.child,
            origin=origin,
            axis=axis,
            lower=lower,
            upper=upper,
        )
    if not 1e-6 < norm < np.inf:
        raise source.error(f"{where} has axis {axis}; expected three finite numbers, not all 0", urdf)
    if j.type == "prismatic" and abs(norm - 1) > 1e-3:
        source.notes.append(f"{where}: axis of length {norm:.3g}, taken as a direction; its values are unit lengths")
    axis = axis / norm
    lower, upper = -np.inf, np.inf
    if j.type != "continuous":
        if j.limit is None or (j.limit.lower is None and j.limit.upper is None):
            if not source.config.continuous_range:
                raise source.error(f"{where} has no limit; give it one or pass --continuous-range", urdf)
        else:
            lower, upper = float(j.limit.lower or 0.0), float(j.limit.upper or 0.0)
    if np.isnan(lower) or np.isnan(upper):
        raise source.error(f"{where} has limit [{lower}, {upper}]; expected two numbers", urdf)
    if lower > upper:
        source.notes.append(f"{where}: lower > upper, swapped")
        lower, upper = upper, lower
    if not (np.isfinite(lower) and np.isfinite(upper)):
        lower, upper = -np.inf, np.inf
    elif max(-lower, upper) > MAX_COORDINATE:
        raise source.error(f"{where} has limit [{lower:g}, {upper:g}]; expected radians or unit lengths", urdf)
    joint = Joint(
        name=j.name, type=j.type, parent=j.parent, child=j.child, origin=origin, axis=axis, lower=lower, upper=upper
    )
    if upper - lower < 1e-9:
        source.notes.append(f"{where}: empty range, fixed")
        return replace(joint, type="fixed", origin=origin @ joint.motion(lower), lower=0.0, upper=0.0)
    return joint


def _tree(source: ObjectFolder, urdf: str, links: list[str], joints: dict[str, Joint]) -> list[str]:
    """Link names, parents before children."""
    for joint in joints.values():
        for name in (joint.parent, joint.child):
            if name not in links:
                raise source.error(f"joint {joint.name!r} names link {name!r}, which is not there; add it", urdf)
    roots = [name for name in links if name not in joints]
    if len(roots) != 1:
        what = f"links {roots[:3]} hang on nothing" if roots else "every link hangs on another"
        raise source.error(f"{what}; the joints must form one tree", urdf)
    children: dict[str, list[str]] = {}
    for name in links:
        if name in joints:
            children.setdefault(joints[name].parent, []).append(name)
    order = roots
    for name in order:  # grows as it is walked
        order.extend(children.get(name, ()))
    if len(order) != len(links):
        lost = next(n for n in links if n not in order)
        raise source.error(f"link {lost!r} is part of a cycle; the joints must form one tree", urdf)
    return order


def _semantics(source: ObjectFolder) -> dict[str, str]:
    out = {}
    for line in (source.text("semantics.txt") or "").splitlines():
        if len(words := line.split()) == 3:
            out[words[0]] = words[2]
    if not out:
        annotation = source.json("mobility_v2.json")
        for entry in annotation if isinstance(annotation, list) else ():
            if isinstance(entry, dict) and "id" in entry:
                out[f"link_{entry['id']}"] = str(entry.get("name", ""))
    return out


def _visuals(meshes: MeshReader, urdf: str, link: yourdfpy.Link) -> Iterator[Visual]:
    source = meshes.folder
    wanted = [(v, v.geometry) for v in link.visuals if v.geometry is not None]
    missing, empty = [], []
    for i, (visual, geometry) in enumerate(wanted):
        file = None
        if geometry.mesh is not None:
            file = geometry.mesh.filename
            if not file:
                raise source.error(f"link {link.name!r} has a mesh without filename; give it one", urdf)
            if (mesh := meshes.mesh(file, urdf)) is None:
                missing.append(file)
                continue
            scale = np.asarray(1.0 if geometry.mesh.scale is None else geometry.mesh.scale, np.float64)
            if scale.shape not in ((), (3,)) or not np.isfinite(scale).all():
                raise source.error(f"link {link.name!r}: mesh scale {scale}; expected one or three numbers", urdf)
            vertices = mesh.vertices * scale
        else:
            mesh = primitive(source, urdf, link.name, geometry)
            vertices = mesh.vertices
        origin = np.eye(4) if visual.origin is None else np.asarray(visual.origin, np.float64)
        vertices = vertices @ origin[:3, :3].T + origin[:3, 3]
        if not (np.isfinite(vertices).all() and np.abs(vertices).max(initial=0) < MAX_COORDINATE):
            what = f"link {link.name!r}, visual {visual.name or i!r}: coordinates not finite or beyond"
            raise source.error(f"{what} {MAX_COORDINATE:g} unit lengths; repair them", file or urdf)
        vertices, faces, kept = cleaned(vertices, mesh.faces)
        if not len(faces):
            empty.append(file)
            continue
        name = visual.name or f"{link.name}_{i}"
        yield Visual(
            name=name,
            vertices=vertices,
            faces=faces,
            is_handle=is_handle(f"{visual.name or ''} {link.name}"),
            file=file,
            materials=None if mesh.materials is None else mesh.materials.subset(kept),
        )
    if missing:
        what = f"link {link.name!r}: {len(missing)} of {len(wanted)} meshes missing"
        if not source.config.allow_missing:
            raise source.error(f"{what}; restore them or pass --allow-missing", missing[0])
        source.notes.append(f"{what}, left out: {', '.join(missing[:3])}")
    if empty:
        source.notes.append(f"link {link.name!r}: {len(empty)} meshes without surface, ignored")
