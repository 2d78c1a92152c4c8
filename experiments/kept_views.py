"""How many objects and views of each split remain after the feasibility filter: the denominators of the success rates.

python experiments/kept_views.py --data DATA --out experiments/results/kept-views.json
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from vatmart_jax.atomic_io import write_json
from vatmart_jax.data.dataset import SPLITS, Data
from vatmart_jax.envs import Env, get_task
from vatmart_jax.pipeline.settings import Settings
from vatmart_jax.workflows.environments import split_environments


@dataclass(frozen=True)
class KeptViews:
    """Count views and objects before and after the filter."""

    data: Path
    """what `vatmart convert` made"""
    out: Path
    tasks: tuple[str, ...] = ("push-door", "pull-door", "push-drawer", "pull-drawer")


def counts(data: Data, split: str, env: Env) -> dict[str, int]:
    scenes = np.flatnonzero((data.scenes.split == split) & (data.scenes.part_kind == env.task.part_kind))
    views = data.views.of_scenes(scenes)
    return {
        "views": int((views.direction == env.task.direction).sum()),
        "views_kept": len(env.views),
        "objects": len(set(data.scenes.object_id[scenes])),
        "objects_kept": len(set(env.bank.object_id[env.views.scene])),
    }


def main(args: KeptViews) -> None:
    data, found = Data(args.data), {}
    for name in args.tasks:
        envs, _ = split_environments(data, get_task(name), "c", Settings())
        rows: dict[str, Any] = {split: counts(data, split, env) for split, env in envs.items()}
        found[name] = {split: rows[split] for split in SPLITS if split in rows}
        print(name, found[name])
    write_json(args.out, found)


if __name__ == "__main__":
    main(tyro.cli(KeptViews))
