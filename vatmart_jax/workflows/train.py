"""One run from data to priors, table and pictures: what `vatmart train` does."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import serialization

from vatmart_jax import __version__
from vatmart_jax.atomic_io import write_bytes, write_json
from vatmart_jax.config import to_json
from vatmart_jax.data.dataset import SPLITS, Data, DataError
from vatmart_jax.envs import TASKS, Env, Task
from vatmart_jax.errors import require_one_of
from vatmart_jax.physics import BACKENDS
from vatmart_jax.pipeline.presets import Settings
from vatmart_jax.pipeline.run_config import FORMAT
from vatmart_jax.pipeline.run_dir import RunDir, read_metrics
from vatmart_jax.pipeline.stage_timer import StageTimer
from vatmart_jax.pipeline.trainer import PipelineTrainer, Report, perception_config, run_seconds
from vatmart_jax.priors.priors import Priors, PriorsConfig
from vatmart_jax.viz import plots
from vatmart_jax.workflows.evaluate import evaluate_split, markdown

_PICTURES = 6


def resolve(
    task: str, preset: str, impl: str, seed: int, settings: Settings, data: Path | None, more_data: Sequence[Path] = ()
) -> dict[str, Any]:
    """The config that is written beside every result. Raises UserError for an unknown task or impl."""
    require_one_of("--task", task, TASKS)
    require_one_of("--impl", impl, BACKENDS.names())
    return {
        "format": FORMAT,
        "version": __version__,
        "task": task,
        "data": None if data is None else str(data.resolve()),
        "more_data": [str(folder.resolve()) for folder in more_data],
        "preset": preset,
        "impl": impl,
        "seed": seed,
        "settings": to_json(settings),
    }


def train(
    config: dict[str, Any], settings: Settings, data: Data, out: Path, report: Report
) -> tuple[dict[str, Any], str]:
    """Train, evaluate and draw what is left of a run; returns result.json's content and the table.

    config: of `resolve`. Raises UserError where the data does not fit the task or `out` holds something else.
    """
    begun = time.monotonic()
    task = TASKS[config["task"]]
    envs = environments(data, task, config["impl"], settings)
    described = priors_config(settings, task)  # refused before anything is written
    with RunDir(out, config) as run:
        training = PipelineTrainer(run, envs["train"], settings, config["seed"], report)
        progress = training.train()
        priors = Priors(described, progress.perception.params)
        priors.save(out / "priors")
        policy = progress.explore.td3.target_policy  # a running mean, which succeeds more often than the last step
        write_bytes(out / "policy.msgpack", serialization.to_bytes(jax.device_get(policy)))
        tests = {split: env for split, env in envs.items() if split != "train"}
        clock = StageTimer()
        results = []
        for number, (split, env) in enumerate(tests.items()):
            results += evaluate_split(
                split, env, priors, ("ours", "random"), settings.evaluation.trials,
                settings.evaluation.num_proposals, training.key("evaluate", number), report,
            )  # fmt: skip
        lap, seconds = clock.lap(), run_seconds(progress)
        seconds |= {"evaluate": round(lap.working, 1), "compile": round(seconds["compile"] + lap.compiling, 1)}
        table = markdown([{"task": task.name, **row} for row in results])
        plots.curves(read_metrics(out), out / "curves.png")
        plots.contact_sheet([data.folder / i / "picture.png" for i in _objects(envs)], out / "objects.png")
        shown = next(iter(tests.values()), envs["train"])
        draw_priors(priors, shown, training.key("pictures"), out)
        ours = {row["split"]: row["success"] for row in results if row["method"] == "ours"}
        result = {
            "run": str(out),
            "task": task.name,
            "stages": seconds,
            "success": {split: ours.get(split) for split in SPLITS[1:]},
            "results": results,
            "seconds": round(sum(seconds.values()), 1),
            "seconds_now": round(time.monotonic() - begun, 1),
        }
        write_json(out / "result.json", result)
    return result, table


def priors_config(settings: Settings, task: Task) -> PriorsConfig:
    """What a run with these settings makes priors of. Raises UserError for settings that make none."""
    networks = perception_config(settings, task).networks
    return PriorsConfig(task.name, *task.goal_range, networks, settings.evaluation.num_augmentations)


def environments(data: Data, task: Task, impl: str, settings: Settings) -> dict[str, Env]:
    """One environment per split that has something for the task; the training split must."""
    found: dict[str, Env] = {}
    for split in SPLITS:
        try:
            found[split] = data.env(split, task, impl, settings.env, settings.physics)
        except DataError:
            if split == "train":
                raise
    return found


def draw_priors(priors: Priors, env: Env, key: jax.Array, out: Path) -> None:
    """Heat map and proposals for a few views of different objects."""
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    order = rng.permutation(len(env.views))
    objects = env.bank.object_id[env.views.scene[order]]
    order = order[np.sort(np.unique(objects, return_index=True)[1])]
    start = env.sample_goal(key, jnp.asarray(order[:_PICTURES], jnp.int32))
    for number, (view, task) in enumerate(zip(order[:_PICTURES].tolist(), np.asarray(start).tolist(), strict=True)):
        points = env.views.points[view].astype(np.float32)
        mask = env.views.part_mask[view]
        if not mask.any():
            continue
        predicted = priors.predict(points, task, mask, key=jax.random.fold_in(key, number))
        best = np.argsort(-np.asarray(predicted.scores))[:3]
        scene = env.views.scene[view]
        amount = f"{np.degrees(task):.0f} degrees" if env.task.joint_type == 0 else f"{task:.2f}"
        plots.priors_figure(
            out / f"priors_{number}.png",
            points=points,
            part_mask=mask,
            actionability=np.asarray(predicted.actionability),
            contact=np.asarray(predicted.contact),
            trajectories=np.asarray(predicted.trajectories)[best],
            scores=np.asarray(predicted.scores)[best],
            camera=env.views.camera(view),
            title=f"{env.task.name} by {amount}: {env.bank.category[scene]} {env.bank.object_id[scene]}",
            standoff=env.config.standoff,
        )


def _objects(envs: dict[str, Env]) -> list[str]:
    """Object ids, a few of every split, training ones first."""
    found: list[str] = []
    for env in envs.values():
        found += [str(i) for i in dict.fromkeys(env.bank.object_id.tolist())][:8]
    return found
