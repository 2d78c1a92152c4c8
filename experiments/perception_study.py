"""Perception trained afresh on a finished run's trials, with other settings: what helps, on which objects.

vatmart train --task push-door --data DATA --out RUN
python experiments/perception_study.py --run RUN --data DATA --variants "as it is:" "scaled:scale=0.2" --out study.json

A variant is a label and fields of PerceptionConfig, PointNetConfig or the study's own sizes, as in
`label:kl_weight=0.3,n_points=1024,rounds=8`. All variants begin with the same trials and seeds.
"""

from __future__ import annotations

import sys
import time
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro

from vatmart_jax.config import from_json
from vatmart_jax.data import Data
from vatmart_jax.env import TASKS
from vatmart_jax.errors import UserError
from vatmart_jax.evaluation.evaluate import evaluate_split
from vatmart_jax.files import write_json
from vatmart_jax.inference import Priors, PriorsConfig
from vatmart_jax.perception import train as perception
from vatmart_jax.perception.networks import Networks
from vatmart_jax.perception.train import PerceptionConfig, clouds_of
from vatmart_jax.physics.interface import default_impl
from vatmart_jax.pipeline.collect import ProposalTrials
from vatmart_jax.pipeline.run import Run, read_config
from vatmart_jax.pipeline.train import Training
from vatmart_jax.presets import Settings
from vatmart_jax.training import environments


@dataclass(frozen=True)
class Sizes:
    """How much of each stage."""

    proposal: int = 800
    actionability: int = 150
    rounds: int = 5
    """of labelling the networks' own proposals and training on them"""
    batches: int = 6
    steps: int = 250


@dataclass(frozen=True)
class Study:
    """Train variants of the perception networks on the trials of one run, and compare them downstream."""

    run: Path
    """run folder of `vatmart train`"""
    data: Path
    variants: tuple[str, ...]
    out: Path
    trials: int = 350
    seed: int = 5


def parsed(variant: str, config: PerceptionConfig) -> tuple[str, PerceptionConfig, Sizes]:
    """Label, config and sizes of `label:field=value,...`. Raises UserError for a field that nobody has."""
    label, _, changes = variant.partition(":")
    sizes = Sizes()
    for change in filter(None, changes.split(",")):
        name, _, text = change.partition("=")
        for owner in (config, config.networks, config.networks.pointnet, sizes):
            if name in {f.name for f in fields(owner)}:
                changed: Any = replace(owner, **{name: type(getattr(owner, name))(float(text))})
                break
        else:
            raise UserError(f"--variants {variant}: no field {name}")
        if owner is sizes:
            sizes = changed
        elif owner is config:
            config = changed
        elif owner is config.networks:
            config = replace(config, networks=changed)
        else:
            config = replace(config, networks=replace(config.networks, pointnet=changed))
    return label, config, sizes


def main(args: Study) -> None:
    described = read_config(args.run)
    settings = from_json(Settings, described["settings"])
    task = TASKS[described["task"]]
    envs = environments(Data(args.data), task, default_impl(), settings)
    say = lambda *words: print(*words, file=sys.stderr, flush=True)  # noqa: E731
    with Run(args.run, described) as run:
        training = Training(run, envs["train"], settings, described["seed"], lambda *_: None)
        begun = training.restore()
    results = []
    for variant in args.variants:
        label, config, sizes = parsed(variant, training.config)
        networks, start = Networks(config.networks), time.monotonic()
        clouds = clouds_of(envs["train"].views, config.networks.pointnet)
        state = perception.begin(jax.random.key(args.seed), config)
        last: dict[str, float] = {}
        keep = lambda _, metrics: last.update(metrics)  # noqa: B023, E731
        for stage in ("proposal", "actionability"):
            state = perception.train(state, clouds, begun.samples, config, stage, getattr(sizes, stage), keep)
        progress, rounds = begun, []
        trials = ProposalTrials(envs["train"], clouds, networks, config.proposals)
        for number in range(sizes.rounds):
            rates = []
            for batch in range(sizes.batches):
                key = jax.random.fold_in(jax.random.key(args.seed + 1), number * sizes.batches + batch)
                _, found, chosen = trials.explore(state.params, key)
                rates.append(float(found.success(config.tolerance)[chosen].mean()))
                progress = progress.with_samples(found)
            tuned = replace(config, learning_rate=settings.schedule.finetune_rate)
            state = perception.train(state, clouds, progress.samples, tuned, "joint", sizes.steps, keep)
            rounds.append(round(float(np.mean(rates)), 3))
            say(label, number, rounds[-1], {k: round(v, 3) for k, v in last.items()})
        seconds = round(time.monotonic() - start)
        priors = Priors(PriorsConfig(task.name, task.low, task.high, config.networks), state.params)
        rows = []
        for number, (split, env) in enumerate(envs.items()):
            key = jax.random.key(args.seed + 2 + number)
            rows += evaluate_split(split, env, priors, ("ours",), args.trials, 100, key, lambda *_: None)
        results.append({
            "label": label, "variant": variant, "sizes": asdict(sizes), "seconds": seconds, "rounds": rounds,
            "losses": {k: round(v, 4) for k, v in last.items()}, "downstream": rows,
        })  # fmt: skip
        say(label, {row["split"]: round(row["success"], 3) for row in rows})
        samples = int((np.asarray(begun.samples.view) >= 0).sum())
        write_json(args.out, {"task": task.name, "seed": args.seed, "samples": samples, "variants": results})


if __name__ == "__main__":
    try:
        main(tyro.cli(Study))
    except UserError as e:
        sys.exit(f"error: {e}")
