"""What benchmarks share: which Scenes take part, trials that are alike everywhere, timing, the machine."""

from __future__ import annotations

import os
import platform
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from vatmart_jax.data.banks import SceneBank, ViewBank
from vatmart_jax.envs import Env, EnvState, TrialStart
from vatmart_jax.envs.scripted_policy import scripted_action
from vatmart_jax.errors import UserError
from vatmart_jax.trajectory import WAYPOINTS

NOISE = 0.3  # of the actions of noisy trials, beside the scripted policy's


@dataclass(frozen=True)
class SceneSubset:
    """Which part of a converted folder takes part."""

    data: Path
    split: str = "train"  # or "all"
    objects: int | None = None  # so many of the objects, drawn at random

    def banks(self, seed: int) -> tuple[SceneBank, ViewBank]:
        """Its Scenes and their views. Raises UserError where nothing is left."""
        bank, views = SceneBank.load(self.data / "scenes.npz"), ViewBank.load(self.data / "views.npz")
        chosen = (bank.split == self.split) | (self.split == "all")
        if not chosen.any():
            raise UserError(f"{self.data}: no object of the split {self.split}; `all` takes every one")
        if self.objects is not None:
            ids = np.random.default_rng(seed).permutation(np.unique(bank.object_id[chosen]))[: self.objects]
            chosen &= np.isin(bank.object_id, ids)
        scenes = np.flatnonzero(chosen)
        return bank.select(scenes), views.of_scenes(scenes)


def noisy_scripted_trials(env: Env, start: TrialStart, key: jax.Array) -> EnvState:
    """Trials of the scripted policy with noise on its actions. Consumes the key."""

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
class Timing:
    """Of repeated calls."""

    result: Any  # of the last call
    seconds: float  # per call, the median: others may use the machine
    compile_seconds: float  # what the first call took longer


def timed(call: Callable[[int], Any], seconds: float) -> Timing:
    """Calls call(0), call(1), ... for at least `seconds` and two calls, after a first one that compiles."""
    times, result = [], None
    while len(times) < 3 or sum(times[1:]) < seconds:
        begun = time.perf_counter()
        result = jax.block_until_ready(call(len(times)))
        times.append(time.perf_counter() - begun)
    per_call = float(np.median(times[1:]))
    return Timing(result, per_call, max(0.0, times[0] - per_call))


def fraction(flags: Any) -> float:
    """Of true ones, rounded."""
    return round(float(np.mean(flags)), 3)


def peak_memory() -> int:
    """Bytes: of the process on a CPU, else of the device."""
    if jax.default_backend() == "cpu":
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    peak = (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use", 0)
    if "warp" in sys.modules:
        import warp as wp

        peak += wp.get_mempool_used_mem_high(wp.device_from_jax(jax.devices()[0]))
    return peak
