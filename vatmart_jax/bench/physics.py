"""How fast physics is here: steps while the hand presses on, and whole trials."""

from __future__ import annotations

import multiprocessing
import os
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vatmart_jax.bench.common import SceneSubset, device, fraction, noisy_scripted_trials, peak_memory, timed
from vatmart_jax.envs import Env, EnvConfig, EnvState, get_task, make_env
from vatmart_jax.errors import require_positive
from vatmart_jax.physics import BACKENDS
from vatmart_jax.physics.controller import waypoint_controls
from vatmart_jax.pipeline.exploration import start_pool

APPROACH, ADVANCES = (0.1,), (0.05, 0.05, 0.05)  # waypoints of a steady push, unit lengths


def bench_physics(
    subset: SceneSubset, *, impl: str, batches: tuple[int, ...], task: str, seed: int, seconds: float
) -> dict[str, Any]:
    """Physics steps per second while the hand presses on, and whole trials per second: reset, four waypoints, label.

    Each measurement lasts at least `seconds`. Of several batch sizes each runs in a process of its own, for peaks of
    memory would add up; the result is the first one's, and all are its `runs`.
    """
    get_task(task)
    BACKENDS.require(impl)
    require_positive("batches", min(batches))
    if len(batches) == 1:
        return _physics(subset, impl, batches[0], task, seed, seconds)
    runs = []
    for batch in batches:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            runs.append(pool.submit(_physics, subset, impl, batch, task, seed, seconds).result())
    return runs[0] | {"runs": runs}


def _physics(subset: SceneSubset, impl: str, batch: int, task: str, seed: int, seconds: float) -> dict[str, Any]:
    begun = time.perf_counter()
    env = make_env(*subset.banks(seed), task, impl, EnvConfig(num_envs=batch))
    build_seconds = time.perf_counter() - begun
    key, k_start, k_noise = jax.random.split(jax.random.key(seed), 3)
    start = start_pool(env, k_start, batch)
    press = jax.jit(partial(_press, env))
    touching = press(jax.jit(env.begin_trials)(start), jnp.array(APPROACH))
    pressing = timed(lambda _: press(touching, jnp.array(ADVANCES)), seconds)

    residuals = jax.jit(partial(noisy_scripted_trials, env))(start, k_noise).residuals

    @jax.jit
    def trials(key: jax.Array) -> EnvState:
        # In another order every time: no simulation keeps its Scene, and who shares a thread changes.
        order = jax.random.permutation(key, batch)
        return env.execute(*jax.tree.map(lambda x: x[order], (start, residuals)))

    whole = timed(lambda k: trials(jax.random.fold_in(key, k)), seconds)
    steps = batch * len(ADVANCES) * env.physics.config.steps_per_waypoint
    return {
        "impl": impl,
        "batch": batch,
        "scenes": len(env.bank),
        "scenes_in_batch": len(np.unique(whole.result.physics.scene)),
        "objects": len(np.unique(env.bank.object_id)),
        "split": subset.split,
        "collision": env.bank.collision,
        "task": task,
        "steps_per_second": round(steps / pressing.seconds),
        "trials_per_second": round(batch / whole.seconds, 1),
        "milliseconds_per_trial": round(1e3 * whole.seconds / batch, 3),
        "in_contact": fraction(touching.physics.in_contact | pressing.result.physics.in_contact),
        "diverged": int(pressing.result.physics.diverged.sum() + whole.result.physics.diverged.sum()),
        "success": fraction(whole.result.success),
        "peak_memory_mb": round(peak_memory() / 2**20),
        "build_seconds": round(build_seconds, 2),
        "compile_seconds": round(pressing.compile_seconds + whole.compile_seconds, 2),
        "seed": seed,
        "device": device(),
        "load": round(os.getloadavg()[0], 1),
    }


def _press(env: Env, state: EnvState, advances: jax.Array) -> EnvState:
    """Waypoints along the hand's approach (back, when pulling), one per number of `advances`; none is left out."""
    forward = (-1.0 if env.task.grasps else 1.0) * state.start.rotation[:, :, 2]

    def waypoint(state: EnvState, advance: jax.Array) -> tuple[EnvState, None]:
        tip = state.tip + advance * forward
        target = env.physics.gripper.targets(tip, state.euler, state.start.rotation, jnp.zeros(len(tip)))
        path = waypoint_controls(state.ctrl, target, env.physics.config)
        physics = env.physics.rollout(state.physics, path, ~state.physics.diverged)
        return state.replace(physics=physics, ctrl=target, tip=tip), None

    return jax.lax.scan(waypoint, state, advances)[0]
