"""An objective added in one file: a head that predicts how far the part moves, in a stage of its own and in `joint`."""

from __future__ import annotations

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import SPEC, boxes, samples

from vatmart_jax.errors import UserError
from vatmart_jax.perception.config import NetworksConfig, PerceptionConfig
from vatmart_jax.perception.heads import HEADS, TrajectoryHead
from vatmart_jax.perception.objectives import (
    OBJECTIVES,
    STAGES,
    LossContext,
    Metrics,
    Objective,
    TrainingStage,
    network_labels,
    stage_objectives,
)
from vatmart_jax.perception.pointnet2 import PointNet2Config, SetAbstraction
from vatmart_jax.perception.trainer import init_state, train

pytestmark = pytest.mark.usefixtures("quick_to_compile")


def displacement_loss(ctx: LossContext) -> tuple[jax.Array, Metrics]:
    """L1 between the predicted displacement and the observed one."""
    predicted = ctx.networks.extra(
        "displacement", ctx.params, ctx.sample_features, ctx.sample_contact, ctx.batch.goal,
        trajectory=ctx.batch.trajectory,
    )  # fmt: skip
    loss = jnp.abs(predicted[..., 0] - ctx.batch.displacement).mean()
    return 10 * loss, {"displacement_loss": loss}


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    HEADS.register("displacement", lambda networks: TrajectoryHead(networks, (16, 1)))
    OBJECTIVES.register(
        "displacement",
        Objective(
            name="displacement",
            networks=("displacement",),
            loss=displacement_loss,
            curves=("displacement_loss",),
            applies=lambda networks: "displacement" in networks.extra_heads,
        ),
    )
    STAGES.register("displacement", TrainingStage(objectives=("displacement",), encoder="full"))
    yield
    for registry in (HEADS, OBJECTIVES, STAGES):
        registry.unregister("displacement")


ENCODER = PointNet2Config(
    n_points=128, levels=(SetAbstraction(16, 0.4, 8, (16,)), SetAbstraction(4, 0.9, 4, (16,))), propagation=((16,),) * 2
)
SMALL = NetworksConfig(
    encoder=ENCODER, trajectory_hidden=(16,), latent_dim=4, posterior_hidden=(16,), decoder_hidden=(16,),
    scorer_hidden=(16,), actionability_hidden=(16,), extra_heads=("displacement",),
)  # fmt: skip
CONFIG = PerceptionConfig(
    networks=SMALL, views_per_batch=4, samples_per_view=16, actionability_queries=4, num_proposals=8, log_every=20
)


def test_a_new_objective_trains_its_head_and_nothing_else() -> None:
    grouped_views, normals = boxes(0, 12, ENCODER)
    data, errors = samples(1, grouped_views, normals, 400), []
    fresh = init_state(jax.random.key(0), CONFIG)
    after = train(
        fresh, grouped_views, data, CONFIG, SPEC,
        stage="displacement", steps=60, on_metrics=lambda _, metrics: errors.append(metrics["displacement_loss"]),
    )  # fmt: skip
    assert np.isfinite(errors).all() and errors[-1] < 0.7 * errors[0]
    equal = lambda name: jax.tree.map(np.array_equal, fresh.params[name], after.params[name])
    changed = {name for name in fresh.params if not all(jax.tree.leaves(equal(name)))}
    assert changed == {"encoder", "displacement"}


def test_stage_joint_trains_it_too_where_the_networks_have_its_head() -> None:
    names = lambda networks: [objective.name for objective in stage_objectives(networks, "joint")]
    assert names(SMALL) == ["scorer", "proposal", "actionability", "displacement"]
    assert names(NetworksConfig()) == ["scorer", "proposal", "actionability"]
    assert network_labels(SMALL, "joint")["displacement"] == "full"


def test_other_parameters_begin_as_they_did_without_it() -> None:
    without = PerceptionConfig(networks=NetworksConfig(**(vars(SMALL) | {"extra_heads": ()})))
    a, b = (init_state(jax.random.key(0), config).params for config in (CONFIG, without))
    for name in b:
        jax.tree.map(np.testing.assert_array_equal, a[name], b[name])


def test_unknown_names_are_refused_with_the_known_ones() -> None:
    with pytest.raises(UserError, match="perception stage 'lid' is not known; use one of flow, scorer"):
        stage_objectives(SMALL, "lid")
