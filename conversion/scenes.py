"""Doors and drawers of converted objects -> Scenes, each one moving part with everything else static: SceneBank."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from conversion.partnet import ConvertedObject, Hull, ObjectError, Part
from vatmart_jax.data.banks import HINGE, SLIDE, SceneBank

SWEEP = np.linspace(0.0, 1.0, 9)  # shares of a part's range at which neighbours must leave it room
ROOM = 2e-3  # unit lengths; hulls may overlap this much more than with everything closed


@dataclass(frozen=True)
class Placement:
    """One link group of a Scene."""

    group: str  # its root link
    pose: np.ndarray  # [4, 4] in the object frame (static) or the part's frame (part)


def rng_of(seed: int, *key: str | int) -> np.random.Generator:
    """A generator that depends on the seed and the key alone, in every process."""
    return np.random.default_rng([seed, *(zlib.crc32(str(k).encode()) for k in key)])


def scene_bank(objects: Sequence[ConvertedObject], variants: int, collision: str, seed: int) -> SceneBank:
    """One Scene per object, door or drawer, and variant. collision: "hull" or "box".

    Variant 0 has all other parts closed. Each further one has some of the other joints at sampled values
    (`other_values`); one that equals an earlier variant is left out. Objects without parts give no Scene. Raises
    ObjectError where a box bank is asked of objects whose collision geometry is hulls.
    """
    shapes: list[Hull] = []
    scenes, static, moving = [], [], []  # static and moving: rows of instances per Scene
    for converted in objects:
        first = len(shapes)
        shapes += [h for hulls in converted.hulls.values() for h in hulls]
        if collision == "box" and any(h.box_pose is None for h in shapes[first:]):
            raise ObjectError(f"{converted.obj.id}: its collision geometry is hulls; convert with --collision box")
        for part, variant, values in variants_of(converted, variants, seed):
            rest, own, pose = placements(converted, part, values)
            static.append(instances(converted, rest, collision, first))
            moving.append(instances(converted, own, collision, first))
            joint = converted.obj.joints[part.link]
            scenes.append({
                "object_id": converted.obj.id,
                "category": converted.obj.category,
                "split": converted.split,
                "part": part.link,
                "joint": part.joint,
                "variant": variant,
                "joint_type": SLIDE if part.kind == "drawer" else HINGE,
                "part_pos": pose[:3, 3],
                "part_quat": _quat(pose),
                "axis": part.sign * joint.axis,
                "width": part.width,
                "urdf_closed": part.closed,
                "urdf_sign": part.sign,
            })  # fmt: skip
    table = [row for rows in (*static, *moving) for row in rows]
    column = lambda name, dtype, *shape: np.array([s[name] for s in scenes], dtype).reshape(-1, *shape)  # noqa: E731
    vertices = [h.vertices for h in shapes] if collision == "hull" else []
    sizes = [h.box_size for h in shapes] if collision == "box" else []
    bank = SceneBank(
        collision=collision,
        hull_vertices=np.concatenate([np.zeros((0, 3)), *vertices]).astype(np.float32),
        hull_start=np.cumsum([0] + [len(v) for v in vertices]).astype(np.int32),
        box_size=np.array(sizes, np.float32).reshape(-1, 3),
        instance_shape=np.array([r[0] for r in table], np.int32),
        instance_pos=np.array([r[1] for r in table], float).reshape(-1, 3),
        instance_quat=np.array([r[2] for r in table], float).reshape(-1, 4),
        instance_handle=np.array([r[3] for r in table], bool),
        static_start=np.cumsum([0] + [len(r) for r in static]).astype(np.int32),
        part_start=(sum(map(len, static)) + np.cumsum([0] + [len(r) for r in moving])).astype(np.int32),
        object_id=column("object_id", np.str_),
        category=column("category", np.str_),
        split=column("split", np.str_),
        part=column("part", np.str_),
        joint=column("joint", np.str_),
        variant=column("variant", np.int32),
        joint_type=column("joint_type", np.int32),
        part_pos=column("part_pos", np.float64, 3),
        part_quat=column("part_quat", np.float64, 4),
        axis=column("axis", np.float64, 3),
        width=column("width", np.float64),
        urdf_closed=column("urdf_closed", np.float64),
        urdf_sign=column("urdf_sign", np.float64),
    )
    return bank.select(np.arange(len(bank)))


def variants_of(converted: ConvertedObject, variants: int, seed: int) -> Iterator[tuple[Part, int, dict[str, float]]]:
    """(part, variant, values of the other joints) of every Scene of an object, in the bank's order."""
    for part in converted.parts:
        seen: list[dict[str, float]] = []
        for variant in range(variants):
            values = other_values(converted, part, variant, seed)
            if values not in seen:
                seen.append(values)
                yield part, variant, values


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


def placements(
    converted: ConvertedObject, part: Part, values: dict[str, float]
) -> tuple[list[Placement], list[Placement], np.ndarray]:
    """What is static and what moves with the part, and the part's pose [4, 4] when closed, object frame."""
    obj = converted.obj
    poses = obj.link_poses(values | {part.joint: part.closed})
    own = obj.subtree(part.link)
    pose = poses[part.link]
    inverse = np.linalg.inv(pose)
    rest = [Placement(g, poses[g]) for g in obj.groups if g not in own]
    return rest, [Placement(g, inverse @ poses[g]) for g in obj.groups if g in own], pose


def instances(
    converted: ConvertedObject, groups: list[Placement], collision: str, first: int
) -> list[tuple[int, np.ndarray, np.ndarray, bool]]:
    """(shape, pos [3], quat [4] wxyz, is a handle's) of every hull or box of these groups, in the bank's order.

    first: the index of the object's first shape.
    """
    shape = dict(zip(converted.hulls, np.cumsum([first] + [len(h) for h in converted.hulls.values()]), strict=False))
    out = []
    for p in groups:
        for i, hull in enumerate(converted.hulls.get(p.group, ())):
            pose = p.pose @ hull.box_pose if collision == "box" and hull.box_pose is not None else p.pose
            out.append((int(shape[p.group]) + i, pose[:3, 3], _quat(pose), hull.is_handle))
    return out


class _Room:
    """The room that a part needs to move: how much its hulls overlap the rest of the object on the way."""

    def __init__(self, converted: ConvertedObject, part: Part, closed: dict[str, float]):
        self.converted, self.part = converted, part
        self.own = set(converted.obj.subtree(part.link))
        self.convex = {g: [_Convex.of(h.vertices) for h in hulls] for g, hulls in converted.hulls.items() if hulls}
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
        poses = self.converted.obj.link_poses(values | {part.joint: part.closed + part.sign * share * part.width})
        return {g: [c.moved(poses[g]) for c in self.convex[g]] for g in groups}


@dataclass(frozen=True)
class _Convex:
    vertices: np.ndarray  # [n, 3]
    normals: np.ndarray  # [f, 3] unit, one per distinct face plane
    low: np.ndarray  # [3] bounding box
    high: np.ndarray

    @classmethod
    def of(cls, vertices: np.ndarray) -> _Convex:
        normals = np.unique(ConvexHull(vertices).equations[:, :3].round(9), axis=0)
        return cls(vertices, normals, vertices.min(0), vertices.max(0))

    def moved(self, pose: np.ndarray) -> _Convex:
        vertices = self.vertices @ pose[:3, :3].T + pose[:3, 3]
        return _Convex(vertices, self.normals @ pose[:3, :3].T, vertices.min(0), vertices.max(0))

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
