"""What the converter knows of an object: links, joints, parts and convex shapes, and the file that keeps them.

Frames: the object frame is the root link's (z up, front towards -x); a link frame is the URDF's. Lengths are unit
lengths of the dataset, angles radians.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from vatmart_jax.atomic_io import atomic_write
from vatmart_jax.errors import UserError


class ObjectError(UserError):
    """An object folder cannot be converted; one line that names the file, the thing and the remedy."""


@dataclass(frozen=True, kw_only=True)
class Material:
    rgba: tuple[float, float, float, float]
    png: bytes | None  # its picture; the colour is white then


@dataclass(frozen=True, kw_only=True)
class FaceMaterials:
    """What the faces of a visual look like."""

    materials: tuple[Material | None, ...]  # None: nothing is known, the colour goes by role
    index: np.ndarray  # [m] int64 per face, index into materials
    uv: np.ndarray  # [m, 3, 2] float64 per corner of a face, origin at the lower left of the picture

    def subset(self, faces: np.ndarray) -> FaceMaterials:
        """That of some faces [k], by index."""
        return FaceMaterials(materials=self.materials, index=self.index[faces], uv=self.uv[faces])


@dataclass(frozen=True, kw_only=True)
class Visual:
    name: str
    vertices: np.ndarray  # [n, 3] float64, link frame
    faces: np.ndarray  # [m, 3] int64, each triangle once, winding meaningless
    is_handle: bool
    file: str | None  # relative to the object folder; None for a primitive
    materials: FaceMaterials | None = None  # where they were asked for and the file names some


@dataclass(frozen=True, kw_only=True)
class Link:
    name: str
    semantics: str  # PartNet-Mobility's name (drawer, rotation_door, furniture_body, ...), "" where it has none
    visuals: tuple[Visual, ...]


@dataclass(frozen=True, kw_only=True)
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


@dataclass(frozen=True, kw_only=True)
class ArticulatedObject:
    """What a reader makes of one object folder."""

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


@dataclass(frozen=True, kw_only=True)
class Part:
    """A door, drawer or lid. URDF joint value = closed + sign * q, joint position q in [0, joint_range]."""

    joint: str
    link: str
    kind: str  # name of a PartKind: door, drawer or lid
    closed: float
    sign: int
    joint_range: float


@dataclass(frozen=True, kw_only=True)
class ConvexShape:
    vertices: np.ndarray  # [n, 3] float64, frame of the group root; the 8 corners where it is a box
    is_handle: bool
    box_pose: np.ndarray | None = None  # [4, 4] centre and axes, same frame; None for a hull
    box_size: np.ndarray | None = None  # [3] half extents


@dataclass(frozen=True, kw_only=True)
class ConvertedObject:
    """An object and its collision geometry, as `vatmart convert` leaves it in one folder."""

    obj: ArticulatedObject
    hulls: Mapping[str, list[ConvexShape]]  # by group root, in its frame
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
        with atomic_write(folder / "object.npz") as part, part.open("wb") as f:
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
                arrays = {k: f[k] for k in f.files}
            return cls._from_arrays(folder, arrays)
        except (OSError, EOFError, KeyError, TypeError, ValueError, zipfile.BadZipFile) as e:
            raise ObjectError(f"{path}: not a converted object ({e}); run `vatmart convert` again") from e

    @classmethod
    def _from_arrays(cls, folder: Path, arrays: dict[str, np.ndarray]) -> ConvertedObject:
        text = json.loads(str(arrays["text"]))
        vertices = np.split(arrays["vertices"].astype(np.float64), arrays["vertex_start"][1:-1])
        faces = np.split(arrays["faces"].astype(np.int64), arrays["face_start"][1:-1])
        points = np.split(arrays["hull_vertices"], arrays["hull_start"][1:-1])
        visuals: dict[str, list[Visual]] = {}
        for i, (link, name, is_handle, file) in enumerate(text["visuals"]):
            visual = Visual(name=name, vertices=vertices[i], faces=faces[i], is_handle=is_handle, file=file)
            visuals.setdefault(link, []).append(visual)
        joints = [
            Joint(
                name=name,
                type=kind,
                parent=parent,
                child=child,
                origin=arrays["origin"][i],
                axis=arrays["axis"][i],
                lower=float(arrays["limit"][i, 0]),
                upper=float(arrays["limit"][i, 1]),
            )
            for i, (name, kind, parent, child) in enumerate(text["joints"])
        ]
        obj = ArticulatedObject(
            id=text["id"],
            category=text["category"],
            folder=folder,
            links={
                name: Link(name=name, semantics=semantics, visuals=tuple(visuals.get(name, ())))
                for name, semantics in text["links"]
            },
            joints={j.child: j for j in joints},
            notes=tuple(text["notes"]),
        )
        hulls: dict[str, list[ConvexShape]] = {root: [] for root in obj.groups}
        boxes = iter(zip(arrays["box_pose"], arrays["box_size"], strict=True))
        for i, (root, is_handle, is_box) in enumerate(text["hulls"]):
            pose, size = next(boxes) if is_box else (None, None)
            hulls[root].append(ConvexShape(vertices=points[i], is_handle=is_handle, box_pose=pose, box_size=size))
        return cls(
            obj=obj,
            hulls=hulls,
            parts=[Part(**p) for p in text["parts"]],
            left_out=[(joint, reason) for joint, reason in text["left_out"]],
            split=text["split"],
        )


def _pack(arrays: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    start = np.cumsum([0] + [len(a) for a in arrays])
    return (np.concatenate(arrays) if arrays else np.zeros((0, 3))), start
