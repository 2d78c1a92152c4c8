"""One run from data to priors, table and pictures: what `vatmart train` does."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vatmart_jax.atomic_io import write_json
from vatmart_jax.data.dataset import SPLITS, Data
from vatmart_jax.envs import Env, Task, get_task
from vatmart_jax.evaluation import tables
from vatmart_jax.evaluation.methods.base import EvalContext
from vatmart_jax.pipeline.run_config import RunConfig
from vatmart_jax.pipeline.run_dir import RunDir, read_metrics
from vatmart_jax.pipeline.settings import Settings
from vatmart_jax.pipeline.stage_timer import StageTimer
from vatmart_jax.pipeline.train_state import TrainState
from vatmart_jax.pipeline.trainer import PipelineTrainer, perception_config
from vatmart_jax.priors.priors import Priors, PriorsConfig
from vatmart_jax.reporting import NullReporter, Reporter
from vatmart_jax.rl.agent import save_policy
from vatmart_jax.viz import plots
from vatmart_jax.viz.priors_figure import draw_priors
from vatmart_jax.workflows.environments import split_environments
from vatmart_jax.workflows.evaluate import evaluate_split

METHODS = ("ours", "random")  # that a run is evaluated with at its end


def train(config: RunConfig, data: Data, out: Path, reporter: Reporter | None = None) -> tuple[dict[str, Any], str]:
    """Train, evaluate and draw what is left of a run; returns result.json's content and the table.

    Raises UserError where the data does not fit the task or `out` holds something else.
    """
    begun = time.monotonic()
    reporter = reporter or NullReporter()
    task = get_task(config.task)
    envs, left_out = split_environments(data, task, config.impl, config.settings, required=(SPLITS[0],))
    described = priors_config(config.settings, task)  # refused before anything is written
    with RunDir(out, config.to_json()) as run:
        trainer = PipelineTrainer(run, envs["train"], config.settings, seed=config.seed, reporter=reporter)
        state = trainer.train()
        priors = Priors(described, state.perception.params)
        priors.save(out / "priors")
        agent = trainer.context.explorer.agent
        save_policy(out, agent, agent.policy_params(state.explore.agent), task.name)
        for split, reason in left_out.items():
            reporter.info(f"{split} left out: {reason}")
        results, seconds = _evaluate(trainer, state, priors, envs, reporter)
        _draw(trainer, priors, envs, data, out)
        ours = {row["split"]: row["success"] for row in results if row["method"] == "ours"}
        result = {
            "run": str(out),
            "task": task.name,
            "stages": seconds,
            "success": {split: ours.get(split) for split in SPLITS[1:]},
            "results": results,
            "left_out": left_out,
            "seconds": round(sum(seconds.values()), 1),
            "seconds_now": round(time.monotonic() - begun, 1),
        }
        write_json(out / "result.json", result)
    table = tables.success_table([{"task": task.name, **row} for row in results])
    return result, "\n\n".join(filter(None, (table, tables.left_out(task.name, left_out))))


def priors_config(settings: Settings, task: Task) -> PriorsConfig:
    """What a run with these settings makes priors of. Raises UserError for settings that make none."""
    networks = perception_config(settings, task).networks
    return PriorsConfig(task.name, *task.goal_range, networks, settings.evaluation.num_augmentations)


def _evaluate(
    trainer: PipelineTrainer, state: TrainState, priors: Priors, envs: dict[str, Env], reporter: Reporter
) -> tuple[list[dict[str, Any]], dict[str, float]]:
    """Rows of success on the test splits, and the seconds of all stages and of this."""
    evaluation, timer = trainer.context.settings.evaluation, StageTimer()
    results = []
    for number, split in enumerate(split for split in envs if split != "train"):
        context = EvalContext(env=envs[split], priors=priors, num_proposals=evaluation.num_proposals)
        key = trainer.key("evaluate", number)
        results += evaluate_split(split, context, METHODS, trials=evaluation.trials, key=key, reporter=reporter)
    lap, seconds = timer.lap(), trainer.run_seconds(state)
    compiling = round(seconds["compile"] + lap.compiling, 1)
    return results, seconds | {"evaluate": round(lap.working, 1), "compile": compiling}


def _draw(trainer: PipelineTrainer, priors: Priors, envs: dict[str, Env], data: Data, out: Path) -> None:
    plots.curves(read_metrics(out), {stage.name: stage.shown for stage in trainer.stages}, out / "curves.png")
    plots.contact_sheet([data.folder / i / "picture.png" for i in _objects(list(envs.values()))], out / "objects.png")
    shown = next((env for split, env in envs.items() if split != "train"), envs["train"])
    draw_priors(priors, shown, trainer.key("pictures"), out)


def _objects(envs: Sequence[Env]) -> list[str]:
    """Object ids, a few of every split, training ones first."""
    return [str(i) for env in envs for i in list(dict.fromkeys(env.bank.object_id[env.views.scene].tolist()))[:8]]
