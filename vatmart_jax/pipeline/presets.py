"""The presets quick, cpu, gpu and paper: settings by name. They share one code path."""

from __future__ import annotations

from dataclasses import replace

import jax

from vatmart_jax.envs import EnvConfig
from vatmart_jax.perception.config import AugmentationConfig, NetworksConfig, PerceptionConfig
from vatmart_jax.perception.pointnet2 import SMALL
from vatmart_jax.pipeline.exploration import ExplorationConfig
from vatmart_jax.pipeline.settings import EvaluationConfig, Schedule, Settings
from vatmart_jax.rl.td3 import TD3Config

# Two cores: small encoders, and few actionability queries of few proposals where the paper has the mean of the best 5
# of 100.
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
    # The paper's numbers where it gives them (appendix A, B); docs/paper_vs_this.md has what differs.
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
