"""Moving parts of converted objects -> Scenes, each one moving part with everything else static: SceneBank."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from conversion.model import ConvertedObject, ConvexShape, ObjectError, Part
from vatmart_jax.data.banks import SceneBank
from vatmart_jax.data.part_kinds import PART_KINDS

SWEEP = np.linspace(0.0, 1.0, 9)  # shares of a part's range at which neighbours must leave it room
ROOM = 2e-3  # unit lengths; hulls may overlap this much more than with everything closed


InstanceRow = tuple[int, np.ndarray, np.ndarray, bool]  # shape, position [3], quaternion [4] wxyz, is a handle's


@dataclass(frozen=True, kw_only=True)
class Placement:
    """One link group of a Scene."""

    group: str  # its root link
    pose: np.ndarray  # [4, 4] in the object frame (static) or the part's frame (part)


def rng_of(seed: int, *key: str | int) -> np.random.Generator:
    """A generator that depends on the seed and the key alone, in every process."""
    return np.random.default_rng([seed, *(zlib.crc32(str(k).encode()) for k in key)])


@dataclass(frozen=True, kw_only=True)
class SceneSpec:
    """One Scene to be: which part of which object moves, and how the object's other joints stand."""

    converted: ConvertedObject
    part: Part
    variant: int
    values: Mapping[str, float]  # URDF values, by joint name, of every joint but the part's own


def scene_specs(converted: ConvertedObject, variants: int, seed: int) -> list[SceneSpec]:
    """The Scenes of an object, in the bank's order: one per moving part and variant.

    Variant 0 has all other parts closed. Each further one has some of the other joints at sampled values
    (`other_values`); one that equals an earlier variant is left out.
    """
    out = []
    for part in converted.parts:
        seen: list[dict[str, float]] = []
        for variant in range(variants):
            values = other_values(converted, part, variant, seed)
            if values not in seen:
                seen.append(values)
                out.append(SceneSpec(converted=converted, part=part, variant=variant, values=values))
    return out


def scene_bank(specs: Sequence[SceneSpec], collision: str) -> SceneBank:
    """The Scenes of `specs`, those of one object in a row. collision: "hull" or "box".

    Raises ObjectError where a box bank is asked of objects whose collision geometry is hulls.
    """
    shapes: list[ConvexShape] = []
    scenes, static, moving = [], [], []  # static and moving: rows of instances per Scene
    first, last = 0, None
    for spec in specs:
        converted, part = spec.converted, spec.part
        if converted is not last:
            first, last = len(shapes), converted
            shapes += [shape for group in converted.hulls.values() for shape in group]
            if collision == "box" and any(shape.box_pose is None for shape in shapes[first:]):
                raise ObjectError(f"{converted.obj.id}: its collision geometry is hulls; convert with --collision box")
        rest, own, pose = placements(spec)
        static.append(instances(converted, rest, collision, first))
        moving.append(instances(converted, own, collision, first))
        scenes.append({
            "object_id": converted.obj.id,
            "category": converted.obj.category,
            "split": converted.split,
            "part": part.link,
            "joint": part.joint,
            "variant": spec.variant,
            "part_kind": part.kind,
            "joint_type": PART_KINDS.get(part.kind).joint_type,
            "part_pos": pose[:3, 3],
            "part_quat": _quat(pose),
            "axis": part.sign * converted.obj.joints[part.link].axis,
            "joint_range": part.joint_range,
            "urdf_closed": part.closed,
            "urdf_sign": part.sign,
        })  # fmt: skip
    columns = {name: _column(scenes, name, dtype, *shape) for name, dtype, *shape in _COLUMNS}
    vertices = [shape.vertices for shape in shapes] if collision == "hull" else []
    sizes = [shape.box_size for shape in shapes] if collision == "box" else []
    bank = SceneBank(
        collision=collision,
        hull_vertices=np.concatenate([np.zeros((0, 3)), *vertices]).astype(np.float32),
        hull_start=np.cumsum([0] + [len(v) for v in vertices]).astype(np.int32),
        box_size=np.array(sizes, np.float32).reshape(-1, 3),
        **instance_table(static, moving),
        **columns,
    )
    return bank.select(np.arange(len(bank)))


_COLUMNS = (
    ("object_id", np.str_), ("category", np.str_), ("split", np.str_), ("part", np.str_), ("joint", np.str_),
    ("variant", np.int32), ("part_kind", np.str_), ("joint_type", np.int32), ("part_pos", np.float64, 3),
    ("part_quat", np.float64, 4), ("axis", np.float64, 3), ("joint_range", np.float64), ("urdf_closed", np.float64),
    ("urdf_sign", np.float64),
)  # fmt: skip


def _column(scenes: Sequence[Mapping[str, Any]], name: str, dtype: Any, *shape: int) -> np.ndarray:
    return np.array([scene[name] for scene in scenes], dtype).reshape(-1, *shape)


def other_values(converted: ConvertedObject, part: Part, variant: int, seed: int) -> dict[str, float]:
    """URDF values, by joint name, of every joint but the part's own in one variant of its Scene.

    Variant 0: other parts closed, all else at 0 or the end of the range nearest to it. Further variants: each joint
    with probability 1/2 at a value drawn from its range, unless that takes room which the part needs to move.
    """
    obj = converted.obj
    values = {j.name: float(np.clip(0.0, j.lower, j.upper)) for j in obj.joints.values() if j.type != "fixed"}
    values |= {p.joint: p.closed for p in converted.parts}
    del values[part.joint]
    if variant == 0:
        return values
    rng = rng_of(seed, obj.id, part.link, variant)
    room = _Room(converted, part, values)
    for link, joint in obj.joints.items():
        if joint.name not in values:
            continue
        lower, upper = (joint.lower, joint.upper) if joint.limited else (-np.pi, np.pi)
        # Drawn for every joint, kept or not, so that one joint's fate does not change the next one's value.
        chosen, value = rng.random() < 0.5, float(rng.uniform(lower, upper))
        if chosen and room.leaves(values | {joint.name: value}, link):
            values[joint.name] = value
    return values


