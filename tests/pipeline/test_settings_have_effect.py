"""Every leaf of a run's settings reaches something: a program, a compiled model, or what a run passes on.

Nothing is simulated or trained: programs are traced, and what would be costly records how it is called.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jax.interpreters import partial_eval
from leaves import without_effect
from tiny import TINY

from vatmart_jax.data.banks import HINGE, SLIDE
from vatmart_jax.envs import Env, get_task, make_env
from vatmart_jax.perception.interaction_buffer import Interactions
from vatmart_jax.physics import PhysicsConfig, PhysicsState
from vatmart_jax.physics.controller import waypoint_controls
from vatmart_jax.physics.gripper import GRIPPERS
from vatmart_jax.physics.scene_model import scene_model
from vatmart_jax.pipeline import stages
from vatmart_jax.pipeline.exploration import ExplorationLoop
from vatmart_jax.pipeline.settings import Settings
from vatmart_jax.pipeline.train_state import TrainState
from vatmart_jax.pipeline.trainer import PipelineTrainer
from vatmart_jax.priors.priors import Priors
from vatmart_jax.reporting import NullReporter
from vatmart_jax.workflows import environments
from vatmart_jax.workflows import train as train_workflow

TASK = "pull-drawer"  # a pull reads what a push does, and what is of grasps
FOUND = 2  # trials of a recorded batch


class Frictionless:
    """A stand-in for physics whose programs are small: what is driven arrives."""

    def __init__(self, config: PhysicsConfig):
        self.config, self.gripper = config, GRIPPERS.get(config.gripper)

    def reset(self, scene: jax.Array, gripper_pose: jax.Array, qpos: jax.Array) -> PhysicsState:
        never = jnp.zeros(scene.shape, bool)
        return PhysicsState(
            scene=scene, gripper_pose=gripper_pose, qpos=qpos, qvel=jnp.zeros_like(qpos), in_contact=never,
            diverged=never, backend_state=jnp.zeros((*scene.shape, 0), jnp.uint32),
        )  # fmt: skip

    def rollout(self, state: PhysicsState, ctrl: jax.Array, active: jax.Array) -> PhysicsState:
        return state.replace(qpos=jnp.where(active[:, None], state.qpos.at[:, 1:].set(ctrl[:, -1]), state.qpos))


@pytest.fixture(scope="module")
def env(cabinets) -> Env:
    return replace(make_env(*cabinets, TASK, "c", TINY.env, TINY.physics), physics=Frictionless(TINY.physics))


def program(function: Callable, *args: Any) -> str:
    """The traced function, without what its results do not depend on."""
    closed = jax.make_jaxpr(function)(*args)
    return str(partial_eval.dce_jaxpr(closed.jaxpr, [True] * len(closed.out_avals))[0])


def shapes(tree: Any) -> list[Any]:
    return [(jax.tree_util.keystr(path), a.shape, a.dtype) for path, a in jax.tree_util.tree_leaves_with_path(tree)]


def of_the_environment(settings: Settings, env: Env) -> Iterator[Any]:
    own = replace(env, config=settings.env)
    trial = lambda key, action: own.step(own.reset(key), action)
    yield program(trial, jax.random.key(0), jnp.zeros((settings.env.num_envs, own.action_size)))


def of_the_physics(settings: Settings, env: Env, scenes: Any) -> Iterator[Any]:
    config = settings.physics
    for joint_type in (HINGE, SLIDE):
        bank = scenes.select(np.flatnonzero(scenes.joint_type == joint_type)[:1])
        model = scene_model(bank, 0, config)
        content = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, content)
        yield content.tobytes()
    here, there = jnp.zeros((1, env.physics.gripper.num_ctrl)), jnp.ones((1, env.physics.gripper.num_ctrl))
    yield waypoint_controls(here, there, config).tolist()


def of_exploration(settings: Settings, env: Env) -> Iterator[Any]:
    yield what_stages_ask_for(settings, env)
    loop = ExplorationLoop(env, settings.explore)
    state = jax.eval_shape(loop.init, jax.random.key(0))
    yield shapes(state)
    pool = jax.eval_shape(lambda key: env.sample(key, 8), jax.random.key(0))
    yield program(lambda state, pool: loop.train_iteration(state, pool, None), state, pool)


def of_the_schedule(settings: Settings, env: Env) -> Iterator[Any]:
    yield shapes(jax.eval_shape(trainer_of(settings, env).init_state))
    yield what_stages_ask_for(settings, env)


def of_the_evaluation(settings: Settings, env: Env) -> Iterator[Any]:
    trainer = trainer_of(settings, env)
    priors = Priors(train_workflow.priors_config(settings, env.task), {})
    yield priors.predictor.num_augmentations
    calls: list[Any] = []

    def record(split: str, context: Any, methods: Any, *, trials: int, **_: Any) -> list[Any]:
        calls.append((split, context.num_proposals, trials))
        return []

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train_workflow, "evaluate_split", record)
        state: Any = SimpleNamespace(seconds=np.zeros(len(trainer.stages) + 1))
        train_workflow._evaluate(trainer, state, priors, {"train": env, "test_shapes": env}, NullReporter())
    yield calls


def trainer_of(settings: Settings, env: Env) -> PipelineTrainer:
    run: Any = None
    return PipelineTrainer(run, env, settings, seed=0)


def what_stages_ask_for(settings: Settings, env: Env) -> list[Any]:
    """Every stage's units, one after the other, with calls to simulation and training recorded instead of made."""
    calls: list[Any] = []
    trainer = trainer_of(settings, env)
    context = trainer.context
    samples = Interactions.empty(FOUND)
    final: Any = SimpleNamespace(in_collision=jnp.zeros(FOUND), physics=SimpleNamespace(diverged=jnp.zeros(FOUND)))

    def start_pool(env: Env, key: Any, size: int, progress: Any) -> None:
        calls.append(("start_pool", size))

    def train_iteration(state: Any, pool: Any, curiosity: Any) -> tuple[Any, Any, dict]:
        calls.append(("train_iteration", None if curiosity is None else curiosity.args[-1]))
        return state, final, {}

    def rollout(policy: Any, pool: Any, key: Any, **options: Any) -> tuple[Any, None]:
        calls.append(("rollout", options))
        return final, None

    def train(state: Any, views: Any, samples: Any, config: Any, spec: Any, *, stage, steps, limit=None, on_metrics):
        calls.append(("train", stage, steps, limit, config, spec))
        on_metrics(0, {"step": 0, "loss": 0.0})
        return state

    def explore(params: Any, key: Any) -> tuple[Any, Interactions, np.ndarray]:
        calls.append(("explore",))
        return final, samples, np.ones(FOUND, bool)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stages, "start_pool", start_pool)
        patch.setattr(stages, "group_views", lambda *_: None)
        patch.setattr(stages, "interactions_of", lambda *_: samples)
        patch.setattr(stages, "score_trajectories", lambda *_, **__: jnp.zeros(FOUND))
        patch.setattr(stages, "ProposalTrials", lambda *_: SimpleNamespace(explore=explore))
        patch.setattr(stages.perception, "train", train)
        patch.setattr(context.explorer, "train_iteration", train_iteration)
        patch.setattr(context.explorer, "rollout", rollout)
        context.__dict__["views"] = None
        nothing: Any = SimpleNamespace(agent=SimpleNamespace(policy=None), params=None)
        state = TrainState(
            explore=nothing, perception=nothing, samples=Interactions.empty(settings.schedule.buffer_size),
            stored=jnp.int32(0), stage=jnp.int32(0), done=jnp.int32(0), seconds=jnp.zeros(1),
        )  # fmt: skip
        for stage in trainer.stages:
            for unit in range(stage.num_units(settings)):
                state, _ = stage.run_unit(context, state, unit)
                calls.append((stage.name, unit, int(state.stored)))
    return calls


