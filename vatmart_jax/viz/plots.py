"""Pictures of a run: learning curves, the objects, and what the priors see and propose."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import matplotlib
import numpy as np

from vatmart_jax import rotations as rot
from vatmart_jax.atomic_io import whole
from vatmart_jax.camera import Camera
from vatmart_jax.trajectory import since_start, unpack_trajectory

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib import patheffects

_STAGE_CURVES = (
    ("explore", ("success", "reward")),
    ("course", ("course_error",)),
    ("scorer", ("score_loss",)),
    ("proposal", ("move_loss", "turn_loss", "rotation_loss", "kl_loss")),
    ("actionability", ("actionability_loss", "actionability_target")),
    ("curiosity", ("success", "novel", "curiosity")),
    ("finetune", ("success", "score_loss")),
)


def curves(rows: Sequence[dict[str, Any]], out: Path) -> None:
    """One panel per stage and metric of what a run logged, see `read_metrics`."""
    panels = [
        (stage, name, [(r["step"], r[name]) for r in rows if r["stage"] == stage and name in r])
        for stage, names in _STAGE_CURVES
        for name in names
    ]
    panels = [(stage, name, points) for stage, name, points in panels if points]
    columns = 4
    figure, axes = plt.subplots(-(-len(panels) // columns), columns, figsize=(14, 2.6 * -(-len(panels) // columns)))
    for axis, (stage, name, points) in zip(np.ravel(axes), panels, strict=False):
        axis.plot(*zip(*points, strict=True), marker="." if len(points) < 20 else None)
        axis.set_title(f"{stage}: {name}", fontsize=9)
        axis.grid(alpha=0.3)
    for axis in np.ravel(axes)[len(panels) :]:
        axis.axis("off")
    figure.tight_layout()
    _save(figure, out)


def reliability_curves(curves: dict[str, dict[str, Any]], out: Path) -> None:
    """What was said against what happened, one line per name; dots grow with the number of trials."""
    figure, axis = plt.subplots(figsize=(5.2, 5))
    axis.plot([0, 1], [0, 1], "--", color="#999999", lw=1)
    for name, curve in curves.items():
        (line,) = axis.plot(curve["said"], curve["happened"], label=f"{name} (gap {curve['gap']:.2f})")
        axis.scatter(curve["said"], curve["happened"], s=np.array(curve["count"]), color=line.get_color(), alpha=0.5)
    axis.set(xlabel="score", ylabel="success", xlim=(0, 1), ylim=(0, 1))
    axis.legend(fontsize=8)
    axis.grid(alpha=0.3)
    _save(figure, out)


def contact_sheet(pictures: list[Path], out: Path, limit: int = 24) -> None:
    """A grid of the first `limit` object pictures."""
    pictures = [p for p in pictures if p.is_file()][:limit]
    if not pictures:
        return
    columns = min(4, len(pictures))
    rows = -(-len(pictures) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(4 * columns, 1.2 * rows), squeeze=False)
    for axis in axes.flat:
        axis.axis("off")
    for axis, picture in zip(axes.flat, pictures, strict=False):
        axis.imshow(plt.imread(picture))
        axis.set_title(picture.parent.name, fontsize=8)
    _save(figure, out)


def priors(
    points: np.ndarray,
    part_mask: np.ndarray,
    actionability: np.ndarray,
    contact: np.ndarray,
    trajectories: np.ndarray,
    scores: np.ndarray,
    camera: tuple[float, float],
    title: str,
    out: Path,
    standoff: float,
) -> None:
    """The cloud as the camera sees it, the heat map on the moving part, and trajectories from the contact point.

    points: [N, 3]; part_mask: [N] bool; actionability: [N]; contact: [3]; trajectories: [P, 30], best first, drawn
    with decreasing weight; scores: [P]; camera: azimuth and elevation (rad) as ViewBank has them.
    """
    seen_from = camera_of_view(camera)
    project = seen_from.project
    figure, axis = plt.subplots(figsize=(6.4, 5.4))
    order = np.argsort(-seen_from.depth(points))  # far ones first
    points, part_mask, actionability = points[order], part_mask[order], actionability[order]
    flat = project(points)
    axis.scatter(*flat[~part_mask].T, s=7, c="#c9ccd1", linewidths=0)
    heat = axis.scatter(
        *flat[part_mask].T, s=12, c=actionability[part_mask], cmap="turbo", vmin=0, vmax=1, linewidths=0
    )
    figure.colorbar(heat, ax=axis, shrink=0.75, label="actionability")
    outlined = [patheffects.withStroke(linewidth=4, foreground="white")]
    for rank, (trajectory, score) in enumerate(zip(trajectories, scores, strict=True)):
        tips, frames = waypoints(trajectory, contact, standoff)
        color, width = ("#111111", 2.4) if rank == 0 else ("#8e24aa", 1.4)
        label = f"score {score:.2f}"
        style = {"color": color, "path_effects": outlined, "zorder": 9 - rank}
        axis.plot(*project(tips).T, "-o", lw=width, ms=4, label=label, **style)
        # A short stroke at every waypoint shows where the hand is.
        hand = project(np.stack([tips, tips - 0.08 * frames[:, :, 2]], 1).reshape(-1, 3)).reshape(-1, 2, 2)
        for segment in hand:
            axis.plot(*segment.T, lw=1, color=color, alpha=0.6, zorder=8 - rank)
    axis.plot(*project(contact), "*", color="#d50000", ms=13, mec="white", zorder=10)
    axis.legend(loc="upper left", bbox_to_anchor=(0, 0), ncols=3, fontsize=8, frameon=False)
    axis.set_aspect("equal")
    axis.axis("off")
    axis.set_title(title, fontsize=10)
    _save(figure, out)


def waypoints(trajectory: np.ndarray, contact: np.ndarray, standoff: float) -> tuple[np.ndarray, np.ndarray]:
    """Commanded fingertip positions [5, 3] and hand frames [5, 3, 3], object frame, of one trajectory [30]."""
    start, _ = unpack_trajectory(jnp.asarray(trajectory))
    total = jnp.concatenate([jnp.zeros((1, 6)), since_start(jnp.asarray(trajectory))])
    frames = start @ rot.matrix_from_euler(total[:, 3:])
    tips = contact - standoff * np.asarray(start[:, 2]) + np.asarray(total[:, :3])
    return tips, np.asarray(frames)


def camera_of_view(camera: tuple[float, float]) -> Camera:
    """The camera of a view, from its azimuth and elevation (rad) in the ViewBank."""
    return Camera.looking_at(np.zeros(3), float(camera[0]), float(camera[1]))


def _save(figure, out: Path) -> None:
    try:
        with whole(out) as part:
            figure.savefig(part, dpi=110, bbox_inches="tight", format="png")
    finally:
        plt.close(figure)
