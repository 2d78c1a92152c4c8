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

from conversion.config import ConvertConfig, ViewConfig
from conversion.convert import convert
from mjcf_assets.procedural.generate import generate
from vatmart_jax.cli.main import COMMANDS, main
from vatmart_jax.data.banks import SceneBank, ViewBank
from vatmart_jax.data.dataset import Data
from vatmart_jax.envs import EnvConfig, get_task
from vatmart_jax.perception.networks import NetworksConfig
from vatmart_jax.perception.pointnet2 import LocalGroup, PointNet2Config, SetAbstraction
from vatmart_jax.perception.trainer import PerceptionConfig
from vatmart_jax.physics import PhysicsConfig
from vatmart_jax.pipeline.exploration import ExplorationConfig
from vatmart_jax.pipeline.presets import PRESETS
from vatmart_jax.pipeline.run_dir import RunDir, read_metrics
from vatmart_jax.pipeline.settings import EvaluationConfig, Schedule, Settings
from vatmart_jax.pipeline.trainer import PipelineTrainer
from vatmart_jax.priors.pretrained import names, run_folder
from vatmart_jax.priors.priors import Priors
from vatmart_jax.rl.td3 import TD3Config
from vatmart_jax.workflows.environments import split_environments

RENAMED: dict[str, str] = {
    "joint_range": "width",
    "joint_pos": "q",
    "flow": "course",
    "flow_error": "course_error",
    "flow_loss": "course_loss",
    "axis_loss": "hinge_loss",
    "position_loss": "move_loss",
    "euler_loss": "turn_loss",
}
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
    env=EnvConfig(num_envs=16),
    physics=PhysicsConfig(steps_per_waypoint=50),
    explore=ExplorationConfig(
        td3=TD3Config(hidden=32, batch_size=32, buffer_size=1000, grad_steps_per_iter=4),
        iterations=4,
        start_pool_size=32,
        warmup_iters=2,
    ),
    perception=PerceptionConfig(
        networks=NetworksConfig(
            encoder=PointNet2Config(
                64,
                (SetAbstraction(16, 0.3, 4, (16,)), SetAbstraction(4, 0.8, 4, (16,))),
                ((16,), (16,)),
                16,
                (LocalGroup(0.15, 8, (8,)),),
                (8,),
            ),
            flow_hidden=(16,),
            predict_axis=True,
            gripper_patch_hidden=(8,),
            trajectory_hidden=(16,),
            posterior_hidden=(16,),
            decoder_hidden=(16,),
            scorer_hidden=(16,),
            actionability_hidden=(16,),
            latent_dim=8,
            contact_dim=8,
            task_dim=8,
        ),
        views_per_batch=2,
        samples_per_view=4,
        actionability_queries=2,
        num_proposals=4,
        top_k=2,
        log_every=3,
    ),
    schedule=Schedule(
        buffer_size=512,
        collect_batches=2,
        flow_steps=3,
        scorer_steps=3,
        proposal_steps=3,
        actionability_steps=3,
        curiosity_rounds=1,
        curiosity_iterations=1,
        curiosity_steps=3,
        finetune_rounds=1,
        finetune_batches=1,
        finetune_steps=3,
    ),
    evaluation=EvaluationConfig(trials=24, num_proposals=4, num_augmentations=2),
)
# As preset `paper` has it, and quick to compile: nothing local, Adam.
_DRAWER = replace(
    _DOOR,
    perception=replace(
        _DOOR.perception,
        muon=False,
        networks=replace(
            _DOOR.perception.networks,
            gripper_patch_hidden=(),
            encoder=replace(_DOOR.perception.networks.encoder, local_groups=(), global_context=()),
        ),
    ),
)


def convert_generated(folder: Path) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Arrays of the Scenes and of the views of five generated objects with doors and drawers, by golden name."""
    generate(folder / "objects", 5, seed=0)
    config = ConvertConfig(view=ViewConfig(views=1, points=512, contacts=32))
    convert([folder / "objects"], folder / "converted", config, jobs=2)
    banks = SceneBank.load(folder / "converted" / "scenes.npz"), ViewBank.load(folder / "converted" / "views.npz")
    scenes, views = ({f.name: np.asarray(getattr(bank, f.name)) for f in fields(bank)} for bank in banks)
    scenes.pop("part_kind")  # new in format 2
    views = {("opening" if name == "direction" else name): array for name, array in views.items()}
    views["opening"] = views["opening"] > 0
    return _golden(scenes), _golden(views)


def tiny_run(banks: tuple[SceneBank, ViewBank], task: str, folder: Path) -> list[dict[str, float | str]]:
    """What a tiny run logs, in order: stage, step and metrics, without seconds. banks: Scenes and their views."""
    for bank, name in zip(banks, ("scenes", "views"), strict=True):
        bank.save(folder / f"{name}.npz")
    settings = _DOOR if task.endswith("door") else _DRAWER
    env = split_environments(Data(folder), get_task(task), "c", settings)[0]["train"]
    with RunDir(folder / "run", {"task": task}) as run:
        PipelineTrainer(run, env, settings, seed=0).train()
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