def placements(spec: SceneSpec) -> tuple[list[Placement], list[Placement], np.ndarray]:
    """What is static and what moves with the part, and the part's pose [4, 4] when closed, object frame."""
    obj, part = spec.converted.obj, spec.part
    poses = obj.link_poses({**spec.values, part.joint: part.closed})
    own = obj.subtree(part.link)
    pose = poses[part.link]
    inverse = np.linalg.inv(pose)
    rest = [Placement(group=g, pose=poses[g]) for g in obj.groups if g not in own]
    return rest, [Placement(group=g, pose=inverse @ poses[g]) for g in obj.groups if g in own], pose


def instances(converted: ConvertedObject, groups: list[Placement], collision: str, first: int) -> list[InstanceRow]:
    """One row per hull or box of these groups, in the bank's order.

    first: the index of the object's first shape.
    """
    shape = dict(zip(converted.hulls, np.cumsum([first] + [len(h) for h in converted.hulls.values()]), strict=False))
    out = []
    for p in groups:
        for i, hull in enumerate(converted.hulls.get(p.group, ())):
            pose = p.pose @ hull.box_pose if collision == "box" and hull.box_pose is not None else p.pose
            out.append((int(shape[p.group]) + i, pose[:3, 3], _quat(pose), hull.is_handle))
    return out


def instance_table(
    static: Sequence[Sequence[InstanceRow]], part: Sequence[Sequence[InstanceRow]]
) -> dict[str, np.ndarray]:
    """The instance table of a SceneBank from its rows per Scene: statics of all Scenes first, then parts."""
    rows = [row for table in (static, part) for scene in table for row in scene]
    first = sum(map(len, static))
    return {
        "instance_shape": np.array([r[0] for r in rows], np.int32),
        "instance_pos": np.array([r[1] for r in rows], np.float64).reshape(-1, 3),
        "instance_quat": np.array([r[2] for r in rows], np.float64).reshape(-1, 4),
        "instance_handle": np.array([r[3] for r in rows], bool),
        "static_start": np.cumsum([0] + [len(r) for r in static]).astype(np.int32),
        "part_start": (first + np.cumsum([0] + [len(r) for r in part])).astype(np.int32),
    }


class _Room:
    """The room that a part needs to move: how much its hulls overlap the rest of the object on the way."""

    def __init__(self, converted: ConvertedObject, part: Part, closed: dict[str, float]):
        self.converted, self.part = converted, part
        self.own = set(converted.obj.subtree(part.link))
        self.convex = {
            g: [_Convex.from_vertices(h.vertices) for h in hulls] for g, hulls in converted.hulls.items() if hulls
        }
        self.closed = [self._moved(closed, share, set(self.convex)) for share in SWEEP]

    def leaves(self, values: dict[str, float], link: str) -> bool:
        """With these values, nothing below `link` overlaps what moves against it more than with all else closed."""
        changed = set(self.converted.obj.subtree(link)) & set(self.convex)
        pairs = [(g, other) for g in changed for other in self.convex if (g in self.own) != (other in self.own)]
        groups = {g for pair in pairs for g in pair}
        for share, before in zip(SWEEP, self.closed, strict=True):
            after = self._moved(values, share, groups)
            for a, b in pairs:
                if (overlap := _overlap(after[a], after[b])) and overlap > _overlap(before[a], before[b]) + ROOM:
                    return False
        return True

    def _moved(self, values: dict[str, float], share: float, groups: set[str]) -> dict[str, list[_Convex]]:
        part = self.part
        poses = self.converted.obj.link_poses(values | {part.joint: part.closed + part.sign * share * part.joint_range})
        return {g: [c.moved(poses[g]) for c in self.convex[g]] for g in groups}


@dataclass(frozen=True, kw_only=True)
class _Convex:
    vertices: np.ndarray  # [n, 3]
    normals: np.ndarray  # [f, 3] unit, one per distinct face plane
    low: np.ndarray  # [3] bounding box
    high: np.ndarray

    @classmethod
    def from_vertices(cls, vertices: np.ndarray) -> _Convex:
        normals = np.unique(ConvexHull(vertices).equations[:, :3].round(9), axis=0)
        return cls(vertices=vertices, normals=normals, low=vertices.min(0), high=vertices.max(0))

    def moved(self, pose: np.ndarray) -> _Convex:
        vertices = self.vertices @ pose[:3, :3].T + pose[:3, 3]
        normals = self.normals @ pose[:3, :3].T
        return _Convex(vertices=vertices, normals=normals, low=vertices.min(0), high=vertices.max(0))

    def overlap(self, other: _Convex) -> float:
        """Smallest translation along a face normal that parts the two: never less than their penetration."""
        apart = np.minimum(self.high - other.low, other.high - self.low).min()
        if apart <= 0:
            return 0.0
        axes = np.concatenate([self.normals, -other.normals])
        depth = (self.vertices @ axes.T).max(axis=0) - (other.vertices @ axes.T).min(axis=0)
        return float(max(min(depth.min(), apart), 0.0))


def _overlap(a: list[_Convex], b: list[_Convex]) -> float:
    """Largest overlap of a hull of one group with one of another, 0 where they are apart."""
    return max((x.overlap(y) for x, y in product(a, b)), default=0.0)


def _quat(pose: np.ndarray) -> np.ndarray:
    """wxyz"""
    return Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
