"""Read one PartNet-Mobility object folder: links, joints, and which of them are doors and drawers.

Frames: the object frame is the root link's, as in the URDF (z up, front towards -x in the dataset's copies); a link
frame is the URDF's. Lengths are unit lengths of the dataset, angles radians.
"""

from __future__ import annotations

import io
import json
import os
import re
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import trimesh
import yourdfpy
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation
from trimesh.ray.ray_pyembree import RayMeshIntersector

from conversion.textures import Material, Skin, read_mtl, read_png
from vatmart_jax.atomic_io import whole
from vatmart_jax.errors import UserError

MAX_COORDINATE = 1e3  # objects are normalised to about 2 unit lengths; anything near this is damage
MAX_FILE_BYTES = 256 * 2**20
MIN_SWING = np.deg2rad(10)  # a joint that travels less is no task
MIN_SLIDE = 0.1
TEXTURE_SIZE = 512  # pixels; larger pictures are made smaller

HANDLE_WORDS = ("handle", "knob", "pull")
# Links that move but are neither door nor drawer, by their own semantics or because all their visuals are such.
SMALL_WORDS = (
    "handle", "knob", "button", "switch", "wheel", "caster", "tray", "lock", "lever", "latch", "buckle", "movable_part",
)  # fmt: skip
OTHER_WORDS = ("shelf", "rack", "board", "key", "pedal", "leg", "seat", "fan", "blade", "screw", "slider", "screen")


class ObjectError(UserError):
    """An object folder cannot be converted; one line that names the file, the thing and the remedy."""


@dataclass(frozen=True)
class Visual:
    name: str
    vertices: np.ndarray  # [n, 3] float64, link frame
    faces: np.ndarray  # [m, 3] int64, each triangle once, winding meaningless
    is_handle: bool
    file: str | None  # relative to the object folder; None for a primitive
    skin: Skin | None = None  # where materials were asked for and the file names some


@dataclass(frozen=True)
class Link:
    name: str
    semantics: str  # PartNet-Mobility's name (drawer, rotation_door, furniture_body, ...), "" where it has none
    visuals: tuple[Visual, ...]


@dataclass(frozen=True)
class Joint:
    name: str
    type: str  # fixed, revolute, prismatic or continuous
    parent: str
    child: str
    origin: np.ndarray  # [4, 4] child frame in the parent's at joint value 0
    axis: np.ndarray  # [3] unit, child frame
    lower: float  # rad or unit lengths; both infinite where the joint has no limit
    upper: float

    @property
    def limited(self) -> bool:
        return bool(np.isfinite(self.lower))

    def motion(self, value: float) -> np.ndarray:
        """Pose [4, 4] of the moved child frame in the child frame at 0."""
        out = np.eye(4)
        if self.type == "prismatic":
            out[:3, 3] = value * self.axis
        elif self.type != "fixed":
            out[:3, :3] = Rotation.from_rotvec(value * self.axis).as_matrix()
        return out


@dataclass(frozen=True)
class PartNetObject:
    id: str
    category: str
    folder: Path
    links: Mapping[str, Link]  # parents before children
    joints: Mapping[str, Joint]  # by child link
    notes: tuple[str, ...] = ()  # what was repaired or ignored while reading

    @property
    def root(self) -> str:
        return next(iter(self.links))

    def link_poses(self, values: Mapping[str, float] | None = None) -> dict[str, np.ndarray]:
        """Pose [4, 4] of every link in the object frame. values: by joint name; default 0, clamped to the range."""
        poses = {self.root: np.eye(4)}
        for name in self.links:
            if joint := self.joints.get(name):
                value = (values or {}).get(joint.name, float(np.clip(0.0, joint.lower, joint.upper)))
                poses[name] = poses[joint.parent] @ joint.origin @ joint.motion(value)
        return poses

    def group_root(self, link: str) -> str:
        """The link that carries this one rigidly: a moving link, or the root for all that is fixed to the world."""
        while link in self.joints and self.joints[link].type == "fixed":
            link = self.joints[link].parent
        return link

    @property
    def groups(self) -> dict[str, list[str]]:
        """Links that move as one, by their group root; the static group comes first."""
        out: dict[str, list[str]] = {}
        for name in self.links:
            out.setdefault(self.group_root(name), []).append(name)
        return out

    def group_visuals(self, root: str) -> list[Visual]:
        """Visuals of a whole group, in the frame of its root."""
        zero = self.link_poses()
        base = np.linalg.inv(zero[root])
        out = []
        for name in self.groups[root]:
            pose = base @ zero[name] if name != root else np.eye(4)
            for visual in self.links[name].visuals:
                out.append(replace(visual, vertices=visual.vertices @ pose[:3, :3].T + pose[:3, 3]))
        return out

    def subtree(self, link: str) -> list[str]:
        """This link and all that hangs on it, moving or not."""
        out = [link]
        for name in self.links:
            if name in self.joints and self.joints[name].parent in out:
                out.append(name)
        return out


