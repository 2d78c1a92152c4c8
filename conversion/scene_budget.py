"""Scenes within their slots: what stands still together, or moves together, is merged across links."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from conversion.box_fitting import CORNERS
from conversion.collision_geometry import merged_geometry
from conversion.config import DecomposeConfig
from conversion.fidelity import measure_fidelity
from conversion.model import ConvertedObject, ConvexShape, Visual
from conversion.scenes import InstanceRow, Placement, SceneSpec, instance_table, placements
from conversion.surface import Surface
from vatmart_jax.data.banks import SceneBank


@dataclass(frozen=True, kw_only=True)
class BudgetReport:
    """How one side of a Scene, its static rest or its moving part, came within its budget."""

    scene: int
    side: str  # static or part
    before: int  # hulls or boxes of the links
    after: int
    gap_max: float
    phantom_share: float


def within_budget(
    bank: SceneBank, specs: Sequence[SceneSpec], config: DecomposeConfig, seed: int
) -> tuple[SceneBank, list[BudgetReport]]:
    """The Scenes of one object within the config's budgets, and what that did to those that had more hulls.

    bank: `scene_bank(specs, config.collision)`. Shapes that stay as they are remain shared by all Scenes; merged ones
    belong to one Scene. Merging sees all links at once, so shapes that nothing outside reaches (a closed drawer's
    sides) go first. Merged hulls of a box bank become boxes again, which may take more than the budget.
    """
    is_box = bank.collision == "box"
    shapes = [CORNERS * size for size in bank.box_size] if is_box else [bank.hull(k) for k in range(bank.n_shapes)]
    sizes: list[np.ndarray | None] = list(bank.box_size)
    tables: dict[str, list[list[InstanceRow]]] = {"static": [], "part": []}
    changed = []
    for s, spec in enumerate(specs):
        rest, own, _ = placements(spec)
        for side, groups, budget in (("static", rest, config.static_budget), ("part", own, config.part_budget)):
            rows = _rows(bank, side, s)
            if len(rows) > budget:
                surface = Surface(_visuals(spec.converted, groups), seed)
                placed = [_placed(shapes[row[0]], row) for row in rows]
                kept, new = merged_geometry(surface, placed, budget, config)
                match = measure_fidelity(surface, [placed[k] for k in kept] + new)
                before, rows = len(rows), [rows[k] for k in kept]
                for shape in new:
                    pose = np.eye(4) if shape.box_pose is None else shape.box_pose
                    quat = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
                    rows.append((len(shapes), pose[:3, 3], quat, shape.is_handle))
                    shapes.append(shape.vertices)
                    sizes.append(shape.box_size)
                changed.append(
                    BudgetReport(
                        scene=s,
                        side=side,
                        before=before,
                        after=len(rows),
                        gap_max=match.gap_max,
                        phantom_share=match.phantom_share,
                    )
                )
            tables[side].append(rows)
    if is_box:
        table = {"box_size": np.array(sizes, np.float32).reshape(-1, 3)}
    else:
        start = np.cumsum([0] + [len(v) for v in shapes]).astype(np.int32)
        table = {"hull_vertices": np.concatenate([np.zeros((0, 3)), *shapes]).astype(np.float32), "hull_start": start}
    whole = replace(bank, **table, **instance_table(tables["static"], tables["part"]))
    return whole.select(np.arange(len(bank))), changed


def _rows(bank: SceneBank, side: str, scene: int) -> list[InstanceRow]:
    start = getattr(bank, f"{side}_start")
    return [
        (int(bank.instance_shape[i]), bank.instance_pos[i], bank.instance_quat[i], bool(bank.instance_handle[i]))
        for i in range(start[scene], start[scene + 1])
    ]


def _placed(vertices: np.ndarray, row: InstanceRow) -> ConvexShape:
    _, pos, quat, is_handle = row
    turn = Rotation.from_quat(quat, scalar_first=True)
    return ConvexShape(vertices=turn.apply(vertices) + pos, is_handle=is_handle)


def _visuals(converted: ConvertedObject, groups: list[Placement]) -> list[Visual]:
    return [
        replace(v, vertices=v.vertices @ p.pose[:3, :3].T + p.pose[:3, 3])
        for p in groups
        for v in converted.obj.group_visuals(p.group)
    ]
