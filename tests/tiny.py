"""Settings of a run that takes seconds, and such runs: the same code path as every preset."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from vatmart_jax.data.dataset import Data
from vatmart_jax.envs import EnvConfig
from vatmart_jax.perception.networks import NetworksConfig
from vatmart_jax.perception.pointnet2 import PointNet2Config, SetAbstraction
from vatmart_jax.perception.trainer import PerceptionConfig
from vatmart_jax.physics import PhysicsConfig
from vatmart_jax.pipeline.exploration import ExplorationConfig
from vatmart_jax.pipeline.run_config import DataSource, RunConfig
from vatmart_jax.pipeline.settings import EvaluationConfig, Schedule, Settings
from vatmart_jax.reporting import Reporter
from vatmart_jax.rl.td3 import TD3Config
from vatmart_jax.workflows.train import train

TINY = Settings(
    env=EnvConfig(num_envs=16),
    physics=PhysicsConfig(steps_per_waypoint=50),
    explore=ExplorationConfig(
        td3=TD3Config(hidden=32, batch_size=32, buffer_size=1000, grad_steps_per_iter=4),
        iterations=4,
        start_pool_size=32,
    ),
    perception=PerceptionConfig(
        networks=NetworksConfig(
            encoder=PointNet2Config(
                64, (SetAbstraction(16, 0.3, 4, (16,)), SetAbstraction(4, 0.8, 4, (16,))), ((16,), (16,)), 16
            ),
            flow_hidden=(16,),
            predict_axis=True,
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
        scorer_steps=6,
        proposal_steps=6,
        actionability_steps=3,
        curiosity_rounds=2,
        curiosity_iterations=1,
        curiosity_steps=3,
        finetune_rounds=1,
        finetune_batches=1,
        finetune_steps=3,
    ),
    evaluation=EvaluationConfig(trials=24, num_proposals=4, num_augmentations=2),
)


def run_config(folder: Path, task: str = "push-drawer", seed: int = 0, settings: Settings = TINY) -> RunConfig:
    """Of a run on a converted folder."""
    return RunConfig(task=task, data=DataSource.of(folder), preset="quick", impl="c", seed=seed, settings=settings)


def run_tiny(folder: Path, out: Path, reporter: Reporter | None = None, **changes: Any) -> dict[str, Any]:
    """Train a run on a converted folder; changes: of `run_config`. Returns result.json's content."""
    return train(run_config(folder, **changes), Data(folder), out, reporter)[0]
