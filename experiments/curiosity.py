"""Curiosity on against off with the same budget, the spread over seeds, and one seed twice.

vatmart convert REAL --out DATA
python experiments/curiosity.py --data DATA --runs RUNS --out experiments/results/curiosity.json

Off means that the penalty is zero: the same rounds, trials and steps, and the policy explores without it. Stopped at
any moment, rerunning the command resumes; runs that are finished in RUNS are read and not done again.
"""

import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tyro

from vatmart_jax.atomic_io import write_json
from vatmart_jax.data.dataset import Data
from vatmart_jax.errors import UserError, require_one_of, require_positive
from vatmart_jax.evaluation.metrics import wilson_interval
from vatmart_jax.physics import default_impl
from vatmart_jax.pipeline.presets import PRESETS
from vatmart_jax.pipeline.run_config import DataSource, RunConfig
from vatmart_jax.pipeline.run_dir import read_metrics
from vatmart_jax.reporting import ConsoleReporter
from vatmart_jax.workflows.train import train


@dataclass(frozen=True)
class Curiosity:
    """Train with and without the curiosity penalty and compare success downstream."""

    data: Path
    """what `vatmart convert` made"""
    runs: Path
    """folder for the run folders"""
    out: Path
    task: str = "push-drawer"
    preset: str = "quick"
    seeds: tuple[int, ...] = (0, 1, 2)


def run(args: Curiosity, seed: int, weight: float, out: Path, bars: ConsoleReporter) -> dict[str, Any]:
    """What a run's result.json says, after the run where there is none yet."""
    settings = PRESETS[args.preset]
    settings = replace(settings, schedule=replace(settings.schedule, curiosity_weight=weight))
    config = RunConfig(
        task=args.task, data=DataSource.of(args.data), preset=args.preset, impl=default_impl(), seed=seed,
        settings=settings,
    )  # fmt: skip
    if (out / "result.json").is_file() and RunConfig.load(out) == config:
        return json.loads((out / "result.json").read_text())
    bars.info(f"{out.name}: seed {seed}, curiosity weight {weight:g}")
    result, _ = train(config, Data(args.data), out, bars)
    return result


def main(args: Curiosity) -> None:
    require_one_of("--preset", args.preset, PRESETS)
    require_positive("--seeds: their number", len(args.seeds))
    weight = PRESETS[args.preset].schedule.curiosity_weight
    names = {f"{seed}-{'on' if on else 'off'}": (seed, on) for seed in args.seeds for on in (True, False)}
    names[f"{args.seeds[0]}-on-again"] = (args.seeds[0], True)
    rows = []
    with ConsoleReporter() as bars:
        for name, (seed, on) in names.items():
            result = run(args, seed, weight if on else 0.0, args.runs / name, bars)
            ours = {row["split"]: row for row in result["results"] if row["method"] == "ours"}
            novel = [line["novel"] for line in read_metrics(args.runs / name) if line["stage"] == "curiosity"]
            rows.append({
                "run": name, "seed": seed, "curiosity": on, "seconds": result["seconds"], "novel": novel,
                **{split: {k: row[k] for k in ("success", "ci95", "said", "trials")} for split, row in ours.items()},
            })  # fmt: skip
    *rows, repeated = rows
    table: dict[str, Any] = {}
    for split in result["success"]:
        for on in (True, False):
            of = [row[split] for row in rows if row["curiosity"] == on]
            trials = sum(row["trials"] for row in of)
            successes = round(sum(row["success"] * row["trials"] for row in of))
            low, high = wilson_interval(successes, trials)
            table.setdefault(split, {})["on" if on else "off"] = {
                "success": successes / trials, "ci95": [low, high], "trials": trials,
                "seeds": [row["success"] for row in of],
            }  # fmt: skip
    same = all(repeated[split]["success"] == rows[0][split]["success"] for split in result["success"])
    what = {"task": args.task, "preset": args.preset, "seeds": args.seeds, "same_seed_same_rates": same}
    write_json(args.out, what | {"table": table, "runs": [*rows, repeated]})
    print(json.dumps(what | {"table": table}, indent=2))


if __name__ == "__main__":
    try:
        main(tyro.cli(Curiosity))
    except UserError as e:
        sys.exit(f"error: {e}")
