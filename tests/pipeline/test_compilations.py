"""A run compiles each of its programs once."""

from __future__ import annotations

import logging
from collections import Counter
from dataclasses import replace

import jax
import jax.numpy as jnp
import pytest
from tiny import TINY, run_tiny

from vatmart_jax.envs import TASKS, Env, make_env
from vatmart_jax.pipeline.run_dir import RunDir
from vatmart_jax.pipeline.trainer import PipelineTrainer

pytestmark = pytest.mark.usefixtures("quick_to_compile")

PERCEPTION_STAGES = 5  # one program each, of the same name and shapes


@pytest.fixture(scope="module")
def env(cabinets) -> Env:
    return make_env(*cabinets, TASKS["push-drawer"], "c", TINY.env, TINY.physics)


@pytest.mark.slow
def test_exploration_and_rounds_of_curiosity_share_one_program(env, tmp_path):
    """Its penalty is a Partial, whose static half jit compares by identity."""
    schedule = replace(TINY.schedule, stages=("explore", "curiosity"), curiosity_rounds=2, curiosity_steps=0)
    settings = replace(TINY, schedule=schedule, explore=replace(TINY.explore, iterations=1))
    with RunDir(tmp_path / "run", {}) as run:
        trainer = PipelineTrainer(run, env, settings, seed=0)
        trainer.train()
    assert trainer.context.explorer.train_iteration._cache_size() == 1


def compilations(caplog) -> Counter[str]:
    """How often each program was compiled, by name and shapes."""
    return Counter(
        record.getMessage().split(". Argument mapping")[0]
        for record in caplog.records
        if record.getMessage().startswith("Compiling ")
    )


def twice(compiled: Counter[str]) -> dict[str, int]:
    return {what: n for what, n in compiled.items() if n > (PERCEPTION_STAGES if "train_steps" in what else 1)}


@pytest.mark.slow
def test_no_program_of_all_stages_compiles_twice(env, tmp_path, caplog):
    with jax.log_compiles(), caplog.at_level(logging.WARNING), RunDir(tmp_path / "run", {}) as run:
        PipelineTrainer(run, env, TINY, seed=0).train()
    compiled = compilations(caplog)
    assert compiled
    assert not twice(compiled)


@pytest.mark.slow
def test_no_program_of_a_whole_run_compiles_twice(cabinets, tmp_path, caplog):
    """From the first start to the table of both test splits, and the pictures."""
    for bank, name in zip(cabinets, ("scenes", "views"), strict=True):
        bank.save(tmp_path / f"{name}.npz")
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        result = run_tiny(tmp_path, tmp_path / "run")
    assert len(result["results"]) == 4
    ours = Counter({what: n for what, n in compilations(caplog).items() if not _is_single_operation(what)})
    assert any("train_steps" in what for what in ours) and any("_execute" in what for what in ours)
    assert not twice(ours)


def _is_single_operation(what: str) -> bool:
    """One of JAX's own, outside any program of ours: its log leaves out what is static, such as axes."""
    name = what.split("jit(")[1].split(")")[0]
    return hasattr(jnp, name) or hasattr(jax.lax, name) or name in ("_uniform", "_truncated_normal")
