"""Every field of the configs reaches something: the initial parameters, a compiled step, or its arguments."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Any

import jax
import pytest
from synthetic import SPEC, boxes, samples

from vatmart_jax.perception import trainer
from vatmart_jax.perception.config import NetworksConfig, PerceptionConfig, TaskSpec, for_task
from vatmart_jax.perception.heads import HEADS, TrajectoryHead
from vatmart_jax.perception.pointnet2 import LocalGroup, PointNet2Config, SetAbstraction


def perturbed(value: Any) -> Iterator[tuple[str, Any]]:
    """Every leaf of nested dataclasses and tuples of them, by path, and the whole with that leaf changed."""
    if is_dataclass(value):
        for field in fields(value):
            for path, changed in perturbed(getattr(value, field.name)):
                yield f".{field.name}{path}", lambda c=changed, n=field.name: replace(value, **{n: c()})
    elif isinstance(value, tuple) and value and is_dataclass(value[0]):
        for i, item in enumerate(value):
            for path, changed in perturbed(item):
                yield f"[{i}]{path}", lambda c=changed, i=i: (*value[:i], c(), *value[i + 1 :])
    else:
        yield "", lambda: _other(value)


def _other(value: Any) -> Any:
    if isinstance(value, bool):
        return not value
    if isinstance(value, tuple):
        return tuple(_other(x) for x in value)
    return value + 1 if isinstance(value, int) else 0.5 * value + 0.01


def without_effect(config: Any, observe: Callable[[Any], Iterator[Any]], special: dict[str, Any]) -> list[str]:
    """Paths of the leaves whose change none of the observations shows. `special`: configs for leaves that cannot be
    changed alone."""
    before: list[Any] = []
    source = observe(config)
    silent = []
    for path, changed in perturbed(config):
        after = observe(special[path] if path in special else changed())
        for i, seen in enumerate(after):
            if i == len(before):
                before.append(next(source))
            if seen != before[i]:
                break
        else:
            silent.append(path)
    return silent


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
        patch.setattr(trainer, "train_steps", record)
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
    assert len(set(programs)) == len(programs) == 1 + len(fields(TaskSpec))


def test_a_slide_has_no_axis_to_predict() -> None:
    assert not for_task(CONFIG.networks, slides=True).predict_axis
    assert for_task(CONFIG.networks, slides=False) == CONFIG.networks
