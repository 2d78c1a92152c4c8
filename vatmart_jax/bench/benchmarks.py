"""Benchmarks: how fast physics and networks are here, and how far the physics implementations agree.

Each returns what `vatmart bench` prints: sizes, seed and device stand beside the numbers, and compiling is told apart.
"""

from __future__ import annotations

import multiprocessing
import os
import platform
import resource
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vatmart_jax.data.banks import SceneBank, ViewBank
from vatmart_jax.envs import TASKS, Env, EnvConfig, EnvState, TrialStart, make_env
from vatmart_jax.envs.scripted_policy import scripted_action
from vatmart_jax.errors import UserError, require_one_of
from vatmart_jax.perception import trainer as perception
from vatmart_jax.perception.config import TaskSpec
from vatmart_jax.perception.grouped_views import group_views
from vatmart_jax.perception.networks import Networks
from vatmart_jax.physics import BACKENDS
from vatmart_jax.physics.controller import waypoint_controls
from vatmart_jax.pipeline.exploration import start_pool
from vatmart_jax.pipeline.presets import PRESETS
from vatmart_jax.trajectory import TRAJECTORY, WAYPOINTS

Say = Callable[[str], None]
NOISE = 0.3  # of the actions of random trials, beside the scripted expert's
APPROACH, ADVANCES = (0.1,), (0.05, 0.05, 0.05)  # waypoints of a steady push, unit lengths


@dataclass(frozen=True)
class Choice:
    """Which part of a converted folder takes part."""

    data: Path
    split: str = "train"  # or "all"
    objects: int | None = None  # so many of the objects, drawn at random

    def banks(self, seed: int) -> tuple[SceneBank, ViewBank]:
        """Raises UserError where nothing is left."""
        bank, views = SceneBank.load(self.data / "scenes.npz"), ViewBank.load(self.data / "views.npz")
        chosen = (bank.split == self.split) | (self.split == "all")
        if not chosen.any():
            raise UserError(f"{self.data}: no object of --split {self.split}; `all` takes every one")
        if self.objects is not None:
            ids = np.random.default_rng(seed).permutation(np.unique(bank.object_id[chosen]))[: self.objects]
            chosen &= np.isin(bank.object_id, ids)
        scenes = np.flatnonzero(chosen)
        return bank.select(scenes), views.of_scenes(scenes)


def bench_physics(
    choice: Choice, impl: str, batches: tuple[int, ...], task: str, seed: int, seconds: float
) -> dict[str, Any]:
    """Physics steps per second while the hand presses on, and whole trials per second: reset, four waypoints, label.

    Each measurement lasts at least `seconds`. Of several batch sizes each runs in a process of its own, for peaks of
    memory would add up; the result is the first one's, and all are its `runs`.
    """
    require_one_of("--task", task, TASKS)
    require_one_of("--impl", impl, BACKENDS.names())
    if min(batches) < 1:
        raise UserError(f"--batch {min(batches)}: a batch has one simulation or more")
    if len(batches) == 1:
        return _physics(choice, impl, batches[0], task, seed, seconds)
    runs = []
    for batch in batches:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            runs.append(pool.submit(_physics, choice, impl, batch, task, seed, seconds).result())
    return runs[0] | {"runs": runs}


