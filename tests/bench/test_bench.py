import json
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from boxes import as_boxes

from vatmart_jax import bench, cli, presets
from vatmart_jax.data.banks import HINGE
from vatmart_jax.envs import make_env
from vatmart_jax.perception.networks import NetworksConfig
from vatmart_jax.perception.pointnet2 import PointNet2Config, SetAbstraction
from vatmart_jax.pipeline.exploration import start_pool

TINY = PointNet2Config(
    n_points=64,
    levels=(SetAbstraction(16, 0.3, 8, (16, 16)), SetAbstraction(4, 0.8, 8, (16, 16))),
    propagation=((16,), (16,)),
    feature_dim=16,
)


@pytest.fixture(scope="module")
def data(cabinets, tmp_path_factory) -> tuple[Path, Path]:
    """The cabinets' doors as a folder of hulls and one of boxes, all in the train split; boxes in another order."""
    bank, views = cabinets
    doors = np.flatnonzero(bank.joint_type == HINGE)
    bank, views = bank.select(doors), views.of_scenes(doors)
    bank = replace(bank, split=np.full(len(bank), "train"))
    hulls, boxes = tmp_path_factory.mktemp("hulls"), tmp_path_factory.mktemp("boxes")
    bank.save(hulls / "scenes.npz")
    views.save(hulls / "views.npz")
    order = np.arange(len(bank))[::-1]
    as_boxes(bank).select(order).save(boxes / "scenes.npz")
    views.of_scenes(order).save(boxes / "views.npz")
    return hulls, boxes


def run(capsys, *args: str) -> dict:
    cli.main(["bench", *args, "--json"])
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def test_physics_reports_rates_sizes_and_where_for_every_batch_size(data, capsys, tmp_path):
    out = tmp_path / "result.json"
    args = ("--data", str(data[0]), "--batch", "4,8", "--seconds", "0.1", "--objects", "2", "--seed", "3")
    result = run(capsys, "physics", *args, "--out", str(out))
    assert [r["batch"] for r in result["runs"]] == [4, 8]
    assert {k: v for k, v in result.items() if k != "runs"} == result["runs"][0]
    assert {k: result[k] for k in ("impl", "batch", "scenes", "objects", "collision", "task", "seed")} == {
        "impl": "c", "batch": 4, "scenes": 2, "objects": 2, "collision": "hull", "task": "push-door", "seed": 3
    }  # fmt: skip
    for one in result["runs"]:
        assert one["steps_per_second"] > 1000 and one["trials_per_second"] > 1
        assert 100 < one["peak_memory_mb"] < 20_000 and one["diverged"] == 0 and one["device"]
    assert json.loads(out.read_text()) == result


def test_boxes_behave_nearly_as_the_hulls_they_were_whatever_the_order_of_scenes(data, capsys):
    result = run(capsys, "parity", "--impls", "c", "--trials", "8", "--data", *map(str, data))
    assert result["trials"] == 16 and result["scenes"] == 3 and set(result["tasks"]) == {"push-door", "pull-door"}
    assert result["median_abs_diff"]["c on box"] < 1e-3
    assert result["label_agreement"]["c on box"] > 0.9
    assert result["valid_agreement"]["c on box"] > 0.9
    assert all(task["moved"] > 0.5 for task in result["tasks"].values())


def test_random_trials_repeat_exactly_open_loop(cabinets):
    env = make_env(*cabinets, "push-drawer")
    key = jax.random.key(0)
    start = start_pool(env, key, 16)
    closed = jax.jit(lambda start: bench.random_trials(env, start, key))(start)
    # Until they succeed: a trial stops there, its trajectory stays.
    again = jax.jit(env.execute)(start, closed.residuals)
    assert again.valid.all() and (np.abs(again.displacement) > 0.05).mean() > 0.5
    unfinished = ~np.asarray(closed.success)
    np.testing.assert_allclose(again.displacement[unfinished], closed.displacement[unfinished], atol=1e-5)


def test_perception_times_every_stage(data, capsys, monkeypatch):
    quick = presets.PRESETS["quick"]
    small = replace(
        quick.perception, networks=NetworksConfig(encoder=TINY), views=2, queries=4, probes=2, proposals=4, best=2
    )
    monkeypatch.setitem(presets.PRESETS, "quick", replace(quick, perception=small))
    result = run(capsys, "perception", "--data", str(data[0]), "--preset", "quick", "--seconds", "0.05")
    assert set(result["steps_per_second"]) == {"scorer", "proposal", "actionability", "joint"}
    assert all(rate > 0 for rate in result["steps_per_second"].values())
    assert result["encode_points"] == 10_000 and result["group_seconds"] > 0 and result["encode_seconds"] > 0


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["speed"], "bench speed: say what to measure, one of physics, parity, perception"),
        (["physics", "--impl", "sapien"], "--impl sapien: not one of c, warp, jax"),
        (["physics", "--task", "lift"], "--task lift: not one of push-door"),
        (["physics", "--batch", "1k"], "--batch 1k: expected whole numbers"),
        (["physics", "--split", "tests"], "no object of --split tests"),
        (["parity", "--impls", "c,bullet"], "--impls bullet: not one of c, warp, jax"),
        (["perception", "--preset", "huge"], "--preset huge: not one of quick"),
    ],
)
def test_bad_flags_are_named(data, capsys, args, message):
    with pytest.raises(SystemExit) as stopped:
        cli.main(["bench", *args, *(["--data", str(data[0])] if args[0] != "speed" else [])])
    assert stopped.value.code == 2
    assert message in capsys.readouterr().err
