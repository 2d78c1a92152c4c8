"""Settings of a training run: everything that a preset decides."""

from __future__ import annotations

from dataclasses import dataclass, field

from vatmart_jax.envs import EnvConfig
from vatmart_jax.perception.trainer import PerceptionConfig
from vatmart_jax.physics import PhysicsConfig
from vatmart_jax.pipeline.exploration import ExplorationConfig


@dataclass(frozen=True)
class Schedule:
    """Which stages a run has, and how much of every one after exploration. Steps are gradient steps of the perception
    networks."""

    stages: tuple[str, ...] = (
        "explore", "collect", "flow", "scorer", "proposal", "actionability", "curiosity", "finetune",
    )  # fmt: skip
    """in order; names in `pipeline.stages.STAGES`"""

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
    """for networks that predict articulation flow"""
    scorer_steps: int = 100
    proposal_steps: int = 600
    actionability_steps: int = 100
    curiosity_rounds: int = 3
    """rounds of curiosity: exploration with the penalty, then perception on what it found"""
    curiosity_iterations: int = 3
    curiosity_steps: int = 50
    curiosity_weight: float = 500.0
    """penalty for a successful trajectory whose predicted success probability is 1; the paper's 500"""
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
    """test-time augmentations of a view, see `TTAPredictor`; goes into the priors' config"""


@dataclass(frozen=True)
class Settings:
    """Everything that a preset decides."""

    env: EnvConfig = field(default_factory=EnvConfig)
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    explore: ExplorationConfig = field(default_factory=ExplorationConfig)
    perception: PerceptionConfig = field(default_factory=PerceptionConfig)
    schedule: Schedule = field(default_factory=Schedule)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