@dataclass(frozen=True)
class Part:
    """A door or a drawer. URDF joint value = closed + sign * q, opening q in [0, width]."""

    joint: str
    link: str
    kind: str  # door (revolute) or drawer (prismatic)
    closed: float
    sign: int
    width: float


@dataclass(frozen=True)
class Hull:
    vertices: np.ndarray  # [n, 3] float64, frame of the group root; the 8 corners where it is a box
    is_handle: bool
    box_pose: np.ndarray | None = None  # [4, 4] centre and axes, same frame; None for a hull
    box_size: np.ndarray | None = None  # [3] half extents


@dataclass(frozen=True)
class ConvertedObject:
    """An object and its collision geometry, as `vatmart convert` leaves it in one folder."""

    obj: PartNetObject
    hulls: Mapping[str, list[Hull]]  # by group root, in its frame
    parts: list[Part]
    left_out: list[tuple[str, str]]  # joint, why it is no part
    split: str  # train, test_shapes, test_categories or extra

    def save(self, folder: Path) -> None:
        """Write object.npz, complete or not at all."""
        visuals = [(link.name, v) for link in self.obj.links.values() for v in link.visuals]
        hulls = [(root, h) for root, group in self.hulls.items() for h in group]
        text = {
            "id": self.obj.id,
            "category": self.obj.category,
            "split": self.split,
            "notes": self.obj.notes,
            "links": [(link.name, link.semantics) for link in self.obj.links.values()],
            "joints": [(j.name, j.type, j.parent, j.child) for j in self.obj.joints.values()],
            "visuals": [(name, v.name, v.is_handle, v.file) for name, v in visuals],
            "hulls": [(root, h.is_handle, h.box_size is not None) for root, h in hulls],
            "parts": [vars(p) for p in self.parts],
            "left_out": self.left_out,
        }
        joints = list(self.obj.joints.values())
        vertices, vertex_start = _pack([v.vertices for _, v in visuals])
        faces, face_start = _pack([v.faces for _, v in visuals])
        hull_vertices, hull_start = _pack([h.vertices for _, h in hulls])
        boxes = [h for _, h in hulls if h.box_size is not None]
        with whole(folder / "object.npz") as part, part.open("wb") as f:
            np.savez(
                f,
                text=np.array(json.dumps(text)),
                origin=np.array([j.origin for j in joints]).reshape(-1, 4, 4),
                axis=np.array([j.axis for j in joints]).reshape(-1, 3),
                limit=np.array([(j.lower, j.upper) for j in joints]).reshape(-1, 2),
                vertices=vertices.astype(np.float32),
                vertex_start=vertex_start,
                faces=faces.astype(np.int32),
                face_start=face_start,
                hull_vertices=hull_vertices,
                hull_start=hull_start,
                box_pose=np.array([h.box_pose for h in boxes]).reshape(-1, 4, 4),
                box_size=np.array([h.box_size for h in boxes]).reshape(-1, 3),
            )

    @classmethod
    def load(cls, folder: Path) -> ConvertedObject:
        """Raises ObjectError where the folder holds no converted object."""
        path = folder / "object.npz"
        try:
            with np.load(path, allow_pickle=False) as f:
                a = {k: f[k] for k in f.files}
            text = json.loads(str(a["text"]))
            vertices = np.split(a["vertices"].astype(np.float64), a["vertex_start"][1:-1])
            faces = np.split(a["faces"].astype(np.int64), a["face_start"][1:-1])
            points = np.split(a["hull_vertices"], a["hull_start"][1:-1])
        except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile) as e:
            raise ObjectError(f"{path}: not a converted object ({e}); run `vatmart convert` again") from e
        visuals: dict[str, list[Visual]] = {}
        for i, (link, name, is_handle, file) in enumerate(text["visuals"]):
            visuals.setdefault(link, []).append(Visual(name, vertices[i], faces[i], is_handle, file))
        joints = [
            Joint(
                name,
                kind,
                parent,
                child,
                a["origin"][i],
                a["axis"][i],
                float(a["limit"][i, 0]),
                float(a["limit"][i, 1]),
            )
            for i, (name, kind, parent, child) in enumerate(text["joints"])
        ]
        obj = PartNetObject(
            text["id"],
            text["category"],
            folder,
            {name: Link(name, semantics, tuple(visuals.get(name, ()))) for name, semantics in text["links"]},
            {j.child: j for j in joints},
            tuple(text["notes"]),
        )
        hulls: dict[str, list[Hull]] = {root: [] for root in obj.groups}
        boxes = iter(zip(a["box_pose"], a["box_size"], strict=True))
        for i, (root, is_handle, is_box) in enumerate(text["hulls"]):
            hulls[root].append(Hull(points[i], is_handle, *(next(boxes) if is_box else (None, None))))
        parts = [Part(**p) for p in text["parts"]]
        return cls(obj, hulls, parts, [(j, why) for j, why in text["left_out"]], text["split"])


