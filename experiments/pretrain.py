"""Put what a finished run learned where `vatmart evaluate push-door` and its like find it.

python experiments/pretrain.py --run RUN --name push-door
"""

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import tyro

from vatmart_jax.atomic_io import atomic_directory, write_json
from vatmart_jax.pipeline.run_config import EXTERNAL, RunConfig
from vatmart_jax.pipeline.run_dir import read_metrics
from vatmart_jax.priors import pretrained
from vatmart_jax.priors.priors import Priors

RESULTS = Path(__file__).parent / "results"


@dataclass(frozen=True)
class Pretrain:
    """Copy a run's priors, policy and config into the package, and its result and curves beside the other results."""

    run: Path
    """run folder of `vatmart train`"""
    name: str


def main(args: Pretrain) -> None:
    # Paths of the machine that trained the set are left out.
    config = replace(RunConfig.load(args.run), data=EXTERNAL, more_data=()).to_json()
    priors = Priors.load(args.run)
    with atomic_directory(pretrained.FOLDER / args.name) as folder:
        write_json(folder / "config.json", config)
        priors.save(folder / "priors")
        for name in ("policy.msgpack", "policy.json"):
            shutil.copyfile(args.run / name, folder / name)
    result = json.loads((args.run / "result.json").read_text()) | {"run": args.name}
    lines = read_metrics(args.run)
    for stage in ("explore", "finetune"):
        result[f"{stage}_success"] = [round(line["success"], 3) for line in lines if line["stage"] == stage]
    write_json(RESULTS / f"train-{args.name}.json", result)


if __name__ == "__main__":
    main(tyro.cli(Pretrain))
