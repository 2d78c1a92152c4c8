"""`vatmart evaluate`: tables of runs, methods and splits, as JSON and Markdown."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from vatmart_jax.atomic_io import write_json, write_text
from vatmart_jax.data.dataset import SPLITS, Data
from vatmart_jax.envs import Env, get_task
from vatmart_jax.errors import UserError, require_one_of, require_positive
from vatmart_jax.evaluation.methods.base import METHODS, EvalContext
from vatmart_jax.evaluation.metrics import wilson_interval
from vatmart_jax.evaluation.priors_metrics import priors_metrics, sample_labelled_trajectories
from vatmart_jax.evaluation.success import evaluate_success
from vatmart_jax.evaluation.tables import evaluation_tables
from vatmart_jax.physics import BACKENDS
from vatmart_jax.pipeline.exploration import ExplorationLoop, start_pool
from vatmart_jax.pipeline.run_config import RunConfig, load_run_policy
from vatmart_jax.priors.pretrained import run_folder
from vatmart_jax.priors.priors import Priors
from vatmart_jax.reporting import NullReporter, Reporter
from vatmart_jax.viz.plots import reliability_curves
from vatmart_jax.workflows.environments import split_environments
from vatmart_jax.workflows.prepare import prepare, prepare_source

METRICS = ("priors", "downstream", "policy")
NUM_LABELLED = 350  # positives, and as many negatives (paper, section 5.1)


@dataclass(frozen=True, kw_only=True)
class EvaluationPlan:
    """What to evaluate runs with."""

    impl: str  # of the physics
    metrics: tuple[str, ...] = ("priors", "downstream")  # of METRICS
    methods: tuple[str, ...] = ("ours", "random")  # of METHODS, downstream
    trials: int = 350  # per method and split
    seed: int = 1
    data: Path | None = None  # instead of what a run was trained on

    def __post_init__(self) -> None:
        """Raises UserError for what is unknown."""
        for name in self.metrics:
            require_one_of("metrics", name, METRICS)
        for name in self.methods:
            METHODS.get(name)
        BACKENDS.require(self.impl)
        require_positive("trials", self.trials)


def evaluate(
    runs: Sequence[Path], plan: EvaluationPlan, *, out: Path | None = None, reporter: Reporter | None = None
) -> tuple[dict[str, Any], str]:
    """Evaluate finished runs on test shapes and unseen categories; returns the JSON and a Markdown table.

    runs: folders, or names of pretrained priors. Writes evaluation.json, evaluation.md and reliability.png into `out`,
    or into each run's folder (nowhere for pretrained ones). Raises UserError for what cannot be evaluated.
    """
    begun = time.monotonic()
    evaluated = []
    for given in runs:
        result = _evaluate_run(given, plan, reporter or NullReporter())
        evaluated.append(result)
        if out is None and given.is_dir():
            _write(given, {"runs": [result]})
    everything = {"runs": evaluated, "seconds": round(time.monotonic() - begun, 1)}
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        _write(out, everything)
    return everything, evaluation_tables(evaluated)


def _evaluate_run(given: Path, plan: EvaluationPlan, reporter: Reporter) -> dict[str, Any]:
    folder = run_folder(given)
    config = RunConfig.load(folder)
    settings, task = config.settings, get_task(config.task)
    priors = Priors.load(folder / "priors")
    data = _data(given, config, plan, reporter)
    key = jax.random.key(plan.seed)
    result: dict[str, Any] = {"run": str(given), "task": task.name, "seed": plan.seed}
    result |= {"downstream": [], "priors": [], "policy": [], "left_out": {}}

    wanted = [*(SPLITS[1:] if {"downstream", "priors"} & set(plan.metrics) else ())]
    wanted += [SPLITS[0]] if "policy" in plan.metrics else []
    envs, result["left_out"] = split_environments(data, task, plan.impl, settings, splits=wanted)
    for split, reason in result["left_out"].items():
        reporter.info(f"{split} left out: {reason}")
    if {"downstream", "priors"} & set(plan.metrics):
        for number, split in enumerate(SPLITS[1:]):
            if split not in envs:
                continue
            kd, kp = jax.random.split(jax.random.fold_in(key, number))
            context = EvalContext(
                env=envs[split], priors=priors, num_proposals=settings.evaluation.num_proposals, run_dir=folder
            )
            if "downstream" in plan.metrics:
                result["downstream"] += evaluate_split(
                    split, context, plan.methods, trials=plan.trials, key=kd, reporter=reporter
                )
            if "priors" in plan.metrics:
                scores = _evaluate_priors(split, context, config, kp, reporter)
                result["priors"].append({"split": split, **scores})
    if "policy" in plan.metrics and SPLITS[0] in envs:
        _, kp = jax.random.split(jax.random.fold_in(key, len(SPLITS) - 1))
        result["policy"].append(_evaluate_policy(folder, envs[SPLITS[0]], config, plan.trials, kp, reporter))
    if not any(result[name] for name in METRICS):
        raise UserError(f"{data.folder}: has no object to evaluate task {task.name} on; see splits.json")
    return result


def _data(given: Path, config: RunConfig, plan: EvaluationPlan, reporter: Reporter) -> Data:
    """With as many points as the run's networks read."""
    num_points = config.settings.perception.networks.encoder.n_points
    if plan.data is not None:
        return Data(prepare(plan.data, num_points=num_points, reporter=reporter))
    folder = prepare_source(config.data, where=str(given), num_points=num_points, reporter=reporter)
    return Data(folder)