@dataclass(frozen=True)
class _Mesh:
    vertices: np.ndarray  # [n, 3] float64
    faces: np.ndarray  # [m, 3] int64
    skin: Skin | None = None


def _pack(arrays: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    start = np.cumsum([0] + [len(a) for a in arrays])
    return (np.concatenate(arrays) if arrays else np.zeros((0, 3))), start


@dataclass
class _Reader:
    """Where in which folder we are, so that every message can say so."""

    folder: Path
    continuous_range: bool
    allow_missing: bool
    textures: bool
    notes: list[str] = field(default_factory=list)
    meshes: dict[str, _Mesh | None] = field(default_factory=dict)
    pictures: dict[str, bytes | None] = field(default_factory=dict)

    def error(self, what: str, file: str) -> ObjectError:
        return ObjectError(f"{self.folder.name}/{file}: {what}")

    def path(self, name: str, user: str) -> Path:
        """The file of this name inside the folder; one that leads out of it is refused, whatever the way."""
        path = self.folder / name
        try:
            inside = path.resolve().is_relative_to(self.folder.resolve())
        except (OSError, RuntimeError, ValueError):  # loops of links, NUL bytes, names too long
            inside = False
        if not inside or Path(name).is_absolute():
            raise self.error(f"path {name!r} leaves the object's folder; use one inside it", user)
        if path.is_file() and path.stat().st_size > MAX_FILE_BYTES:
            raise self.error(f"larger than {MAX_FILE_BYTES >> 20} MiB; simplify it", name)
        return path

    def note(self, what: str) -> None:
        """Once, however many files give rise to it."""
        if what not in self.notes:
            self.notes.append(what)

    def text(self, name: str) -> str | None:
        """A small side file, or None where it is missing or unreadable: nothing depends on one alone."""
        try:
            return self.path(name, name).read_text(errors="replace")
        except (OSError, ObjectError):
            return None

    def json(self, name: str) -> Any:
        try:
            return json.loads(self.text(name) or "null")
        except (ValueError, RecursionError):
            self.notes.append(f"{name} is not JSON, ignored")
            return None


@np.errstate(invalid="ignore", over="ignore")  # what is not finite is refused by name
def read_object(
    folder: Path, *, continuous_range: bool = False, allow_missing: bool = False, textures: bool = False
) -> PartNetObject:
    """Read `mobility.urdf` (or `mobility_vhacd.urdf`), its visual meshes and the annotation beside it.

    continuous_range: a joint without limits may move without end. allow_missing: meshes may be missing, which is noted.
    textures: visuals get a skin. Raises ObjectError.
    """
    reader = _Reader(Path(folder), continuous_range, allow_missing, textures)
    names = ("mobility.urdf", "mobility_vhacd.urdf")
    urdf = next((n for n in names if reader.path(n, n).is_file()), None)
    if urdf is None:
        raise ObjectError(f"{folder}: no mobility.urdf in it; name a PartNet-Mobility object folder")
    robot = _parse_urdf(reader, urdf)
    joints = {}
    for j in robot.joints:
        if j.child in joints:
            raise reader.error(f"link {j.child!r} hangs on two joints; keep one", urdf)
        joints[j.child] = _joint(reader, urdf, j)
    order = _tree(reader, urdf, [link.name for link in robot.links], joints)
    semantics = _semantics(reader)
    by_name = {link.name: link for link in robot.links}
    links = {}
    for name in order:
        visuals = tuple(_visuals(reader, urdf, by_name[name]))
        links[name] = Link(name, semantics.get(name, ""), visuals)
    if not any(link.visuals for link in links.values()):
        raise reader.error("no link has a visual mesh with a surface; nothing to convert", urdf)
    meta = reader.json("meta.json")
    category = meta.get("model_cat") if isinstance(meta, dict) else None
    return PartNetObject(
        reader.folder.resolve().name,
        category if isinstance(category, str) and category else "Unknown",
        reader.folder,
        links,
        {name: joints[name] for name in order if name in joints},
        tuple(dict.fromkeys(reader.notes)),
    )


def _parse_urdf(reader: _Reader, urdf: str) -> yourdfpy.Robot:
    try:
        root = ElementTree.fromstring(reader.path(urdf, urdf).read_bytes())
    except (ElementTree.ParseError, OSError, ValueError) as e:
        raise reader.error(f"not XML ({e}); download the object again", urdf) from None
    if root.tag != "robot":
        raise reader.error(f"root is <{root.tag}>, not <robot>; give a URDF", urdf)
    try:
        # Written again, it has no document type left: yourdfpy's parser would open files that one names.
        data = ElementTree.tostring(root)
        robot = yourdfpy.URDF.load(io.BytesIO(data), build_scene_graph=False, load_meshes=False).robot
    except Exception as e:  # yourdfpy raises whatever its parsing runs into
        raise reader.error(f"not a readable URDF ({type(e).__name__}: {e}); repair it", urdf) from None
    for kind, names in (("link", [x.name for x in robot.links]), ("joint", [x.name for x in robot.joints])):
        seen = set()
        for name in names:
            if not name or name in seen:
                raise reader.error(f"{kind} name {name!r} is empty or used twice; rename it", urdf)
            seen.add(name)
    if not robot.links:
        raise reader.error("has no links", urdf)
    return robot


def _joint(reader: _Reader, urdf: str, j: yourdfpy.Joint) -> Joint:
    where = f"joint {j.name!r}"
    if j.type not in ("fixed", "revolute", "prismatic", "continuous"):
        raise reader.error(f"{where} has type {j.type!r}; use fixed, revolute, prismatic or continuous", urdf)
    origin = np.eye(4) if j.origin is None else np.asarray(j.origin, np.float64)
    axis = np.array([1.0, 0, 0]) if j.axis is None else np.asarray(j.axis, np.float64)
    if not (np.isfinite(origin).all() and np.abs(origin).max() < MAX_COORDINATE):
        raise reader.error(f"{where} has an origin that is not finite or beyond {MAX_COORDINATE:g}; repair it", urdf)
    norm = np.linalg.norm(axis) if axis.shape == (3,) else np.nan
    if j.type == "fixed":
        return Joint(j.name, "fixed", j.parent, j.child, origin, np.array([1.0, 0, 0]), 0.0, 0.0)
    if not 1e-6 < norm < np.inf:
        raise reader.error(f"{where} has axis {axis}; expected three finite numbers, not all 0", urdf)
    if j.type == "prismatic" and abs(norm - 1) > 1e-3:
        reader.notes.append(f"{where}: axis of length {norm:.3g}, taken as a direction; its values are unit lengths")
    axis = axis / norm
    lower, upper = -np.inf, np.inf
    if j.type != "continuous":
        if j.limit is None or (j.limit.lower is None and j.limit.upper is None):
            if not reader.continuous_range:
                raise reader.error(f"{where} has no limit; give it one or pass --continuous-range", urdf)
        else:
            lower, upper = float(j.limit.lower or 0.0), float(j.limit.upper or 0.0)
    if np.isnan(lower) or np.isnan(upper):
        raise reader.error(f"{where} has limit [{lower}, {upper}]; expected two numbers", urdf)
    if lower > upper:
        reader.notes.append(f"{where}: lower > upper, swapped")
        lower, upper = upper, lower
    if not (np.isfinite(lower) and np.isfinite(upper)):
        lower, upper = -np.inf, np.inf
    elif max(-lower, upper) > MAX_COORDINATE:
        raise reader.error(f"{where} has limit [{lower:g}, {upper:g}]; expected radians or unit lengths", urdf)
    joint = Joint(j.name, j.type, j.parent, j.child, origin, axis, lower, upper)
    if upper - lower < 1e-9:
        reader.notes.append(f"{where}: empty range, fixed")
        return replace(joint, type="fixed", origin=origin @ joint.motion(lower), lower=0.0, upper=0.0)
    return joint


def _tree(reader: _Reader, urdf: str, links: list[str], joints: dict[str, Joint]) -> list[str]:
    """Link names, parents before children."""
    for joint in joints.values():
        for name in (joint.parent, joint.child):
            if name not in links:
                raise reader.error(f"joint {joint.name!r} names link {name!r}, which is not there; add it", urdf)
    roots = [name for name in links if name not in joints]
    if len(roots) != 1:
        what = f"links {roots[:3]} hang on nothing" if roots else "every link hangs on another"
        raise reader.error(f"{what}; the joints must form one tree", urdf)
    children: dict[str, list[str]] = {}
    for name in links:
        if name in joints:
            children.setdefault(joints[name].parent, []).append(name)
    order = roots
    for name in order:  # grows as it is walked
        order.extend(children.get(name, ()))
    if len(order) != len(links):
        lost = next(n for n in links if n not in order)
        raise reader.error(f"link {lost!r} is part of a cycle; the joints must form one tree", urdf)
    return order


def _semantics(reader: _Reader) -> dict[str, str]:
    out = {}
    for line in (reader.text("semantics.txt") or "").splitlines():
        if len(words := line.split()) == 3:
            out[words[0]] = words[2]
    if not out:
        annotation = reader.json("mobility_v2.json")
        for entry in annotation if isinstance(annotation, list) else ():
            if isinstance(entry, dict) and "id" in entry:
                out[f"link_{entry['id']}"] = str(entry.get("name", ""))
    return out


def _visuals(reader: _Reader, urdf: str, link: yourdfpy.Link) -> Iterator[Visual]:
    wanted = [(v, v.geometry) for v in link.visuals if v.geometry is not None]
    missing, empty = [], []
    for i, (visual, geometry) in enumerate(wanted):
        file, skin = None, None
        if geometry.mesh is not None:
            file = geometry.mesh.filename
            if not file:
                raise reader.error(f"link {link.name!r} has a mesh without filename; give it one", urdf)
            if (mesh := _mesh(reader, urdf, file)) is None:
                missing.append(file)
                continue
            vertices, faces, skin = mesh.vertices, mesh.faces, mesh.skin
            scale = np.asarray(1.0 if geometry.mesh.scale is None else geometry.mesh.scale, np.float64)
            if scale.shape not in ((), (3,)) or not np.isfinite(scale).all():
                raise reader.error(f"link {link.name!r}: mesh scale {scale}; expected one or three numbers", urdf)
            vertices = vertices * scale
        else:
            vertices, faces = _primitive(reader, urdf, link.name, geometry)
        origin = np.eye(4) if visual.origin is None else np.asarray(visual.origin, np.float64)
        vertices = vertices @ origin[:3, :3].T + origin[:3, 3]
        if not (np.isfinite(vertices).all() and np.abs(vertices).max(initial=0) < MAX_COORDINATE):
            what = f"link {link.name!r}, visual {visual.name or i!r}: coordinates not finite or beyond"
            raise reader.error(f"{what} {MAX_COORDINATE:g} unit lengths; repair them", file or urdf)
        vertices, faces, kept = cleaned(vertices, faces)
        if not len(faces):
            empty.append(file)
            continue
        name = visual.name or f"{link.name}_{i}"
        words = f"{visual.name or ''} {link.name}".lower()
        is_handle = any(w in words for w in HANDLE_WORDS)
        yield Visual(name, vertices, faces, is_handle, file, None if skin is None else skin.of(kept))
    if missing:
        what = f"link {link.name!r}: {len(missing)} of {len(wanted)} meshes missing"
        if not reader.allow_missing:
            raise reader.error(f"{what}; restore them or pass --allow-missing", missing[0])
        reader.notes.append(f"{what}, left out: {', '.join(missing[:3])}")
    if empty:
        reader.notes.append(f"link {link.name!r}: {len(empty)} meshes without surface, ignored")


def _primitive(reader: _Reader, urdf: str, link: str, geometry: yourdfpy.Geometry) -> tuple[np.ndarray, np.ndarray]:
    if geometry.box is not None:
        size = np.asarray(geometry.box.size, np.float64)
        build = lambda: trimesh.creation.box(size)  # noqa: E731
    elif geometry.cylinder is not None:
        size = np.array([geometry.cylinder.radius, geometry.cylinder.length])
        build = lambda: trimesh.creation.cylinder(size[0], size[1], sections=24)  # noqa: E731
    elif geometry.sphere is not None:
        size = np.array([geometry.sphere.radius])
        build = lambda: trimesh.creation.icosphere(2, size[0])  # noqa: E731
    else:
        raise reader.error(f"link {link!r} has an empty geometry; give it a mesh", urdf)
    if size.shape not in ((1,), (2,), (3,)) or not ((size > 0) & (size < MAX_COORDINATE)).all():
        raise reader.error(f"link {link!r} has a primitive of size {size}; expected positive numbers", urdf)
    mesh = build()
    return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)


