"""Scenes within their slots: what stands still together, or moves together, is merged across links."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from conversion.boxes import CORNERS, boxes
from conversion.decompose import DecomposeConfig, Surface, fidelity, merged
from conversion.partnet import ConvertedObject, Hull, Visual
from conversion.scenes import Placement, other_values, placements
from vatmart_jax.data.banks import SceneBank

Row = tuple[int, np.ndarray, np.ndarray, bool]  # shape, position [3], quaternion [4] wxyz, is a handle's


@dataclass(frozen=True)
class Slots:
    """How one side of a Scene, its static rest or its moving part, came within its budget."""

    scene: int
    side: str  # static or part
    before: int  # hulls or boxes of the links
    after: int
    gap_max: float
    phantom_share: float


def within_budget(
    bank: SceneBank,
    converted: ConvertedObject,
    static_budget: int,
    part_budget: int,
    config: DecomposeConfig,
    seed: int,
) -> tuple[SceneBank, list[Slots]]:
    """The Scenes of one object with at most so many hulls each, and what that did to those that had more.

    bank: of this object alone, made with the same seed. Shapes that stay as they are remain shared by all Scenes;
    merged ones belong to one Scene. Merging sees all links at once, so shapes that nothing outside reaches (a closed
    drawer's sides) go first. Merged hulls of a box bank become boxes again, which may take more than the budget.
    """
    parts = {p.link: p for p in converted.parts}
    is_box = bank.collision == "box"
    shapes = [CORNERS * size for size in bank.box_size] if is_box else [bank.hull(k) for k in range(_count(bank))]
    sizes = list(bank.box_size)
    tables: dict[str, list[list[Row]]] = {"static": [], "part": []}
    changed = []
    for s in range(len(bank)):
        part = parts[str(bank.part[s])]
        rest, own, _ = placements(converted, part, other_values(converted, part, int(bank.variant[s]), seed))
        for side, groups, budget in (("static", rest, static_budget), ("part", own, part_budget)):
            rows = _rows(bank, side, s)
            if len(rows) > budget:
                surface = Surface(_visuals(converted, groups), seed)
                hulls = [_placed(shapes[shape], pos, quat, is_handle) for shape, pos, quat, is_handle in rows]
                kept, new = merged(surface, hulls, budget, config)
                new = boxes(surface, new, 2 * len(new), config) if is_box else new
                match = fidelity(surface, [hulls[k] for k in kept] + new)
                before, rows = len(rows), [rows[k] for k in kept]
                for hull in new:
                    pose = np.eye(4) if hull.box_pose is None else hull.box_pose
                    quat = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
                    rows.append((len(shapes), pose[:3, 3], quat, hull.is_handle))
                    shapes.append(hull.vertices)
                    sizes.append(hull.box_size)
                changed.append(Slots(s, side, before, len(rows), match.gap_max, match.phantom_share))
            tables[side].append(rows)
    if is_box:
        table = {"box_size": np.array(sizes, np.float32).reshape(-1, 3)}
    else:
        start = np.cumsum([0] + [len(v) for v in shapes]).astype(np.int32)
        table = {"hull_vertices": np.concatenate([np.zeros((0, 3)), *shapes]).astype(np.float32), "hull_start": start}
    whole = replace(bank, **table, **_instances(tables["static"], tables["part"]))
    return whole.select(np.arange(len(bank))), changed


def joined(banks: Sequence[SceneBank]) -> SceneBank:
    """One bank with the Scenes of all, in their order; at least one bank, all of one kind of geometry."""
    tables: dict[str, list[list[Row]]] = {"static": [], "part": []}
    first = 0
    for bank in banks:
        for side, table in tables.items():
            for s in range(len(bank)):
                table.append(
                    [(first + shape, pos, quat, is_handle) for shape, pos, quat, is_handle in _rows(bank, side, s)]
                )
        first += _count(bank)
    lengths = np.concatenate([np.diff(b.hull_start) for b in banks])
    instances = _instances(tables["static"], tables["part"])
    others = [name for name in vars(banks[0]) if name not in {"collision", "hull_start", *instances}]
    return SceneBank(
        collision=banks[0].collision,
        hull_start=np.cumsum([0, *lengths]).astype(np.int32),
        **instances,
        **{name: np.concatenate([getattr(b, name) for b in banks]) for name in others},
    )


def _count(bank: SceneBank) -> int:
    return len(bank.box_size) if bank.collision == "box" else len(bank.hull_start) - 1


def _rows(bank: SceneBank, side: str, scene: int) -> list[Row]:
    start = getattr(bank, f"{side}_start")
    return [
        (int(bank.instance_shape[i]), bank.instance_pos[i], bank.instance_quat[i], bool(bank.instance_handle[i]))
        for i in range(start[scene], start[scene + 1])
    ]


def _instances(static: list[list[Row]], part: list[list[Row]]) -> dict[str, np.ndarray]:
    """The instance table of a SceneBank from its rows per Scene."""
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


def _placed(vertices: np.ndarray, pos: np.ndarray, quat: np.ndarray, is_handle: bool) -> Hull:
    return Hull(Rotation.from_quat(quat, scalar_first=True).apply(vertices) + pos, is_handle)


def _visuals(converted: ConvertedObject, groups: list[Placement]) -> list[Visual]:
    return [
        replace(v, vertices=v.vertices @ p.pose[:3, :3].T + p.pose[:3, 3])
        for p in groups
        for v in converted.obj.group_visuals(p.group)
    ]
