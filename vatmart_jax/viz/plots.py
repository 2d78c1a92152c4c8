"""Figures of a run: learning curves, the objects, reliability, and what the priors see and propose.

Nothing here touches pyplot, so importing it leaves a notebook's backend alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib import patheffects
from matplotlib.figure import Figure
from matplotlib.image import imread

from vatmart_jax import rotations as rot
from vatmart_jax.atomic_io import atomic_write
from vatmart_jax.camera import Camera
from vatmart_jax.trajectory import cumulative_residuals, unpack_trajectory


def curves(rows: Sequence[dict[str, Any]], metrics: Mapping[str, Sequence[str]], out: Path) -> None:
    """One panel per stage and metric of what a run logged, see `read_metrics`. metrics: names, by the stage's."""
    panels = [
        (stage, name, [(r["step"], r[name]) for r in rows if r["stage"] == stage and name in r])
        for stage, names in metrics.items()
        for name in names
    ]
    panels = [(stage, name, points) for stage, name, points in panels if points]
    columns = 4
    lines = -(-len(panels) // columns)
    figure = Figure(figsize=(14, 2.6 * lines))
    axes = figure.subplots(lines, columns)
    for axis, (stage, name, points) in zip(np.ravel(axes), panels, strict=False):
        axis.plot(*zip(*points, strict=True), marker="." if len(points) < 20 else None)
        axis.set_title(f"{stage}: {name}", fontsize=9)
        axis.grid(alpha=0.3)
    for axis in np.ravel(axes)[len(panels) :]:
        axis.axis("off")
    figure.tight_layout()
    _save(figure, out)


def reliability_curves(curves: dict[str, dict[str, Any]], out: Path) -> None:
    """Predicted against observed success, one line per name; dots grow with the number of trials."""
    figure = Figure(figsize=(5.2, 5))
    axis = figure.subplots()
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
    figure = Figure(figsize=(4 * columns, 1.2 * rows))
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis in axes.flat:
        axis.axis("off")
    for axis, picture in zip(axes.flat, pictures, strict=False):
        axis.imshow(imread(picture))
        axis.set_title(picture.parent.name, fontsize=8)
    _save(figure, out)


def priors_figure(
    out: Path,
    *,
    points: np.ndarray,
    part_mask: np.ndarray,
    actionability: np.ndarray,
    contact: np.ndarray,
    trajectories: np.ndarray,
    scores: np.ndarray,
    camera: Camera,
    title: str,
    standoff: float,
) -> None:
    """The cloud as the camera sees it, the heat map on the moving part, and trajectories from the contact point.

    points: [N, 3]; part_mask: [N] bool; actionability: [N]; contact: [3]; trajectories: [P, 30], best first, drawn
    with decreasing weight; scores: [P]; camera: the one that took the cloud; standoff: of the fingertips from the
    contact at the start.
    """
    figure = Figure(figsize=(6.4, 5.4))
    axis = figure.subplots()
    order = np.argsort(-camera.depth(points))
    points, part_mask, actionability = points[order], part_mask[order], actionability[order]
    flat = camera.project(points)
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
        axis.plot(*camera.project(tips).T, "-o", lw=width, ms=4, label=label, **style)
        # A short stroke at every waypoint shows where the hand is.
        hand = camera.project(np.stack([tips, tips - 0.08 * frames[:, :, 2]], 1).reshape(-1, 3)).reshape(-1, 2, 2)
        for segment in hand:
            axis.plot(*segment.T, lw=1, color=color, alpha=0.6, zorder=8 - rank)
    axis.plot(*camera.project(contact), "*", color="#d50000", ms=13, mec="white", zorder=10)
    axis.legend(loc="upper left", bbox_to_anchor=(0, 0), ncols=3, fontsize=8, frameon=False)
    axis.set_aspect("equal")
    axis.axis("off")
    axis.set_title(title, fontsize=10)
    _save(figure, out)


def waypoints(trajectory: np.ndarray, contact: np.ndarray, standoff: float) -> tuple[np.ndarray, np.ndarray]:
    """Commanded fingertip positions [5, 3] and hand frames [5, 3, 3], object frame, of one trajectory [30]."""
    start, _ = unpack_trajectory(jnp.asarray(trajectory))
    total = jnp.concatenate([jnp.zeros((1, 6)), cumulative_residuals(jnp.asarray(trajectory))])
    frames = start @ rot.matrix_from_euler(total[:, 3:])
    tips = contact - standoff * np.asarray(start[:, 2]) + np.asarray(total[:, :3])
    return tips, np.asarray(frames)


def _save(figure: Figure, out: Path) -> None:
    with atomic_write(out) as part:
        figure.savefig(part, dpi=110, bbox_inches="tight", format="png")