def _mesh(reader: _Reader, urdf: str, file: str) -> _Mesh | None:
    """Triangles of a mesh file, None where there is no such file."""
    if file in reader.meshes:
        return reader.meshes[file]
    path = reader.path(file, urdf)
    if not path.is_file():
        out = None
    elif path.suffix.lower() == ".obj":
        out = _read_obj(reader, file, path)
    elif path.suffix.lower() in (".stl", ".ply"):
        try:
            mesh = trimesh.load_mesh(path)
            out = _Mesh(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64))
        except Exception as e:  # trimesh raises whatever its parsing runs into
            raise reader.error(f"not a readable mesh ({type(e).__name__}: {e}); repair it", file) from None
    else:
        raise reader.error(f"mesh format {path.suffix!r} is not read; use .obj, .stl or .ply", urdf)
    if out is not None and not len(out.faces):
        raise reader.error("mesh is empty, it has no faces; restore it or remove it from the URDF", file)
    reader.meshes[file] = out
    return out


def _read_obj(reader: _Reader, file: str, path: Path) -> _Mesh:
    """Vertices, faces and, where asked for, materials; polygons become fans.

    trimesh's reader wants materials and merges what it likes.
    """
    vertices: list[list[float]] = []
    faces: list[list[int]] = []
    points: list[list[float]] = [[0.0, 0.0]]  # of texture; a corner without has the first
    corners: list[list[int]] = []  # index into points
    libraries: list[str] = []
    used, materials = 0, {"": 0}
    material: list[int] = []
    wanted = ("v", "f", "vt", "usemtl", "mtllib") if reader.textures else ("v", "f")
    for number, line in enumerate(path.read_text(errors="replace").replace("\\\n", " ").splitlines(), 1):
        words = line.split()
        if not words or words[0] not in wanted:
            continue
        try:
            if words[0] == "v":
                x, y, z = map(float, words[1:4])
                vertices.append([x, y, z])
            elif words[0] == "f":
                corner = [int(w.split("/", 1)[0]) for w in words[1:]]
                corner = [i - 1 if i > 0 else len(vertices) + i for i in corner]
                fan = [(0, k, k + 1) for k in range(1, len(corner) - 1)]
                faces.extend([corner[i] for i in triangle] for triangle in fan)
                if reader.textures:
                    texture = [int((w + "//").split("/")[1] or 0) for w in words[1:]]
                    texture = [i if i >= 0 else len(points) + i for i in texture]
                    corners.extend([texture[i] for i in triangle] for triangle in fan)
                    material.extend([used] * len(fan))
            elif words[0] == "vt":
                u, v = (*map(float, words[1:3]), 0.0)[:2]
                points.append([u, v])
            elif words[0] == "usemtl":
                used = materials.setdefault(line.split(None, 1)[1].strip() if words[1:] else "", len(materials))
            else:
                libraries.append(" ".join(words[1:]))
        except ValueError:
            raise reader.error(f"line {number} {line[:40]!r} is no OBJ line; restore the mesh", file) from None
    v, f = np.array(vertices, np.float64).reshape(-1, 3), np.array(faces, np.int64).reshape(-1, 3)
    if len(f) and not (f.min() >= 0 and f.max() < len(v)):
        raise reader.error(f"a face names a vertex beyond the {len(v)} there are; restore the mesh", file)
    if len(materials) == 1:
        return _Mesh(v, f)
    index, uv = np.array(corners, np.int64).reshape(-1, 3), np.array(points)
    index[(index < 0) | (index >= len(uv)) | ~np.isfinite(uv).all(axis=1).take(index, mode="clip")] = 0
    skin = Skin(_materials(reader, file, libraries, list(materials)), np.array(material, np.int64), uv[index])
    # Faces are there once per side, one of them often blank; the first copy will stay.
    blank = np.array([m is None or m.png is None for m in skin.materials])
    order = np.argsort(blank[skin.material], kind="stable")
    return _Mesh(v, f[order], skin.of(order))


