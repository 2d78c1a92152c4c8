"""`vatmart evaluate`: tables of runs, methods and splits, as JSON and Markdown."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax import serialization

from vatmart_jax.atomic_io import write_json, write_text
from vatmart_jax.data.dataset import SPLITS, Data, DataError
from vatmart_jax.envs import TASKS, Env
from vatmart_jax.envs.scripted_policy import run_scripted_policy
from vatmart_jax.errors import UserError, require_one_of, require_positive, summarize_error
from vatmart_jax.evaluation.metrics import wilson_interval
from vatmart_jax.evaluation.priors_metrics import labelled, priors_metrics
from vatmart_jax.evaluation.success import Method, downstream, random_method
from vatmart_jax.perception.grouped_views import group_views
from vatmart_jax.physics import BACKENDS
from vatmart_jax.pipeline.exploration import ExplorationLoop, start_pool
from vatmart_jax.pipeline.presets import Settings
from vatmart_jax.pipeline.proposal_rollouts import ProposalTrials
from vatmart_jax.pipeline.run_config import settings_of
from vatmart_jax.pipeline.run_dir import read_config
from vatmart_jax.priors.pretrained import run_folder
from vatmart_jax.priors.priors import Priors
from vatmart_jax.viz.plots import reliability_curves

METHODS = ("ours", "random", "expert")
METRICS = ("priors", "downstream", "policy")
_LABELLED = 350  # positives, and as many negatives (paper, section 5.1)

Report = Callable[[str, int, int, dict[str, float]], None]


def evaluate(
    runs: Sequence[Path],
    prepared: Callable[[Path | None], Path],
    data: Path | None,
    metrics: Sequence[str],
    methods: Sequence[str],
    trials: int,
    impl: str,
    seed: int,
    out: Path | None,
    report: Report,
) -> tuple[dict[str, Any], str]:
    """Evaluate finished runs on test shapes and unseen categories; returns the JSON and a Markdown table.

    runs: folders, or names of pretrained priors. prepared: the converted folder of a --data; data: overrides what a
    run was trained on. Writes evaluation.json, evaluation.md and reliability.png into `out`, or into each run's folder
    (nowhere for pretrained ones). Raises UserError for what cannot be evaluated.
    """
    for flag, given, known in (("--metrics", metrics, METRICS), ("--methods", methods, METHODS)):
        for name in given:
            require_one_of(flag, name, known)
    require_one_of("--impl", impl, BACKENDS.names())
    require_positive("--trials", trials)
    begun = time.monotonic()
    evaluated = []
    for given in runs:
        result = _evaluate_run(given, prepared, data, metrics, methods, trials, impl, seed, report)
        evaluated.append(result)
        if out is None and given.is_dir():
            _write(given, {"runs": [result]})
    everything = {"runs": evaluated, "seconds": round(time.monotonic() - begun, 1)}
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        _write(out, everything)
    return everything, _tables(evaluated)


def _evaluate_run(given, prepared, data, metrics, methods, trials, impl, seed, report) -> dict[str, Any]:
    folder = run_folder(given)
    config = read_config(folder)
    task = TASKS[config["task"]]
    priors = Priors.load(folder / "priors")
    settings = settings_of(config, f"{folder}/config.json")
    converted = Data(prepared(data or (config["data"] and Path(config["data"]))))
    key = jax.random.key(seed)
    result: dict[str, Any] = {"run": str(given), "task": task.name, "seed": seed}
    result |= {"downstream": [], "priors": [], "policy": []}

    def environment(split: str) -> Env | None:
        try:
            return converted.env(split, task, impl, settings.env, settings.physics)
        except DataError as e:
            report(f"{split} left out: {e}", 1, 1, {})
            return None

    if {"downstream", "priors"} & set(metrics):
        for number, split in enumerate(SPLITS[1:]):
            if (env := environment(split)) is None:
                continue
            kd, kp = jax.random.split(jax.random.fold_in(key, number))
            if "downstream" in metrics:
                proposals = settings.evaluation.num_proposals
                result["downstream"] += evaluate_split(split, env, priors, methods, trials, proposals, kd, report)
            if "priors" in metrics:
                scores = _priors_split(folder, env, priors, settings, kp, split, report)
                result["priors"].append({"split": split, **scores})
    if "policy" in metrics and (env := environment(SPLITS[0])) is not None:
        _, kp = jax.random.split(jax.random.fold_in(key, len(SPLITS) - 1))
        result["policy"].append(_evaluate_policy(folder, env, settings, trials, kp, report))
    if not any(result[name] for name in METRICS):
        raise UserError(f"{converted.folder}: has no object to evaluate task {task.name} on; see splits.json")
    return result


def evaluate_split(
    split: str,
    env: Env,
    priors: Priors,
    methods: Sequence[str],
    trials: int,
    proposals: int,
    key: jax.Array,
    report: Report,
) -> list[dict[str, Any]]:
    """One row per method: the same views and tasks for all. Consumes the key."""
    rows = []
    for name in methods:
        if name == "ours":
            grouped_views = group_views(env.views, priors.config.networks.encoder)
            trial = ProposalTrials(env, grouped_views, priors.predictor, proposals)
            method = _ours(trial, priors)
        elif name == "expert":
            method = lambda start, key: (run_scripted_policy(env, start, key), None)
        else:
            method = random_method(env)
        label = f"evaluate {name} on {split}"
        result = downstream(env, method, trials, key, lambda done, label=label: report(label, done, trials, {}))
        report(label, trials, trials, {"success": result["success"]})
        rows.append({"split": split, "method": name, **result})
    return rows


def _ours(trial: ProposalTrials, priors: Priors) -> Method:
    def run(start, key):
        final, _, score = trial.best(priors.params, start, key)
        return final, score

    return run


def _priors_split(
    folder: Path, env: Env, priors: Priors, settings: Settings, key: jax.Array, split: str, report: Report
) -> dict[str, Any]:
    explorer = ExplorationLoop(env, settings.explore)
    policy = load_policy(folder, explorer)
    kl, km = jax.random.split(key)
    report(f"label trajectories on {split}", 0, 1, {})
    positive, negative = labelled(explorer, policy, _LABELLED, kl)
    if len(positive.view) == 0:
        return {"positives": 0}
    grouped_views = group_views(env.views, priors.config.networks.encoder)
    result = priors_metrics(
        priors.predictor,
        priors.params,
        grouped_views,
        positive,
        negative,
        km,
        proposals=settings.evaluation.num_proposals,
    )
    report(f"label trajectories on {split}", 1, 1, {})
    return result


def load_policy(folder: Path, explorer: ExplorationLoop) -> Any:
    """The parameters of a run's policy. Raises UserError where its file cannot be read."""
    path = folder / "policy.msgpack"
    try:
        return serialization.from_bytes(explorer.init(jax.random.key(0)).td3.policy, path.read_bytes())
    except (OSError, ValueError, KeyError, TypeError) as e:
        raise UserError(
            f"{path}: cannot be read ({summarize_error(e)}); finish the run, or leave out --metrics priors, policy"
        ) from e