def evaluate_split(
    split: str,
    context: EvalContext,
    methods: Sequence[str],
    *,
    trials: int,
    key: jax.Array,
    reporter: Reporter | None = None,
) -> list[dict[str, Any]]:
    """One row per method: the same views and goals for all. Consumes the key."""
    reporter = reporter or NullReporter()
    rows = []
    for name in methods:
        label = f"evaluate {name} on {split}"
        show = lambda done, label=label: reporter.progress(label, done, trials)
        result = evaluate_success(context.env, METHODS.get(name)(context), trials, key, show)
        reporter.progress(label, trials, trials, {"success": result["success"]})
        rows.append({"split": split, "method": name, **result})
    return rows


def _evaluate_priors(
    split: str, context: EvalContext, config: RunConfig, key: jax.Array, reporter: Reporter
) -> dict[str, Any]:
    priors, folder = context.require_priors(), context.run_dir
    assert folder is not None
    agent, policy = load_run_policy(folder)
    explorer = ExplorationLoop(context.env, config.settings.explore, agent)
    k_label, k_metrics = jax.random.split(key)
    reporter.progress(f"label trajectories on {split}", 0, 1)
    positive, negative = sample_labelled_trajectories(explorer, policy, NUM_LABELLED, k_label)
    if len(positive.view) == 0:
        return {"positives": 0}
    result = priors_metrics(
        priors.predictor, priors.params, context.views, positive, negative, key=k_metrics,
        proposals=context.num_proposals,
    )  # fmt: skip
    reporter.progress(f"label trajectories on {split}", 1, 1)
    return result


def _evaluate_policy(
    folder: Path, env: Env, config: RunConfig, trials: int, key: jax.Array, reporter: Reporter
) -> dict[str, Any]:
    """Success of the policy on its training objects: fresh starts that are free and, when pulling, hold.

    `env` is of one folder: of a run on several, the others' objects are left out. Trials stop at success, as in the
    paper; a part that is let go is a failure. Consumes the key.
    """
    agent, policy = load_run_policy(folder)
    explorer = ExplorationLoop(env, config.settings.explore, agent)
    k_pool, k_run = jax.random.split(key)
    pool = start_pool(env, k_pool, trials, lambda done: reporter.progress("policy's starts", done, trials))
    wins = []
    for batch in range(-(-trials // env.config.num_envs)):
        final, _ = explorer.rollout(policy, pool, jax.random.fold_in(k_run, batch), noise=0.0)
        wins.append(np.asarray(final.success))
    won = np.concatenate(wins)[:trials]
    interval = list(wilson_interval(int(won.sum()), trials))
    return {"split": SPLITS[0], "success": float(won.mean()), "trials": trials, "ci95": interval}


def _write(folder: Path, everything: dict[str, Any]) -> None:
    curves = {
        f"{Path(run['run']).name}, {row['split']}": row["reliability"]
        for run in everything["runs"]
        for row in run["downstream"]
        if "reliability" in row
    }
    if curves:
        reliability_curves(curves, folder / "reliability.png")
    write_json(folder / "evaluation.json", everything)
    write_text(folder / "evaluation.md", evaluation_tables(everything["runs"]) + "\n")
