"""How far a script with privileged knowledge gets at every task, and what stops it.

vatmart convert REAL --out DATA; python experiments/expert_study.py --data DATA --out results/expert.json
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro

from vatmart_jax.atomic_io import write_json
from vatmart_jax.data.dataset import Data
from vatmart_jax.envs import TASKS, Env, EnvConfig
from vatmart_jax.envs.scripted_policy import scripted_action, scripted_start
from vatmart_jax.evaluation.metrics import wilson_interval
from vatmart_jax.physics import PhysicsConfig
from vatmart_jax.trajectory import WAYPOINTS


@dataclass(frozen=True)
class Study:
    """The scripted expert on random views and tasks of every split."""

    data: Path
    """what `vatmart convert` made"""
    out: Path
    tasks: tuple[str, ...] = tuple(TASKS)
    splits: tuple[str, ...] = ("train", "test_shapes", "test_categories")
    trials: int = 512
    seed: int = 0
    env: EnvConfig = field(default_factory=EnvConfig)


def main(args: Study) -> None:
    data, found = Data(args.data), {}
    for task in args.tasks:
        for split in args.splits:
            env = data.env(split, TASKS[task], "c", args.env, PhysicsConfig())
            found.setdefault(task, {})[split] = result = study(env, args.trials, args.seed)
            print(task, split, {k: v for k, v in result.items() if k != "worst"}, file=sys.stderr, flush=True)
            write_json(args.out, {"seed": args.seed, "tasks": found})


def study(env: Env, trials: int, seed: int) -> dict[str, Any]:
    """Rates over all trials and, when pulling, over those on a handle that fits between the fingers."""

    @jax.jit
    def run(key):
        k_start, k_expert = jax.random.split(key)
        begun = env.begin_trials(scripted_start(env, env.sample(k_start, env.config.num_envs), k_expert))
        step = lambda state, _: (env.step(state, scripted_action(env, state), terminate_on_failure=False),) * 2
        final, path = jax.lax.scan(step, begun, length=WAYPOINTS)
        return {
            "scene": final.physics.scene,
            "view": final.start.view,
            "contact": final.start.contact,
            "task": final.start.goal,
            "moved": final.displacement,
            "success": final.success,
            "in_collision": final.in_collision,
            "grasped": begun.valid,
            "grip": begun.physics.qpos[:, env.physics.gripper.finger_qpos].sum(-1),
            "lost": begun.valid & ~final.grasp_held,
            "lost_first": begun.valid & ~path.grasp_held[0],
        }

    batches = [
        jax.device_get(run(jax.random.fold_in(jax.random.key(seed), i)))
        for i in range(-(-trials // env.config.num_envs))
    ]
    rows = {name: np.concatenate([b[name] for b in batches])[:trials] for name in batches[0]}
    ratio = rows["moved"] / rows["task"]
    rows["short"] = rows["grasped"] & ~rows["lost"] & (ratio < 1 - env.config.tolerance)
    rows["too_far"] = rows["grasped"] & ~rows["lost"] & (ratio > 1 + env.config.tolerance)
    everything = np.ones(trials, bool)
    result = {"trials": trials, **_rates(rows, everything)}
    if env.task.grasps:
        handle = env.views.contact_handle[rows["view"], rows["contact"]]
        # Where nothing was grasped the handle's width is not known: it counts as one that fits.
        fits = handle & (~rows["grasped"] | (rows["grip"] < 2 * env.physics.gripper.max_opening - 0.01))
        for name, chosen in (("handle", handle), ("handle_that_fits", fits), ("edge", ~handle)):
            if chosen.any():
                result[name] = {"trials": int(chosen.sum()), **_rates(rows, chosen)}
    objects = env.bank.object_id[rows["scene"]]
    worst = []
    for name in np.unique(objects):
        own = objects == name
        why = {k: round(float(rows[k][own].mean()), 2) for k in ("in_collision", "lost", "short", "too_far")}
        worst.append({"object": str(name), "success": round(float(rows["success"][own].mean()), 2), **why})
    return result | {"worst": sorted(worst, key=lambda row: row["success"])[:8]}


def _rates(rows: dict[str, np.ndarray], chosen: np.ndarray) -> dict[str, Any]:
    names = ("success", "in_collision", "grasped", "lost", "lost_first", "short", "too_far")
    interval = wilson_interval(int(rows["success"][chosen].sum()), int(chosen.sum()))
    return {name: round(float(rows[name][chosen].mean()), 4) for name in names} | {
        "ci95": [round(float(x), 4) for x in interval]
    }


if __name__ == "__main__":
    main(tyro.cli(Study))
