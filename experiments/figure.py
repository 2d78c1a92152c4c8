"""What priors see, propose and do, one row per task: heat map, three best trajectories, the best one executed.

MUJOCO_GL=osmesa python experiments/figure.py --data DATA --rows push-door:45135@0.6 --out figure.png
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import jax
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import tyro
from PIL import Image

from vatmart_jax.atomic_io import atomic_write
from vatmart_jax.data.banks import SceneBank, ViewBank
from vatmart_jax.envs import TASKS, make_env
from vatmart_jax.priors.pretrained import run_folder
from vatmart_jax.priors.priors import Priors
from vatmart_jax.viz import plots
from vatmart_jax.viz.trial_video import animate, find_scene, play

MOMENTS = (0.0, 0.35, 0.6, 1.0)  # of the trial


@dataclass(frozen=True)
class Figure:
    """Draw trials of priors on chosen Scenes."""

    data: Path
    """what `vatmart convert` made"""
    rows: tuple[str, ...]
    """priors:scene@amount, as in push-door:45135@0.6: a run folder or the name of pretrained ones; object or
    object:part; rad or unit lengths"""
    out: Path
    seed: int = 0


def main(args: Figure) -> None:
    bank, views = SceneBank.load(args.data / "scenes.npz"), ViewBank.load(args.data / "views.npz")
    figure, axes = plt.subplots(
        len(args.rows), 1 + len(MOMENTS), figsize=(13, 2.6 * len(args.rows)), squeeze=False,
        width_ratios=[1.35, *(1.0 for _ in MOMENTS)],
    )  # fmt: skip
    for axis in axes.flat:
        axis.axis("off")
    for row, text in zip(axes, args.rows, strict=True):
        run, _, rest = text.partition(":")
        scene, _, amount = rest.partition("@")
        priors = Priors.load(run_folder(Path(run)))
        recording, result = play(args.data, scene, amount=float(amount), run=run_folder(Path(run)), seed=args.seed)
        chosen = np.array([find_scene(bank, scene)])
        env = make_env(bank.select(chosen), views.of_scenes(chosen), TASKS[priors.config.task])
        view, task = int(recording.state.start.view[0]), float(recording.state.start.goal[0])
        points, mask = env.views.points[view].astype(np.float32), env.views.part_mask[view]
        found = priors.predict(points, task, mask, jax.random.key(args.seed))
        asked = f"{np.degrees(task):.0f} degrees" if priors.config.task.endswith("door") else f"{task:.2f}"
        moved = result["moved"] if priors.config.task.endswith("drawer") else np.degrees(result["moved"])
        with tempfile.TemporaryDirectory() as folder:
            heat, film = Path(folder) / "heat.png", Path(folder) / "trial.gif"
            plots.priors_figure(
                heat, points=points, part_mask=mask, actionability=np.asarray(found.actionability),
                contact=found.contact, trajectories=np.asarray(found.trajectories[:3]),
                scores=np.asarray(found.scores[:3]), camera=env.views.camera(view), standoff=env.config.standoff,
                title=f"{priors.config.task} by {asked}",
            )  # fmt: skip
            animate(recording, film)
            row[0].imshow(plt.imread(heat))
            with Image.open(film) as frames:
                for axis, moment in zip(row[1:], MOMENTS, strict=True):
                    frames.seek(round(moment * (frames.n_frames - 1)))
                    axis.imshow(np.asarray(frames.convert("RGB"))[40:-20, 70:-70])
        row[-1].set_title(f"moved {moved:.3g}", fontsize=8)
        print(text, result)
    figure.tight_layout(pad=0.2)
    with atomic_write(args.out) as part:
        figure.savefig(part, dpi=75, format="png")


if __name__ == "__main__":
    main(tyro.cli(Figure))
