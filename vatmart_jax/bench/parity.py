"""How far the physics implementations agree, in the same trials."""

from __future__ import annotations

import os
import time
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from vatmart_jax.bench.common import NOISE, SceneSubset, device, fraction, noisy_scripted_trials
from vatmart_jax.data.banks import SceneBank, ViewBank
from vatmart_jax.envs import TASKS, EnvState, make_env
from vatmart_jax.errors import UserError
from vatmart_jax.physics import BACKENDS
from vatmart_jax.pipeline.exploration import start_pool
from vatmart_jax.reporting import NullReporter, Reporter


def bench_parity(
    subset: SceneSubset,
    impls: tuple[str, ...],
    *,
    trials: int,
    seed: int,
    other: Path | None = None,
    reporter: Reporter | None = None,
) -> dict[str, Any]:
    """The same random trials (`trials` per task, open loop) on several implementations, each against the first.

    What is compared is how far the part moved and whether that is a success, over starts that are valid on the first.
    With `other`, another conversion of the same objects (boxes for hulls), the first implementation runs on that too.
    """
    reporter = reporter or NullReporter()
    for impl in impls:
        BACKENDS.require(impl)
    bank, views = subset.banks(seed)
    variants = {impl: (impl, bank) for impl in impls}
    if other is not None:
        bank, views, counterpart = _common(bank, views, SceneBank.load(other / "scenes.npz"), other)
        variants = {impl: (impl, bank) for impl in impls}
        variants[f"{impls[0]} on {counterpart.collision}"] = (impls[0], counterpart)
    outcomes: dict[str, dict[str, EnvState]] = {}  # by task and variant
    for name, task in TASKS.items():
        if not (bank.part_kind == task.part_kind).any():
            reporter.info(f"{name}: no Scene")
            continue
        outcomes[name] = {}
        for variant, (impl, its_bank) in variants.items():
            begun = time.perf_counter()
            env = make_env(its_bank, views, task, impl)
            if not outcomes[name]:
                k_start, k_noise = jax.random.split(jax.random.key(seed))
                start = start_pool(env, k_start, trials)
                residuals = jax.jit(partial(noisy_scripted_trials, env))(start, k_noise).residuals
            outcomes[name][variant] = jax.device_get(jax.jit(env.execute)(start, residuals))
            reporter.info(f"{name} on {variant}: {time.perf_counter() - begun:.0f} s")
    if not outcomes:
        raise UserError(f"{subset.data}: no doors, drawers or lids")
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
                "success": fraction(by[first].success),
                "moved": round(float(np.mean(np.abs(by[first].displacement) > 0.02)), 3),
                **{v: _agreement(_outcome(by[first]), _outcome(by[v])) for v in rest},
            }
            for name, by in outcomes.items()
        },
        "noise": NOISE,
        "split": subset.split,
        "seed": seed,
        "device": device(),
        "load": round(os.getloadavg()[0], 1),
    }


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
    counterparts = np.array([row[identities[0][i]] for i in kept])
    return bank.select(kept), views.of_scenes(kept), other.select(counterparts)
