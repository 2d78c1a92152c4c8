"""Batched trials: tasks, starts, rewards, observations."""

from vatmart_jax.envs.env import Env
from vatmart_jax.envs.make import make_env, make_envs
from vatmart_jax.envs.rewards import RewardConfig
from vatmart_jax.envs.task import TASKS, Task, get_task, register_task
from vatmart_jax.envs.types import EnvConfig, EnvState, TrialStart

__all__ = [
    "TASKS",
    "Env",
    "EnvConfig",
    "EnvState",
    "RewardConfig",
    "Task",
    "TrialStart",
    "get_task",
    "make_env",
    "make_envs",
    "register_task",
]