def _materials(reader: _Reader, file: str, libraries: list[str], names: list[str]) -> tuple[Material | None, ...]:
    """By name, from the MTL files an OBJ file names; None, and a note, where there is none. The first has no name."""
    found = {}
    beside = lambda f, name: os.path.normpath((Path(f).parent / name).as_posix())  # noqa: E731
    for library in libraries:
        if (text := reader.text(beside(file, library))) is None:
            reader.note(f"material library {library!r} not readable inside the folder, plain colours")
            continue
        for name, (rgba, image) in read_mtl(text).items():
            if image is not None and (png := _picture(reader, beside(beside(file, library), image))) is not None:
                found[name] = Material((1.0, 1.0, 1.0, rgba[3]), png)
            else:
                found[name] = Material(rgba, None)
    for name in names[1:]:
        if libraries and found and name not in found:
            reader.note(f"material {name!r} is in no library, plain colour")
    return tuple(found.get(name) for name in names)


def _picture(reader: _Reader, file: str) -> bytes | None:
    if file not in reader.pictures:
        try:
            reader.pictures[file] = read_png(reader.path(file, file), TEXTURE_SIZE)
        except (ObjectError, ValueError) as e:
            reader.pictures[file] = None
            reader.note(f"texture {file!r}: {e}, plain colour")
    return reader.pictures[file]