ELSEWHERE = {"perception": "tests/perception/test_config.py has its leaves"}
OBSERVE = {
    "env": of_the_environment,
    "physics": of_the_physics,
    "explore": of_exploration,
    "schedule": of_the_schedule,
    "evaluation": of_the_evaluation,
}
SPECIAL = {
    "physics": {".gripper": replace(TINY.physics, gripper="robotiq_2f85")},
    "schedule": {".stages": replace(TINY.schedule, stages=TINY.schedule.stages[:-1])},
}


def test_every_part_of_the_settings_is_observed() -> None:
    assert {field.name for field in fields(Settings)} == {*OBSERVE, *ELSEWHERE}


@pytest.mark.parametrize("part", OBSERVE)
def test_every_leaf_of_the_settings_has_an_effect(part, env, cabinets) -> None:
    options = {"scenes": cabinets[0]} if part == "physics" else {}
    observe = lambda config: OBSERVE[part](replace(TINY, **{part: config}), env, **options)
    assert without_effect(getattr(TINY, part), observe, SPECIAL.get(part)) == []


def test_environments_are_made_with_the_configs_of_the_settings(monkeypatch) -> None:
    made: dict[str, Any] = {}
    monkeypatch.setattr(environments, "make_envs", lambda *_, **options: made.update(options) or {})
    data: Any = SimpleNamespace(splits=dict, scenes=None, views=None, folder="data")
    environments.split_environments(data, get_task(TASK), "c", TINY)
    assert (made["config"], made["physics"]) == (TINY.env, TINY.physics)


def test_a_run_explores_with_the_config_of_the_settings(env) -> None:
    trainer = trainer_of(TINY, env)
    assert trainer.context.explorer.config == TINY.explore
