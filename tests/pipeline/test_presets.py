"""Every preset takes the views that conversion makes, and its stages run one step each, in small."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tiny import TINY

from conversion.config import ConvertConfig
from vatmart_jax.envs import TASKS, make_env
from vatmart_jax.perception.grouped_views import network_points
from vatmart_jax.pipeline.presets import PRESETS
from vatmart_jax.pipeline.run_dir import RunDir, read_metrics
from vatmart_jax.pipeline.settings import Schedule, Settings
from vatmart_jax.pipeline.trainer import PipelineTrainer

pytestmark = pytest.mark.usefixtures("quick_to_compile")


def shrunk(settings: Settings) -> Settings:
    """One unit of each stage with the preset's own switches, and sizes of a toy."""
    tiny, networks = TINY.perception, TINY.perception.networks
    perception = replace(
        settings.perception,
        networks=replace(
            networks,
            flow_hidden=networks.flow_hidden if settings.perception.networks.flow_hidden else (),
            predict_axis=settings.perception.networks.predict_axis,
            separate_encoders=settings.perception.networks.separate_encoders,
            absolute_waypoints=settings.perception.networks.absolute_waypoints,
        ),
        **{name: getattr(tiny, name) for name in ("views_per_batch", "samples_per_view", "num_proposals", "top_k")},
        actionability_queries=2,
        log_every=1,
    )
    explore = replace(settings.explore, td3=TINY.explore.td3, iterations=1, start_pool_size=32)
    schedule = Schedule(
        buffer_size=256, collect_batches=1, flow_steps=1, scorer_steps=1, proposal_steps=1, actionability_steps=1,
        curiosity_rounds=1, curiosity_iterations=1, curiosity_steps=1, finetune_rounds=1, finetune_batches=1,
        finetune_steps=1,
    )  # fmt: skip
    return replace(
        settings, env=TINY.env, physics=TINY.physics, explore=explore, perception=perception, schedule=schedule
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gpu", "paper"])  # golden runs and the demo have the switches of the others
def test_large_presets_do_one_unit_of_each_stage(cabinets, tmp_path, name):
    settings = shrunk(PRESETS[name])
    env = make_env(*cabinets, TASKS["push-drawer"], "c", settings.env, settings.physics)
    with RunDir(tmp_path / "run", {}) as run:
        PipelineTrainer(run, env, settings, seed=0).train()
    rows = read_metrics(tmp_path / "run")
    stages = [s for s in settings.schedule.stages if s != "flow" or settings.perception.networks.flow_hidden]
    assert [row["stage"] for row in rows] == stages
    assert all(np.isfinite(row["loss"]) for row in rows if "loss" in row)


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_takes_the_views_of_a_default_conversion(cabinets, name):
    points = np.zeros((len(cabinets[1]), ConvertConfig().view.points, 3), np.float16)
    encoder = PRESETS[name].perception.networks.encoder
    assert network_points(replace(cabinets[1], points=points), encoder).shape[1] == encoder.n_points
