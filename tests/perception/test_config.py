"""Every field of the configs reaches something: the initial parameters, a compiled step, or its arguments."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace
from typing import Any

import jax
import pytest
from leaves import perturbed, without_effect
from synthetic import SPEC, boxes, samples

from vatmart_jax.perception import trainer
from vatmart_jax.perception.config import NetworksConfig, PerceptionConfig, TaskSpec, for_task
from vatmart_jax.perception.heads import HEADS, TrajectoryHead
from vatmart_jax.perception.pointnet2 import LocalGroup, PointNet2Config, SetAbstraction

ENCODER = PointNet2Config(
    n_points=32,
    levels=(SetAbstraction(8, 0.4, 4, (4,)), SetAbstraction(4, 0.9, 4, (4,))),
    propagation=((4,), (4,)),
    feature_dim=4,
    local_groups=(LocalGroup(0.3, 4, (4,)),),
    global_context=(4, 4),
)
CONFIG = PerceptionConfig(
    networks=NetworksConfig(
        encoder=ENCODER, contact_dim=4, task_dim=4, trajectory_hidden=(4,), latent_dim=4, posterior_hidden=(4,),
        decoder_hidden=(4,), scorer_hidden=(4,), actionability_hidden=(4,), flow_hidden=(4,), predict_axis=True,
        gripper_patch_hidden=(4,),
    ),
    views_per_batch=2, samples_per_view=4, actionability_queries=2, num_proposals=4, top_k=2, muon=False, log_every=2,
)  # fmt: skip


@pytest.fixture
def extra_head() -> Iterator[None]:
    HEADS.register("extra", lambda networks: TrajectoryHead(networks, (4,)))
    yield
    HEADS.unregister("extra")


def shapes(tree: Any) -> list[Any]:
    return [(jax.tree_util.keystr(path), a.shape) for path, a in jax.tree_util.tree_leaves_with_path(tree)]


def observe(config: PerceptionConfig, spec: TaskSpec = SPEC) -> Iterator[Any]:
    """From cheap to dear: parameters, the arguments that a run passes to its steps, the steps' programs."""
    state = jax.eval_shape(lambda: trainer.init_state(jax.random.key(0), config))
    yield shapes(state.params)
    grouped_views, normals = boxes(0, 3, config.networks.encoder, contacts=8)
    grouped_views = grouped_views.replace(joints=(grouped_views.contacts[:, 0], grouped_views.contacts[:, 1]))
    data = samples(1, grouped_views, normals, 20)
    yield shapes(grouped_views)
    calls: list[tuple[Any, Any]] = []

    def record(*args: Any, **static: Any) -> Any:
        calls.append((args, static))
        return args[0], {}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trainer, "_compiled_steps", lambda: record)
        patch.setattr(trainer, "_init_optimizer", lambda *_: None)
        concrete = trainer.PerceptionState(
            params={}, optimizer=None, step=jax.numpy.int32(0), key=jax.random.key_data(jax.random.key(0))
        )
        trainer.train(concrete, grouped_views, data, config, spec, stage="scorer", steps=5)
    yield [jax.tree.map(float, vars(args[4])) for args, _ in calls]
    yield jax.tree.map(lambda a: a.tolist(), grouped_views.prepared)
    for stage in ("joint", "proposal"):
        args, static = calls[0]
        program = lambda *args, stage=stage, static=static: trainer.train_steps(*args, **(static | {"stage": stage}))
        yield str(jax.make_jaxpr(program)(state, *args[1:]))


@pytest.mark.slow
def test_every_field_of_the_configs_has_an_effect(extra_head) -> None:
    networks = CONFIG.networks
    own = lambda **changes: replace(CONFIG, networks=replace(networks, **changes))
    special = {
        ".networks.separate_encoders": own(separate_encoders=True, flow_hidden=(), predict_axis=False),
        ".networks.extra_heads": own(extra_heads=("extra",)),
    }
    assert without_effect(CONFIG, observe, special) == []


def test_every_field_of_the_task_has_an_effect() -> None:
    programs = []
    for spec in (SPEC, *(changed() for _, changed in perturbed(SPEC))):
        *_, joint, _ = observe(replace(CONFIG, networks=for_task(CONFIG.networks, slides=True)), spec)
        programs.append(joint)
    assert len(set(programs)) == len(programs) > len(fields(TaskSpec))


def test_a_slide_has_no_axis_to_predict() -> None:
    assert not for_task(CONFIG.networks, slides=True).predict_axis
    assert for_task(CONFIG.networks, slides=False) == CONFIG.networks
