"""Settings of a training run, and the presets: quick, cpu, gpu, paper. They share one code path."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import jax

from vatmart_jax.envs import EnvConfig
from vatmart_jax.perception.config import AugmentationConfig, NetworksConfig, PerceptionConfig
from vatmart_jax.perception.pointnet2 import SMALL
from vatmart_jax.physics import PhysicsConfig
from vatmart_jax.pipeline.exploration import ExplorationConfig
from vatmart_jax.rl.td3 import TD3Config


@dataclass(frozen=True)
class Schedule:
    """How much of every stage after exploration. Steps are gradient steps of the perception networks."""

    buffer_size: int = 65_536
    """capacity of the sample buffer; the oldest give way"""
    late_fraction: float = 0.5
    """exploration's trials from this share of its iterations on are samples too: policies of several ages"""
    collect_batches: int = 32
    """batches of trials by the finished policy from random starts, failures included"""
    collect_noise: float = 0.05
    """of the actions then, share of their range"""
    collect_scripted_fraction: float = 0.25
    """share of these trials that the scripted expert makes, with the same noise"""
    flow_steps: int = 300
    """steps; for networks that have a course"""
    scorer_steps: int = 100
    proposal_steps: int = 600
    actionability_steps: int = 100
    curiosity_rounds: int = 3
    """rounds of curiosity: exploration with the penalty, then perception on what it found"""
    curiosity_iterations: int = 3
    curiosity_steps: int = 50
    curiosity_weight: float = 500.0
    """penalty for a successful trajectory the scorer is sure of; the paper's 500"""
    finetune_rounds: int = 4
    """rounds of labelling the networks' own proposals in simulation and training on them jointly"""
    finetune_batches: int = 12
    finetune_steps: int = 400
    finetune_learning_rate: float = 1e-3
    """learning rate of curiosity and finetune rounds"""


@dataclass(frozen=True)
class EvaluationConfig:
    """The evaluation at the end of a run."""

    trials: int = 350
    """per split, as in the paper"""
    num_proposals: int = 100
    num_augmentations: int = 8
    """of a view that the trained networks are asked about, see `TTAPredictor`; goes into the priors' config"""


@dataclass(frozen=True)
class Settings:
    """Everything that a preset decides."""

    env: EnvConfig = field(default_factory=EnvConfig)
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    explore: ExplorationConfig = field(default_factory=ExplorationConfig)
    perception: PerceptionConfig = field(default_factory=PerceptionConfig)
    schedule: Schedule = field(default_factory=Schedule)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)


# Two cores: small encoders, and few probes of few proposals where the paper has the mean of the best 5 of 100.
_ON_CPU = PerceptionConfig(
    networks=NetworksConfig(encoder=SMALL, flow_hidden=(128, 128), predict_axis=True, gripper_patch_hidden=(32, 64)),
    actionability_queries=4,
    num_proposals=32,
    top_k=2,
)

PRESETS = {
    "quick": Settings(explore=ExplorationConfig(iterations=60, start_pool_size=2048), perception=_ON_CPU),
    "cpu": Settings(
        explore=ExplorationConfig(iterations=100, start_pool_size=4096),
        perception=replace(
            _ON_CPU,
            networks=replace(_ON_CPU.networks, encoder=replace(SMALL, global_context=(64, 128))),
            encoder_lr_scale=0.25,
        ),
        schedule=Schedule(
            buffer_size=400_000,
            collect_batches=128,
            flow_steps=4000,
            scorer_steps=200,
            proposal_steps=2000,
            actionability_steps=200,
            finetune_rounds=8,
            finetune_batches=64,
            finetune_steps=1500,
            finetune_learning_rate=4e-4,
        ),
    ),
    "gpu": Settings(
        env=EnvConfig(num_envs=4096),
        explore=ExplorationConfig(
            iterations=300, start_pool_size=65536, td3=TD3Config(batch_size=1024, buffer_size=1_000_000)
        ),
        perception=PerceptionConfig(
            networks=NetworksConfig(flow_hidden=(128, 128), predict_axis=True), views_per_batch=32
        ),
        schedule=Schedule(
            buffer_size=2_000_000,
            collect_batches=100,
            flow_steps=3000,
            scorer_steps=10_000,
            proposal_steps=10_000,
            actionability_steps=3000,
            curiosity_rounds=30,
            curiosity_steps=200,
            finetune_rounds=10,
            finetune_batches=20,
            finetune_steps=3000,
        ),
    ),
    # The paper's numbers where it gives them (appendix A, B): 5,000 episodes and 5,000 + 5,000 trajectories.
    "paper": Settings(
        env=EnvConfig(num_envs=64),
        explore=ExplorationConfig(
            iterations=5000,
            td3=TD3Config(
                batch_size=512,
                learning_rate=1e-4,
                pre_tanh_l2=0.0,
                buffer_size=2048,
                policy_delay=3,
                grad_steps_per_iter=6,
            ),
            noise=(0.1, 0.1 / 2**10),
            tracking_penalty=0.0,
        ),
        perception=PerceptionConfig(
            networks=NetworksConfig(separate_encoders=True, absolute_waypoints=False),
            views_per_batch=8,
            samples_per_view=4,
            actionability_queries=4,
            augmentation=AugmentationConfig(yaw=0.0, mirror=False, scale=0.0),
            free_bits=0.0,
            learning_rate=1e-3,
            muon=False,
        ),
        schedule=Schedule(
            buffer_size=20_000,
            collect_batches=160,
            scorer_steps=16_000,
            proposal_steps=35_000,
            actionability_steps=5000,
            curiosity_rounds=1500,
            curiosity_iterations=1,
            curiosity_steps=1,
            finetune_rounds=0,
        ),
        evaluation=EvaluationConfig(num_augmentations=1),
    ),
}


def default_preset(own_data: bool) -> str:
    """`quick` for the bundled objects; for one's own the best that this machine does: `gpu` on a GPU, else `cpu`."""
    if not own_data:
        return "quick"
    return "gpu" if jax.default_backend() == "gpu" else "cpu"