def clean(vertices: np.ndarray, faces: np.ndarray, merge: float = 1e-5) -> tuple[np.ndarray, np.ndarray]:
    """Merge equal vertices, drop faces without area and copies of a face in either winding.

    Most meshes of the dataset hold every triangle twice, once per side.
    """
    return cleaned(vertices, faces, merge)[:2]


def cleaned(vertices: np.ndarray, faces: np.ndarray, merge: float = 1e-5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same, and which faces are left: index [k] into those given."""
    kept = np.arange(len(faces))
    if not len(faces):
        return vertices[:0], faces, kept
    _, index, inverse = np.unique(np.round(vertices / merge), axis=0, return_index=True, return_inverse=True)
    vertices, faces = vertices[index], inverse.ravel()[faces]
    corners = np.sort(faces, axis=1)
    kept = kept[(corners[:, 0] != corners[:, 1]) & (corners[:, 1] != corners[:, 2])]
    if not len(kept):
        return vertices[:0], faces[:0], kept
    kept = kept[np.sort(np.unique(corners[kept], axis=0, return_index=True)[1])]
    a, b, c = vertices[faces[kept]].transpose(1, 0, 2)
    kept = kept[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-12]
    used, inverse = np.unique(faces[kept], return_inverse=True)
    return vertices[used], inverse.reshape(-1, 3), kept


def parts(obj: PartNetObject) -> tuple[list[Part], list[tuple[str, str]]]:
    """The doors and drawers of an object, and every other moving joint with the reason why it is none."""
    found, left_out = [], []
    size = max(np.ptp(_posed(obj, obj.links).reshape(-1, 3), axis=0).max(), 1e-9)
    for link, joint in obj.joints.items():
        if joint.type == "fixed":
            continue
        if reason := _no_part(obj, joint, size):
            left_out.append((joint.name, reason))
            continue
        closed = _closed_value(obj, joint)
        up, down = joint.upper - closed, closed - joint.lower
        sign = 1 if up >= down else -1
        kind = "drawer" if joint.type == "prismatic" else "door"
        found.append(Part(joint.name, link, kind, closed, sign, float(max(up, down))))
    return found, left_out


def _no_part(obj: PartNetObject, joint: Joint, size: float) -> str:
    """Why this joint is neither door nor drawer; empty where it is one. size: the object's largest extent."""
    link = obj.links[joint.child]
    visuals = obj.group_visuals(joint.child)
    if not visuals:
        return "nothing visible moves"
    if not joint.limited:
        return "turns without end"
    label = link.semantics.lower()
    if word := next((w for w in SMALL_WORDS + OTHER_WORDS if w in label), None):
        return f"is a {word}"
    names = {re.sub(r"[-_]?\d+$", "", v.name).lower() for v in link.visuals}
    if names and all(any(w in n for w in SMALL_WORDS) for n in names):
        return f"consists of {', '.join(sorted(names))}"
    shortest = MIN_SLIDE if joint.type == "prismatic" else MIN_SWING
    if joint.upper - joint.lower < shortest:
        return f"travels only {joint.upper - joint.lower:.3g}"
    extent = np.sort(np.ptp(np.concatenate([v.vertices for v in visuals]), axis=0))
    if extent[2] < 0.12 * size or extent[1] < 0.04 * size:
        return f"is small ({extent[2]:.2g} by {extent[1]:.2g})"
    return ""


def _posed(obj: PartNetObject, links: Iterable[str], values: Mapping[str, float] | None = None) -> np.ndarray:
    """Triangles [m, 3, 3] of links in the object frame."""
    poses = obj.link_poses(values)
    triangles = [
        (v.vertices @ poses[name][:3, :3].T + poses[name][:3, 3])[v.faces]
        for name in links
        for v in obj.links[name].visuals
    ]
    return np.concatenate([np.zeros((0, 3, 3)), *triangles])


def _closed_value(obj: PartNetObject, joint: Joint) -> float:
    """The joint value at which the part is closed.

    That is where it is least off the hull of what it is mounted on and, of the values at which it hardly is (a flap
    can also hang down outside), where it covers most of the way from inside to outside. The dataset models
    most objects closed, at 0: where that is an end of the range, the other end must be closed much better.
    """
    zero = float(np.clip(0.0, joint.lower, joint.upper))
    at_end = min(zero - joint.lower, joint.upper - zero) <= 1e-3 * (joint.upper - joint.lower)
    candidates = sorted({joint.lower, joint.upper} if at_end else {joint.lower, joint.upper, zero}, key=abs)
    moving = obj.subtree(joint.child)
    # What it hangs on and the static group: other drawers may be ajar as well.
    carriers, link = {obj.root}, joint.parent
    while link in obj.joints:
        link = obj.group_root(link)
        carriers.add(link)
        link = obj.joints[link].parent if link in obj.joints else link
    rest = _posed(obj, [n for n in obj.links if obj.group_root(n) in carriers and n not in moving])
    try:
        equations = ConvexHull(rest.reshape(-1, 3)).equations
    except (QhullError, ValueError):
        return candidates[0]
    own = obj.groups[joint.child]
    posed = [_posed(obj, own, {joint.name: value}) for value in candidates]
    size = np.ptp(rest.reshape(-1, 3), axis=0).max()
    depth = lambda points: (points @ equations[:, :3].T + equations[:, 3]).max(axis=1)  # noqa: E731
    # A drawer belongs inside the hull, a door on it: it may also swing inwards.
    off = (lambda d: np.maximum(d, 0)) if joint.type == "prismatic" else np.abs
    out = np.array([off(depth(p.reshape(-1, 3))).mean() for p in posed]) / size
    at_zero = at_end and candidates[0] == zero
    slack = 0.05 if at_zero else 0.005 if joint.type == "prismatic" else 0.03
    near = [k for k in range(len(candidates)) if out[k] <= out.min() + slack]
    if joint.type == "prismatic" or near == [0] or (at_zero and near[0] == 0):
        return candidates[near[0]]

    rng = np.random.default_rng(0)
    low, high = rest.reshape(-1, 3).min(axis=0), rest.reshape(-1, 3).max(axis=0)
    inside = rng.uniform(low, high, (4000, 3))
    inside = inside[depth(inside) < -0.05 * size][:1000]
    starts, ways = np.repeat(inside, 4, axis=0), rng.normal(size=(4 * len(inside), 3))
    free = ~_hit(rest, starts, ways)
    covered = [_hit(p, starts[free], ways[free]).sum() / max(len(starts), 1) for p in posed]
    if at_zero:
        return candidates[1] if covered[1] >= covered[0] else candidates[0]
    return candidates[max(near, key=lambda k: (round(covered[k], 2), -round(100 * out[k]), -k))]


def _hit(triangles: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Which rays [n] meet any of the triangles [m, 3, 3]."""
    if not (len(triangles) and len(origins)):
        return np.zeros(len(origins), bool)
    faces = np.arange(3 * len(triangles)).reshape(-1, 3)
    mesh = trimesh.Trimesh(triangles.reshape(-1, 3), faces, process=False)
    return np.asarray(RayMeshIntersector(mesh).intersects_any(origins, directions))
