"""Settings of a training run, and the presets: quick, cpu, gpu, paper. They share one code path."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import jax

from vatmart_jax.envs.env import EnvConfig
from vatmart_jax.perception.networks import NetworksConfig
from vatmart_jax.perception.pointnet2 import SMALL
from vatmart_jax.perception.trainer import PerceptionConfig
from vatmart_jax.physics import PhysicsConfig
from vatmart_jax.pipeline.exploration import ExploreConfig
from vatmart_jax.rl.td3 import TD3Config


@dataclass(frozen=True)
class Schedule:
    """How much of every stage after exploration. Steps are gradient steps of the perception networks."""

    samples: int = 65_536
    """capacity of the sample buffer; the oldest give way"""
    late_share: float = 0.5
    """exploration's trials from this share of its iterations on are samples too: policies of several ages"""
    collect: int = 32
    """batches of trials by the finished policy from random starts, failures included"""
    collect_noise: float = 0.05
    """of the actions then, share of their range"""
    collect_expert: float = 0.25
    """share of these trials that the scripted expert makes, with the same noise"""
    course: int = 300
    """steps; for networks that have a course"""
    scorer: int = 100
    proposal: int = 600
    actionability: int = 100
    curiosity: int = 3
    """rounds of curiosity: exploration with the penalty, then perception on what it found"""
    curiosity_iterations: int = 3
    curiosity_steps: int = 50
    curiosity_weight: float = 500.0
    """penalty for a successful trajectory the scorer is sure of; the paper's 500"""
    finetune: int = 4
    """rounds of labelling the networks' own proposals in simulation and training on them jointly"""
    finetune_batches: int = 12
    finetune_steps: int = 400
    finetune_rate: float = 1e-3
    """learning rate of curiosity and finetune rounds"""


@dataclass(frozen=True)
class EvaluationConfig:
    """The evaluation at the end of a run."""

    trials: int = 350
    """per split, as in the paper"""
    proposals: int = 100
    copies: int = 8
    """of a view that the trained networks are asked about, see `Ensemble`; goes into the priors' config"""


@dataclass(frozen=True)
class Settings:
    """Everything that a preset decides."""

    env: EnvConfig = field(default_factory=EnvConfig)
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    explore: ExploreConfig = field(default_factory=ExploreConfig)
    perception: PerceptionConfig = field(default_factory=PerceptionConfig)
    schedule: Schedule = field(default_factory=Schedule)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)


# Two cores: small encoders, and few probes of few proposals where the paper has the mean of the best 5 of 100.
_ON_CPU = PerceptionConfig(
    networks=NetworksConfig(pointnet=SMALL, course=(128, 128), hinge=True, hand=(32, 64)),
    probes=4,
    proposals=32,
    best=2,
)

PRESETS = {
    "quick": Settings(explore=ExploreConfig(iterations=60, pool=2048), perception=_ON_CPU),
    "cpu": Settings(
        explore=ExploreConfig(iterations=100, pool=4096),
        perception=replace(
            _ON_CPU, networks=replace(_ON_CPU.networks, pointnet=replace(SMALL, context=(64, 128))), encoder_rate=0.25
        ),
        schedule=Schedule(
            samples=400_000, collect=128, course=4000, scorer=200, proposal=2000, actionability=200, finetune=8,
            finetune_batches=64, finetune_steps=1500, finetune_rate=4e-4,
        ),
    ),
    "gpu": Settings(
        env=EnvConfig(batch=4096),
        explore=ExploreConfig(iterations=300, pool=65536, td3=TD3Config(batch=1024, capacity=1_000_000)),
        perception=PerceptionConfig(networks=NetworksConfig(course=(128, 128), hinge=True), views=32),
        schedule=Schedule(
            samples=2_000_000, collect=100, course=3000, scorer=10_000, proposal=10_000, actionability=3000,
            curiosity=30, curiosity_steps=200, finetune=10, finetune_batches=20, finetune_steps=3000,
        ),
    ),
    # The paper's numbers where it gives them (appendix A, B): 5,000 episodes and 5,000 + 5,000 trajectories.
    "paper": Settings(
        env=EnvConfig(batch=64),
        explore=ExploreConfig(
            iterations=5000,
            td3=TD3Config(batch=512, learning_rate=1e-4, saturation=0.0, capacity=2048, policy_delay=3, updates=6),
            noise=(0.1, 0.1 / 2**10),
            strain=0.0,
        ),
        perception=PerceptionConfig(
            networks=NetworksConfig(separate=True, positions=False), views=8, queries=4, probes=4,
            mirror=False, yaw=0.0, scale=0.0, kl_free=0.0, learning_rate=1e-3, muon=False,
        ),
        schedule=Schedule(
            samples=20_000, collect=160, scorer=16_000, proposal=35_000, actionability=5000, curiosity=1500,
            curiosity_iterations=1, curiosity_steps=1, finetune=0,
        ),
        evaluation=EvaluationConfig(copies=1),
    ),
}  # fmt: skip


def default_preset(own_data: bool) -> str:
    """`quick` for the bundled objects; for one's own the best that this machine does: `gpu` on a GPU, else `cpu`."""
    if not own_data:
        return "quick"
    return "gpu" if jax.default_backend() == "gpu" else "cpu"
