"""What version 0.1 called the settings of a run (format 1)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple, is_dataclass
from typing import Any

from vatmart_jax.perception import format_1 as perception_format_1
from vatmart_jax.perception.format_1 import renamed
from vatmart_jax.physics.gripper import GRIPPERS

_ENV = {
    "batch": "num_envs", "move_range": "max_translation", "turn_range": "max_rotation",
    "turn_limit": "max_total_rotation", "cone": "approach_cone", "guided_share": "guided_fraction",
    "grasp_cone": "grasp_approach_cone",
}  # fmt: skip
_PHYSICS = {"move_share": "ramp_fraction"}
_OF_THE_GRIPPER = (
    "hand_mass", "hand_inertia", "hand_armature", "slide_gains", "hinge_gains", "finger_gains", "finger_mass",
    "finger_inertia", "finger_armature",
)  # fmt: skip
_EXPLORE = {
    "pool": "start_pool_size", "random": "random_action_prob", "warmup": "warmup_iters", "strain": "tracking_penalty",
}  # fmt: skip
_TD3 = {
    "batch": "batch_size", "polyak": "tau", "saturation": "pre_tanh_l2", "capacity": "buffer_size",
    "updates": "grad_steps_per_iter",
}  # fmt: skip
_PERCEPTION = {
    "views": "views_per_batch", "queries": "samples_per_view", "probes": "actionability_queries",
    "proposals": "num_proposals", "best": "top_k", "proposed": "proposal_fraction", "hindsight": "relabel_fraction",
    "shifted": "negative_fraction", "encoder_rate": "encoder_lr_scale", "move_weight": "position_weight",
    "turn_weight": "euler_weight", "kl_free": "free_bits", "course_weight": "flow_weight",
    "course_noise": "flow_noise", "steps_per_call": "log_every",
}  # fmt: skip
_FROM_THE_TASK = ("low", "high", "tolerance", "shift", "task_is_length")  # which overwrote them
_SCHEDULE = {
    "samples": "buffer_size", "late_share": "late_fraction", "collect": "collect_batches",
    "collect_expert": "collect_scripted_fraction", "course": "flow_steps", "scorer": "scorer_steps",
    "proposal": "proposal_steps", "actionability": "actionability_steps", "curiosity": "curiosity_rounds",
    "finetune": "finetune_rounds", "finetune_rate": "finetune_learning_rate",
}  # fmt: skip
_EVALUATION = {"proposals": "num_proposals", "copies": "num_augmentations"}


def settings(value: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of format 1, as JSON has them, in format 2. Raises ValueError for a hand other than the Panda's."""
    explore = renamed(value["explore"], _EXPLORE)
    perception = {k: v for k, v in value["perception"].items() if k not in _FROM_THE_TASK}
    perception["networks"] = perception_format_1.networks_config(perception["networks"])
    return {
        "env": renamed(value["env"], _ENV),
        "physics": _physics(value["physics"]),
        "explore": explore | {"td3": renamed(explore["td3"], _TD3)},
        "perception": perception_format_1.grouped_augmentation(renamed(perception, _PERCEPTION)),
        "schedule": renamed(value["schedule"], _SCHEDULE),
        "evaluation": renamed(value["evaluation"], _EVALUATION),
    }


def _physics(value: Mapping[str, Any]) -> dict[str, Any]:
    """The hand's fields are the gripper's now, which has no other values of them."""
    panda = GRIPPERS.get("panda")
    for name in _OF_THE_GRIPPER:
        own = getattr(panda, name)
        own = list(astuple(own)) if is_dataclass(own) and not isinstance(own, type) else own
        if value.get(name, own) != own:
            raise ValueError(f"physics.{name}: the gripper panda has {own}, found {value[name]}")
    return renamed({k: v for k, v in value.items() if k not in _OF_THE_GRIPPER}, _PHYSICS)