def _physics(choice: Choice, impl: str, batch: int, task: str, seed: int, seconds: float) -> dict[str, Any]:
    begun = time.perf_counter()
    env = make_env(*choice.banks(seed), TASKS[task], impl, EnvConfig(num_envs=batch))
    build_seconds = time.perf_counter() - begun
    key, k_start, k_noise = jax.random.split(jax.random.key(seed), 3)
    start = start_pool(env, k_start, batch)
    press = jax.jit(partial(_press, env))
    touching = press(jax.jit(env.begin_trials)(start), jnp.array(APPROACH))
    pressing = _timed(lambda _: press(touching, jnp.array(ADVANCES)), seconds)

    residuals = jax.jit(partial(random_trials, env))(start, k_noise).residuals

    @jax.jit
    def trials(key: jax.Array) -> EnvState:
        # In another order every time: no simulation keeps its Scene, and who shares a thread changes.
        order = jax.random.permutation(key, batch)
        return env.execute(*jax.tree.map(lambda x: x[order], (start, residuals)))

    whole = _timed(lambda k: trials(jax.random.fold_in(key, k)), seconds)
    steps = batch * len(ADVANCES) * env.physics.config.steps_per_waypoint
    return {
        "impl": impl,
        "batch": batch,
        "scenes": len(env.bank),
        "scenes_in_batch": len(np.unique(whole.result.physics.scene)),
        "objects": len(np.unique(env.bank.object_id)),
        "split": choice.split,
        "collision": env.bank.collision,
        "task": task,
        "steps_per_second": round(steps / pressing.seconds),
        "trials_per_second": round(batch / whole.seconds, 1),
        "milliseconds_per_trial": round(1e3 * whole.seconds / batch, 3),
        "in_contact": _share(touching.physics.in_contact | pressing.result.physics.in_contact),
        "diverged": int(pressing.result.physics.diverged.sum() + whole.result.physics.diverged.sum()),
        "success": _share(whole.result.success),
        "peak_memory_mb": round(_peak_memory() / 2**20),
        "build_seconds": round(build_seconds, 2),
        "compile_seconds": round(pressing.compile_seconds + whole.compile_seconds, 2),
        "seed": seed,
        "device": device(),
        "load": round(os.getloadavg()[0], 1),
    }


def bench_parity(
    choice: Choice, impls: tuple[str, ...], trials: int, seed: int, twin: Path | None = None, say: Say = print
) -> dict[str, Any]:
    """The same random trials (`trials` per task, open loop) on several implementations, each against the first.

    What is compared is how far the part moved and whether that is a success, over starts that are valid on the first.
    With a twin, another conversion of the same objects (boxes for hulls), the first implementation runs on that too.
    """
    for impl in impls:
        require_one_of("--impls", impl, BACKENDS.names())
    bank, views = choice.banks(seed)
    variants = {impl: (impl, bank) for impl in impls}
    if twin is not None:
        bank, views, other = _common(bank, views, SceneBank.load(twin / "scenes.npz"), twin)
        variants = {impl: (impl, bank) for impl in impls} | {f"{impls[0]} on {other.collision}": (impls[0], other)}
    outcomes: dict[str, dict[str, EnvState]] = {}  # by task and variant
    for name, task in TASKS.items():
        if not (bank.part_kind == task.part_kind).any():
            say(f"{name}: no Scene")
            continue
        outcomes[name] = {}
        for variant, (impl, its_bank) in variants.items():
            begun = time.perf_counter()
            env = make_env(its_bank, views, task, impl)
            if not outcomes[name]:
                k_start, k_noise = jax.random.split(jax.random.key(seed))
                start = start_pool(env, k_start, trials)
                residuals = jax.jit(partial(random_trials, env))(start, k_noise).residuals
            outcomes[name][variant] = jax.device_get(jax.jit(env.execute)(start, residuals))
            say(f"{name} on {variant}: {time.perf_counter() - begun:.0f} s")
    if not outcomes:
        raise UserError(f"{choice.data}: no doors or drawers")
    first, *rest = variants
    whole = {
        variant: jax.tree.map(lambda *rows: np.concatenate(rows), *(_outcome(by[variant]) for by in outcomes.values()))
        for variant in variants
    }
    against = {variant: _agreement(whole[first], whole[variant]) for variant in rest}
    return {
        "impls": list(impls),
        "reference": first,
        "collision": bank.collision,
        "trials": len(whole[first]["moved"]),
        "scenes": len({(task[5:], s) for task, by in outcomes.items() for s in by[first].physics.scene.tolist()}),
        **{key: {v: against[v][key] for v in rest} for key in _agreement(whole[first], whole[first])},
        "diverged": {v: int(whole[v]["diverged"].sum()) for v in variants},
        "tasks": {
            name: {
                "trials": trials,
                "scenes": len(np.unique(by[first].physics.scene)),
                "success": _share(by[first].success),
                "moved": round(float(np.mean(np.abs(by[first].moved) > 0.02)), 3),
                **{v: _agreement(_outcome(by[first]), _outcome(by[v])) for v in rest},
            }
            for name, by in outcomes.items()
        },
        "noise": NOISE,
        "split": choice.split,
        "seed": seed,
        "device": device(),
        "load": round(os.getloadavg()[0], 1),
    }


