"""`vatmart predict`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import jax
from tyro.conf import Positional

from vatmart_jax.cli.common import JsonFlag, Output, prepare_jax
from vatmart_jax.cli.inputs import read_cloud, read_mask
from vatmart_jax.envs import get_task
from vatmart_jax.errors import require_positive
from vatmart_jax.priors.pretrained import run_folder
from vatmart_jax.priors.priors import Priors


@dataclass(frozen=True)
class Predict:
    """Where to touch a partial point cloud for a task, which trajectories to try, and how likely each works."""

    priors: Positional[Path]
    """run folder of `vatmart train`, a folder of priors, or the name of pretrained ones, such as push-door"""
    cloud: Path
    """.npy [N, 3] or .ply: z up, the object's front towards -x, unit lengths"""
    task: str
    """how far to move the part: 30deg or 0.5rad (doors, lids), 0.3 (drawers, unit lengths)"""
    mask: Path | None = None
    """.npy [N] bool: the points of the part to move"""
    proposals: int = 100
    seed: int = 0
    out: Path | None = None
    """.npz for the actionability of every point, all trajectories and their scores"""
    json: JsonFlag = False

    def run(self) -> Output:
        require_positive("--proposals", self.proposals)
        prepare_jax()
        priors = Priors.load(run_folder(self.priors))
        points = read_cloud(self.cloud)
        mask = None if self.mask is None else read_mask(self.mask, len(points))
        goal = get_task(priors.config.task).parse_goal(self.task)
        found = priors.predict(points, goal, mask, jax.random.key(self.seed), self.proposals)
        if self.out is not None:
            found.save(self.out)
        result = {
            "contact": found.contact.tolist(),
            "contact_index": found.contact_index,
            "actionability_max": float(found.actionability[found.contact_index]),
            "trajectories": found.trajectories.tolist(),
            "scores": found.scores.tolist(),
        }
        contact = ", ".join(f"{x:.3f}" for x in found.contact)
        text = f"contact {contact}  actionability {result['actionability_max']:.3f}  best score {found.scores[0]:.3f}"
        return Output(result, text, only_text=True)
