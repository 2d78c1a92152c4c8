"""Perception trained afresh on a finished run's trials, with other settings: what helps, on which objects.

vatmart train --task push-door --data DATA --out RUN
python experiments/perception_study.py --run RUN --data DATA --out STUDY \
    --variants "as it is:" "scaled:perception.augmentation.scale=0.2,schedule.finetune_rounds=8"

A variant is a label and fields of the run's settings. Each is a run of its own in STUDY/label, which begins with the
trials and the policy of RUN and goes on where it was killed; STUDY/study.json compares them.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import tyro

from vatmart_jax.atomic_io import write_json
from vatmart_jax.data.dataset import Data
from vatmart_jax.envs import get_task
from vatmart_jax.errors import UserError
from vatmart_jax.evaluation.methods.base import EvalContext
from vatmart_jax.physics import default_impl
from vatmart_jax.pipeline.run_config import RunConfig
from vatmart_jax.pipeline.run_dir import RunDir
from vatmart_jax.pipeline.trainer import PipelineTrainer
from vatmart_jax.priors.priors import Priors
from vatmart_jax.reporting import ConsoleReporter
from vatmart_jax.workflows.environments import split_environments
from vatmart_jax.workflows.evaluate import evaluate_split
from vatmart_jax.workflows.train import priors_config


@dataclass(frozen=True)
class Study:
    """Train variants of the perception networks on the trials of one run, and compare them downstream."""

    run: Path
    """run folder of `vatmart train`"""
    data: Path
    """what `vatmart convert` made, and the run was trained on"""
    variants: tuple[str, ...]
    out: Path
    trials: int = 350
    seed: int = 5
    """of the evaluation"""


def changed(settings: Any, field: str, text: str) -> Any:
    """The settings with one field, `perception.scale` say, set. Raises UserError where nobody has it."""
    name, _, rest = field.partition(".")
    value = getattr(settings, name, None)
    if name not in {f.name for f in fields(settings)} or bool(rest) != is_dataclass(value):
        raise UserError(f"--variants ... {field}={text}: no such field of the settings")
    if rest:
        return replace(settings, **{name: changed(value, rest, text)})
    try:
        return replace(settings, **{name: type(value)(float(text))})
    except (TypeError, ValueError) as e:
        raise UserError(f"--variants ... {field}={text}: {e}") from e


def main(args: Study) -> None:
    described = RunConfig.load(args.run)
    settings = described.settings
    task = get_task(described.task)
    data = Data(args.data, *map(Path, described.more_data))  # the run's trials name its views by number
    envs, _ = split_environments(data, task, default_impl(), settings, required=("train",))
    results = []
    with ConsoleReporter() as bars:
        with RunDir(args.run, described.to_json()) as run:
            training = PipelineTrainer(run, envs["train"], settings, seed=described.seed, reporter=bars)
            done = run.restore(training.init_state())
        for variant in args.variants:
            label, _, changes = variant.partition(":")
            own = settings
            for change in filter(None, changes.split(",")):
                field, _, text = change.partition("=")
                own = changed(own, field, text)
            config = {**replace(described, settings=own).to_json(), "trials_of": str(args.run)}
            with RunDir(args.out / label, config) as run:
                training = PipelineTrainer(run, envs["train"], own, seed=described.seed, reporter=bars)
                begun = training.init_state().replace(
                    explore=done.explore, samples=done.samples, stored=done.stored,
                    stage=jnp.int32(own.schedule.stages.index("flow")),
                )  # fmt: skip
                progress = training.train(begun)
            priors = Priors(priors_config(own, task), progress.perception.params)
            rows = []
            for number, (split, env) in enumerate(envs.items()):
                key = jax.random.fold_in(jax.random.key(args.seed), number)
                context = EvalContext(env=env, priors=priors, num_proposals=own.evaluation.num_proposals)
                rows += evaluate_split(split, context, ("ours",), trials=args.trials, key=key, reporter=bars)
            results.append({"variant": variant, "seconds": training.run_seconds(progress), "downstream": rows})
            write_json(args.out / "study.json", {"task": task.name, "seed": args.seed, "variants": results})


if __name__ == "__main__":
    try:
        main(tyro.cli(Study))
    except UserError as e:
        sys.exit(f"error: {e}")
