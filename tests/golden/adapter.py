"""All that the golden tests know of the project: every import of it, and every name that may move or change.

What these functions return has the names that the values beside were recorded with. Where something of the project is
renamed, this file changes and the values stay.
"""

from __future__ import annotations

import contextlib
import io
import os
from dataclasses import fields, replace
from pathlib import Path
from unittest import mock

import numpy as np

from conversion.convert import ConvertConfig, convert
from mjcf_assets.generator import generate
from vatmart_jax.bank import SceneBank, ViewBank
from vatmart_jax.cli import COMMANDS, main
from vatmart_jax.data import Data
from vatmart_jax.env import TASKS, EnvConfig
from vatmart_jax.inference import Priors
from vatmart_jax.perception.networks import NetworksConfig
from vatmart_jax.perception.pointnet2 import Around, Level, PointNetConfig
from vatmart_jax.perception.train import PerceptionConfig
from vatmart_jax.physics import PhysicsConfig
from vatmart_jax.pipeline.explore import ExploreConfig
from vatmart_jax.pipeline.run import Run, read_metrics
from vatmart_jax.pipeline.train import Training
from vatmart_jax.presets import PRESETS, EvaluationConfig, Schedule, Settings
from vatmart_jax.pretrained import names, run_folder
from vatmart_jax.rl.td3 import TD3Config
from vatmart_jax.training import resolve

RENAMED: dict[str, str] = {}
"""New name -> golden name, of arrays, metrics and stages."""

RUNS = ("push-drawer", "push-door", "pull-door")
PRETRAINED = tuple(names())
HELP = {
    "vatmart": ("--help",),
    **{command: (command, "--help") for command in COMMANDS},
    **{f"bench-{what}": ("bench", what, "--help") for what in ("physics", "parity", "perception")},
    **{f"train-{preset}": ("train", "--preset", preset, "--help") for preset in PRESETS if preset != "quick"},
}
"""Name of a file of values/help -> the command's words."""

# Preset `quick` in small: door hinges, local networks, Muon, every stage.
_DOOR = Settings(
    env=EnvConfig(batch=16),
    physics=PhysicsConfig(steps_per_waypoint=50),
    explore=ExploreConfig(
        td3=TD3Config(hidden=32, batch=32, capacity=1000, updates=4), iterations=4, pool=32, warmup=2
    ),
    perception=PerceptionConfig(
        networks=NetworksConfig(
            pointnet=PointNetConfig(
                64, (Level(16, 0.3, 4, (16,)), Level(4, 0.8, 4, (16,))), ((16,), (16,)), 16, (Around(0.15, 8, (8,)),),
                (8,),
            ),
            course=(16,), hinge=True, hand=(8,), trajectory=(16,), posterior=(16,), decoder=(16,), scorer=(16,),
            actionability=(16,), latent_dim=8, contact_dim=8, task_dim=8,
        ),
        views=2, queries=4, probes=2, proposals=4, best=2, steps_per_call=3,
    ),
    schedule=Schedule(
        samples=512, collect=2, course=3, scorer=3, proposal=3, actionability=3, curiosity=1, curiosity_iterations=1,
        curiosity_steps=3, finetune=1, finetune_batches=1, finetune_steps=3,
    ),
    evaluation=EvaluationConfig(trials=24, proposals=4, copies=2),
)  # fmt: skip
# As preset `paper` has it, and quick to compile: nothing local, Adam.
_DRAWER = replace(
    _DOOR,
    perception=replace(
        _DOOR.perception,
        muon=False,
        networks=replace(
            _DOOR.perception.networks,
            hand=(),
            pointnet=replace(_DOOR.perception.networks.pointnet, around=(), context=()),
        ),
    ),
)


def convert_generated(folder: Path) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Arrays of the Scenes and of the views of five generated objects with doors and drawers, by golden name."""
    generate(folder / "objects", 5, seed=0)
    config = ConvertConfig(views=1, points=512, contacts=32)
    convert([folder / "objects"], folder / "converted", config, jobs=2)
    banks = SceneBank.load(folder / "converted" / "scenes.npz"), ViewBank.load(folder / "converted" / "views.npz")
    scenes, views = ({f.name: np.asarray(getattr(bank, f.name)) for f in fields(bank)} for bank in banks)
    return _golden(scenes), _golden(views)


def tiny_run(banks: tuple[SceneBank, ViewBank], task: str, folder: Path) -> list[dict[str, float | str]]:
    """What a tiny run logs, in order: stage, step and metrics, without seconds. banks: Scenes and their views."""
    for bank, name in zip(banks, ("scenes", "views"), strict=True):
        bank.save(folder / f"{name}.npz")
    settings = _DOOR if task.endswith("door") else _DRAWER
    env = Data(folder).env("train", TASKS[task], "c", settings.env, settings.physics)
    with Run(folder / "run", resolve(task, "quick", "c", 0, settings, folder)) as run:
        Training(run, env, settings, 0, lambda *_: None).train()
    rows = [_golden({k: v for k, v in row.items() if k != "seconds"}) for row in read_metrics(folder / "run")]
    return [{**row, "stage": RENAMED.get(row["stage"], row["stage"])} for row in rows]


def predict(name: str, points: np.ndarray, mask: np.ndarray, task: float, proposals: int) -> dict[str, np.ndarray]:
    """What pretrained priors say: contact index [], actionability [N], trajectories [P, 30] and scores [P]."""
    found = Priors.load(run_folder(Path(name))).predict(points, task, mask, n_proposals=proposals)
    return {
        "contact_index": np.asarray(found.contact_index),
        "actionability": found.actionability,
        "trajectories": found.trajectories,
        "scores": found.scores,
    }


def help_text(words: tuple[str, ...]) -> str:
    """What a command prints that is asked for help, 100 columns wide, without colour."""
    printed = io.StringIO()
    plain = {"COLUMNS": "100", "LINES": "50", "NO_COLOR": "1", "TERM": "dumb"}
    with mock.patch.dict(os.environ, plain), contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        main(list(words))
    return "\n".join(line.rstrip() for line in printed.getvalue().splitlines()) + "\n"


def _golden(named: dict) -> dict:
    return {RENAMED.get(name, name): value for name, value in named.items()}
