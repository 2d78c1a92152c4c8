"""A run compiles each of its programs once."""

from __future__ import annotations

import logging
from collections import Counter
from dataclasses import replace

import jax
import pytest
from tiny import TINY

from vatmart_jax.envs import TASKS, Env, make_env
from vatmart_jax.pipeline.run_dir import RunDir
from vatmart_jax.pipeline.trainer import PipelineTrainer

pytestmark = pytest.mark.usefixtures("quick_to_compile")

PERCEPTION_STAGES = 5  # one program each, of the same name and shapes


@pytest.fixture(scope="module")
def env(cabinets) -> Env:
    return make_env(*cabinets, TASKS["push-drawer"], "c", TINY.env, TINY.physics)


@pytest.mark.slow
def test_rounds_of_curiosity_share_one_program(env, tmp_path):
    """Its penalty is a Partial, whose static half jit compares by identity."""
    schedule = replace(TINY.schedule, stages=("explore", "curiosity"), curiosity_rounds=2, curiosity_steps=0)
    settings = replace(TINY, schedule=schedule, explore=replace(TINY.explore, iterations=1))
    with RunDir(tmp_path / "run", {}) as run:
        trainer = PipelineTrainer(run, env, settings, seed=0)
        trainer.train()
    # One without the penalty, one with it.
    assert trainer.context.explorer.train_iteration._cache_size() == 2


@pytest.mark.slow
def test_no_program_of_a_whole_run_compiles_twice(env, tmp_path, caplog):
    with jax.log_compiles(), caplog.at_level(logging.WARNING), RunDir(tmp_path / "run", {}) as run:
        PipelineTrainer(run, env, TINY, seed=0).train()
    compiled = Counter(
        record.getMessage().split(". Argument mapping")[0]
        for record in caplog.records
        if record.getMessage().startswith("Compiling ")
    )
    assert compiled
    twice = {what: n for what, n in compiled.items() if n > (PERCEPTION_STAGES if "train_steps" in what else 1)}
    assert not twice