def _evaluate_policy(
    folder: Path, env: Env, settings: Settings, trials: int, key: jax.Array, report: Report
) -> dict[str, Any]:
    """Success of the policy on its training objects: fresh starts that are free and, when pulling, hold.

    `env` is of one folder: of a run on several, the others' objects are left out. Trials stop at success, as in the
    paper; a part that is let go is a failure. Consumes the key.
    """
    explorer = ExplorationLoop(env, settings.explore)
    policy = load_policy(folder, explorer)
    k_pool, k_run = jax.random.split(key)
    say = lambda done: report("policy's starts", done, trials, {})
    pool = start_pool(env, k_pool, trials, say)
    wins = []
    for batch in range(-(-trials // env.config.num_envs)):
        final, _ = explorer.rollout(policy, pool, jax.random.fold_in(k_run, batch), 0.0, 0.0)
        wins.append(np.asarray(final.success))
    won = np.concatenate(wins)[:trials]
    interval = [float(x) for x in wilson_interval(int(won.sum()), trials)]
    return {"split": "train", "success": float(won.mean()), "trials": trials, "ci95": interval}


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    """The table of downstream success, one line per task, method and split. `said` is the mean of its own scores."""
    lines = [
        "| task | method | split | success | 95% interval | said | any waypoint | start in collision | trials |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        low, high = row["ci95"]
        said = f"{row['said']:.1%}" if "said" in row else "-"
        lines.append(
            f"| {row['task']} | {row['method']} | {row['split']} | {row['success']:.1%} | {low:.1%} to {high:.1%} "
            f"| {said} | {row['success_any_waypoint']:.1%} | {row['in_collision']:.1%} | {row['trials']} |"
        )
    return "\n".join(lines)


def _tables(runs: Sequence[dict[str, Any]]) -> str:
    rows = {name: [{"task": run["task"], **row} for run in runs for row in run[name]] for name in METRICS}
    parts = [markdown(rows["downstream"])] if rows["downstream"] else []
    scores = [row for row in rows["priors"] if row["positives"]]
    if scores:
        names = ("accuracy", "precision", "recall", "f_score", "coverage")
        lines = [f"| task | split | {' | '.join(names)} |", "|---" * (2 + len(names)) + "|"]
        for row in scores:
            lines.append(f"| {row['task']} | {row['split']} | " + " | ".join(f"{row[n]:.1%}" for n in names) + " |")
        parts.append("\n".join(lines))
    if rows["policy"]:
        lines = ["| task | policy's success on training objects | 95% interval | trials |", "|---|---|---|---|"]
        for row in rows["policy"]:
            low, high = row["ci95"]
            lines.append(f"| {row['task']} | {row['success']:.1%} | {low:.1%} to {high:.1%} | {row['trials']} |")
        parts.append("\n".join(lines))
    return "\n\n".join(parts)


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
    write_text(folder / "evaluation.md", _tables(everything["runs"]) + "\n")