def bench_perception(choice: Choice, preset: str, seed: int, seconds: float) -> dict[str, Any]:
    """Training steps per second of each stage, and how long one view of 10,000 points takes to group and to encode."""
    require_one_of("--preset", preset, PRESETS)
    config = replace(PRESETS[preset].perception, log_every=5)
    networks, encoder = Networks(config.networks), config.networks.encoder
    rng = np.random.default_rng(seed)
    _, views = choice.banks(seed)
    views = views.select(rng.permutation(len(views))[: 2 * config.views_per_batch])
    views = replace(views, points=_with_points(rng, views.points, max(10_000, encoder.n_points)))
    upright = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0]), (len(views), 3))
    grouped_views = group_views(views, encoder).replace(joints=(upright, jnp.zeros((len(views), 3))))
    spec = TaskSpec(goal_range=(0.1, 0.7), tolerance=0.15, relabel_range=0.45, slides=False)
    rows = 4 * config.views_per_batch * config.samples_per_view
    samples = perception.Interactions(
        view=jnp.asarray(rng.integers(0, len(views), rows), jnp.int32),
        contact=jnp.asarray(rng.integers(0, views.contacts.shape[1], rows), jnp.int32),
        goal=jnp.asarray(rng.uniform(*spec.goal_range, rows), jnp.float32),
        trajectory=jnp.asarray(rng.normal(size=(rows, TRAJECTORY)), jnp.float32),
        displacement=jnp.asarray(rng.uniform(*spec.goal_range, rows), jnp.float32),
        valid=jnp.ones(rows, bool),
        from_proposal=jnp.zeros(rows, bool),
    )
    state = perception.init_state(jax.random.key(seed), config)
    steps = partial(perception.train, state, grouped_views, samples, config, spec, steps=config.log_every)
    trained = [stage for stage in perception.STAGES.names() if stage != "flow" or config.networks.flow_hidden]
    stages = {stage: _timed(lambda _, stage=stage: steps(stage=stage), seconds) for stage in trained}

    points, queries = (jnp.asarray(x[0], jnp.float32) for x in (views.points[:, :10_000], views.contacts))
    point_groups = _timed(lambda _: _group(points, queries, encoder), seconds)
    encode = jax.jit(networks.features)
    encoding = _timed(lambda _: encode(state.params, points, point_groups.result), seconds)
    return {
        "preset": preset,
        "training_points": encoder.n_points,
        "views_per_step": config.views_per_batch,
        "samples_per_step": config.views_per_batch * config.samples_per_view,
        "parameters": sum(x.size for x in jax.tree.leaves(state.params)),
        "steps_per_second": {name: round(config.log_every / t.seconds, 3) for name, t in stages.items()},
        "encode_points": len(points),
        "group_seconds": round(point_groups.seconds, 4),
        "encode_seconds": round(encoding.seconds, 4),
        "compile_seconds": {name: round(t.compile_seconds, 1) for name, t in stages.items()},
        "peak_memory_mb": round(_peak_memory() / 2**20),
        "seed": seed,
        "device": device(),
        "load": round(os.getloadavg()[0], 1),
    }


def random_trials(env: Env, start: TrialStart, key: jax.Array) -> EnvState:
    """Trials of the scripted expert with noise on its actions. Consumes the key."""

    def step(state: EnvState, key: jax.Array) -> tuple[EnvState, None]:
        action = scripted_action(env, state)
        return env.step(state, action + NOISE * jax.random.normal(key, action.shape), terminate_on_failure=False), None

    return jax.lax.scan(step, env.begin_trials(start), jax.random.split(key, WAYPOINTS))[0]


def device() -> str:
    """What JAX runs on, as its maker calls it."""
    if jax.default_backend() != "cpu":
        return jax.devices()[0].device_kind
    info = Path("/proc/cpuinfo")
    rows = info.read_text().splitlines() if info.exists() else []
    names = [row.split(":", 1)[1].strip() for row in rows if row.startswith("model name")]
    return f"{names[0] if names else platform.machine()}, {os.cpu_count()} cores"


@dataclass(frozen=True)
class _Timing:
    result: Any  # of the last call
    seconds: float  # per call, the median: others may use the machine
    compile_seconds: float  # what the first call took longer


def _timed(call: Callable[[int], Any], seconds: float) -> _Timing:
    """Calls call(0), call(1), ... for at least `seconds` and two calls, after a first one that compiles."""
    times, result = [], None
    while len(times) < 3 or sum(times[1:]) < seconds:
        begun = time.perf_counter()
        result = jax.block_until_ready(call(len(times)))
        times.append(time.perf_counter() - begun)
    per_call = float(np.median(times[1:]))
    return _Timing(result, per_call, max(0.0, times[0] - per_call))


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


def _outcome(final: EnvState) -> dict[str, np.ndarray]:
    return {
        "moved": final.displacement,
        "success": final.success,
        "valid": final.valid,
        "diverged": final.physics.diverged,
    }  # pyright: ignore[reportReturnType]


def _agreement(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> dict[str, float]:
    difference = np.abs(a["moved"] - b["moved"])
    return {
        "median_abs_diff": float(np.median(difference)),
        "p95_abs_diff": float(np.percentile(difference, 95)),
        "label_agreement": round(float(np.mean(a["success"] == b["success"])), 4),
        "valid_agreement": round(float(np.mean(a["valid"] == b["valid"])), 4),
    }


def _common(bank: SceneBank, views: ViewBank, other: SceneBank, where: Path) -> tuple[SceneBank, ViewBank, SceneBank]:
    """The Scenes that both banks have, in the same order, and the first one's views of them."""
    identities = [
        list(zip(b.object_id.tolist(), b.part.tolist(), b.joint.tolist(), b.variant.tolist(), strict=True))
        for b in (bank, other)
    ]
    row = {identity: i for i, identity in enumerate(identities[1])}
    kept = np.array([i for i, identity in enumerate(identities[0]) if identity in row], int)
    if len(kept) == 0:
        raise UserError(f"{where}: no Scene is also in the other folder; convert the same objects twice")
    twins = np.array([row[identities[0][i]] for i in kept])
    return bank.select(kept), views.of_scenes(kept), other.select(twins)


def _with_points(rng: np.random.Generator, points: np.ndarray, n: int) -> np.ndarray:
    """Clouds [V, N, 3] with at least n points; what is missing is drawn near the points there are."""
    missing = max(0, n - points.shape[1])
    near = points[:, rng.integers(0, points.shape[1], missing)]
    return np.concatenate([points, (near + rng.normal(scale=2e-3, size=near.shape)).astype(points.dtype)], 1)


_group = jax.jit(lambda points, queries, config: config.build().prepare(points, queries), static_argnums=2)


def _share(flags: Any) -> float:
    return round(float(np.mean(flags)), 3)


def _peak_memory() -> int:
    """Bytes: of the process on a CPU, else of the device."""
    if jax.default_backend() == "cpu":
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    peak = (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use", 0)
    if "warp" in sys.modules:
        import warp as wp

        peak += wp.get_mempool_used_mem_high(wp.device_from_jax(jax.devices()[0]))
    return peak
