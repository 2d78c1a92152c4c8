"""A whole training run at toy sizes: same code path as every preset."""

import json
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from flax import serialization

from vatmart_jax.config import from_json, to_json
from vatmart_jax.data.dataset import Data
from vatmart_jax.envs import TASKS, EnvConfig
from vatmart_jax.errors import UserError
from vatmart_jax.evaluation.success import downstream, random_method
from vatmart_jax.perception.networks import NetworksConfig
from vatmart_jax.perception.pointnet2 import PointNet2Config, SetAbstraction
from vatmart_jax.perception.trainer import PerceptionConfig
from vatmart_jax.physics import PhysicsConfig
from vatmart_jax.pipeline.exploration import ExplorationConfig
from vatmart_jax.pipeline.presets import PRESETS, EvaluationConfig, Schedule, Settings, default_preset
from vatmart_jax.pipeline.run_dir import RunDir, RunError, read_metrics
from vatmart_jax.pipeline.trainer import PipelineTrainer, perception_config
from vatmart_jax.priors.priors import Priors
from vatmart_jax.rl.td3 import TD3Config
from vatmart_jax.workflows.evaluate import METRICS, evaluate
from vatmart_jax.workflows.train import resolve, train

TINY = Settings(
    env=EnvConfig(num_envs=16),
    physics=PhysicsConfig(steps_per_waypoint=50),
    explore=ExplorationConfig(
        td3=TD3Config(hidden=32, batch_size=32, buffer_size=1000, grad_steps_per_iter=4),
        iterations=4,
        start_pool_size=32,
    ),
    perception=PerceptionConfig(
        networks=NetworksConfig(
            encoder=PointNet2Config(
                64, (SetAbstraction(16, 0.3, 4, (16,)), SetAbstraction(4, 0.8, 4, (16,))), ((16,), (16,)), 16
            ),
            flow_hidden=(16,),
            predict_axis=True,
        ),
        views_per_batch=2,
        samples_per_view=4,
        actionability_queries=2,
        num_proposals=4,
        top_k=2,
        log_every=3,
    ),
    schedule=Schedule(
        buffer_size=512,
        collect_batches=2,
        flow_steps=3,
        scorer_steps=6,
        proposal_steps=6,
        actionability_steps=3,
        curiosity_rounds=2,
        curiosity_iterations=1,
        curiosity_steps=3,
        finetune_rounds=1,
        finetune_batches=1,
        finetune_steps=3,
    ),
    evaluation=EvaluationConfig(trials=24, num_proposals=4, num_augmentations=2),
)


@pytest.fixture(scope="module")
def converted(cabinets, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("converted")
    for bank, name in zip(cabinets, ("scenes", "views"), strict=True):
        bank.save(folder / f"{name}.npz")
    return folder


def run(converted: Path, out: Path, task: str = "push-drawer", seed: int = 0, report=lambda *_: None):
    config = resolve(task, "quick", "c", seed, TINY, converted)
    return train(config, TINY, Data(converted), out, report)


@pytest.fixture(scope="module")
def finished(converted, tmp_path_factory) -> tuple[Path, dict]:
    out = tmp_path_factory.mktemp("runs") / "whole"
    result, _ = run(converted, out)
    return out, result


def test_a_run_leaves_everything_its_readers_need(finished):
    out, result = finished
    for name in ("config.json", "metrics.jsonl", "result.json", "policy.msgpack", "priors", "curves.png"):
        assert (out / name).exists(), name
    assert list(out.glob("priors_*.png"))
    assert not list(out.rglob("*.part"))
    assert set(result["success"]) == {"test_shapes", "test_categories"}
    assert {row["method"] for row in result["results"]} == {"ours", "random"}
    assert all(seconds > 0 for seconds in result["stages"].values()) and {"compile", "evaluate"} < set(result["stages"])
    stages = [line["stage"] for line in read_metrics(out)]
    assert list(dict.fromkeys(stages)) == [
        "explore", "collect", "flow", "scorer", "proposal", "actionability", "curiosity", "finetune",
    ]  # fmt: skip


def test_a_door_is_trained_with_its_hinge_from_data_to_priors(converted, tmp_path):
    result, _ = run(converted, tmp_path / "run", "push-door")
    assert set(result["success"]) == {"test_shapes", "test_categories"}
    for line in read_metrics(tmp_path / "run"):
        assert ("axis_loss" in line) == (line["stage"] in ("flow", "scorer", "proposal", "curiosity", "finetune"))
        assert all(np.isfinite(value) for value in line.values() if not isinstance(value, str))
    assert Priors.load(tmp_path / "run").config.networks.predict_axis


def test_an_evaluation_has_the_priors_the_trials_the_policy_and_what_the_scores_were_worth(finished, tmp_path):
    run_folder, _ = finished
    result, table = evaluate(
        [run_folder],
        lambda data: data or run_folder,
        None,
        METRICS,
        ("ours", "expert"),
        24,
        "c",
        1,
        tmp_path,
        lambda *_: None,
    )
    (found,) = result["runs"]
    assert [(row["split"], row["method"]) for row in found["downstream"]] == [
        (split, method) for split in ("test_shapes", "test_categories") for method in ("ours", "expert")
    ]
    assert {row["split"] for row in found["priors"]} == {"test_shapes", "test_categories"}
    (policy,) = found["policy"]
    assert policy["split"] == "train" and policy["trials"] == 24 and 0 <= policy["success"] <= 1
    ours, expert = found["downstream"][:2]
    assert sum(ours["reliability"]["count"]) == 24 and ours["said"] == pytest.approx(
        np.average(ours["reliability"]["said"], weights=ours["reliability"]["count"]), abs=1e-3
    )
    assert "said" not in expert and "reliability" not in expert
    assert json.loads((tmp_path / "evaluation.json").read_text())["runs"] == [found]
    assert (tmp_path / "evaluation.md").read_text().startswith(table)
    assert (tmp_path / "reliability.png").stat().st_size > 10_000


@pytest.mark.parametrize("task", ["push-drawer", "pull-drawer"])
def test_failures_are_told_apart(converted, task):
    env = Data(converted).env("test_shapes", TASKS[task], "c", TINY.env, TINY.physics)
    row = downstream(env, random_method(env), 48, jax.random.key(0))
    assert row["success"] + row["in_collision"] + row["lost_grip"] <= 1
    assert row["no_grasp"] <= row["lost_grip"] and (row["no_grasp"] > 0) == (task == "pull-drawer")


def test_a_run_keeps_the_running_mean_of_its_policy(finished, converted):
    out, _ = finished
    env = Data(converted).env("train", TASKS["push-drawer"], "c", TINY.env, TINY.physics)
    with RunDir(out, resolve("push-drawer", "quick", "c", 0, TINY, converted)) as run:
        td3 = PipelineTrainer(run, env, TINY, 0, lambda *_: None).train().explore.td3
    assert (out / "policy.msgpack").read_bytes() == serialization.to_bytes(jax.device_get(td3.target_policy))
    assert any(np.any(a != b) for a, b in zip(*map(jax.tree.leaves, (td3.policy, td3.target_policy)), strict=True))


@pytest.mark.parametrize("stage, done", [("explore", 2), ("scorer", 3)])
def test_a_run_killed_at_any_stage_resumes_to_the_same_result(finished, converted, tmp_path, monkeypatch, stage, done):
    class Killed(Exception):
        pass

    def kill(name, step, *_):
        if (name, step) == (stage, done):
            raise Killed

    monkeypatch.setattr("vatmart_jax.pipeline.trainer._SECONDS_BETWEEN_CHECKPOINTS", 0.0)
    with pytest.raises(Killed):
        run(converted, tmp_path / "run", report=kill)
    resumed, _ = run(converted, tmp_path / "run")
    whole, result = finished
    assert resumed["results"] == result["results"]
    metrics = [
        [{k: v for k, v in line.items() if k != "seconds"} for line in read_metrics(folder)]
        for folder in (whole, tmp_path / "run")
    ]
    assert metrics[0] == metrics[1]


def test_a_folder_with_another_config_is_refused(finished, converted):
    out, _ = finished
    with pytest.raises(RunError, match=r"another config \(seed differ\); choose another --out"):
        run(converted, out, seed=1)


def test_a_folder_with_something_else_is_refused(converted, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(RunError, match="holds no run"):
        run(converted, tmp_path)


def test_a_damaged_checkpoint_is_passed_over_and_all_damaged_is_an_error(tmp_path):
    state = {"x": np.arange(5.0), "key": jax.random.key(3)}
    with RunDir(tmp_path / "run", {"a": 1}) as opened:
        opened.save(state)
        opened.save({**state, "x": 2 * state["x"]})
    folders = sorted((tmp_path / "run" / "checkpoints").iterdir(), key=lambda p: int(p.name))
    _damage(folders[-1])
    with RunDir(tmp_path / "run", {"a": 1}) as opened:
        found = opened.restore(state)
        np.testing.assert_array_equal(found["x"], state["x"])
        assert jax.random.key_data(found["key"]).tolist() == jax.random.key_data(state["key"]).tolist()
    _damage(folders[0])
    with RunDir(tmp_path / "run", {"a": 1}) as opened, pytest.raises(RunError, match="cannot be read"):
        opened.restore(state)


# Orbax leaves what it was about to read unawaited when it finds another shape.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_checkpoint_of_another_version_is_an_error_and_stays(tmp_path):
    state = {"seconds": np.arange(8.0)}
    with RunDir(tmp_path / "run", {"a": 1}) as opened:
        opened.save(state)
    with (
        RunDir(tmp_path / "run", {"a": 1}) as opened,
        pytest.raises(RunError, match="go on with the version that wrote"),
    ):
        opened.restore({"seconds": np.zeros(9)})
    with RunDir(tmp_path / "run", {"a": 1}) as opened:
        np.testing.assert_array_equal(opened.restore({"seconds": np.zeros(8)})["seconds"], state["seconds"])


def _damage(folder: Path) -> None:
    for path in folder.rglob("*"):
        if path.is_file():
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def test_metrics_that_are_missing_or_cut_are_an_error_that_names_them(tmp_path):
    for text in (None, '{"stage": "explore", "st'):
        if text:
            (tmp_path / "metrics.jsonl").write_text(text)
        with pytest.raises(RunError, match=r"metrics\.jsonl: cannot be read .*train again"):
            read_metrics(tmp_path)


def test_unknown_names_are_refused_by_name():
    with pytest.raises(UserError, match="--task push-lid: not one of push-door, pull-door"):
        resolve("push-lid", "quick", "c", 0, TINY, None)
    with pytest.raises(UserError, match="--impl x"):
        resolve("push-door", "quick", "x", 0, TINY, None)


def test_a_number_of_copies_that_cannot_be_is_refused_before_anything_is_written(converted, tmp_path):
    settings = replace(TINY, evaluation=EvaluationConfig(num_augmentations=0))
    config = resolve("push-drawer", "quick", "c", 0, settings, converted)
    with pytest.raises(UserError, match="num_augmentations 0: expected 1 to 64"):
        train(config, settings, Data(converted), tmp_path / "run", lambda *_: None)
    assert not (tmp_path / "run").exists()


def test_a_task_without_objects_is_refused(cabinets, tmp_path):
    bank, views = cabinets
    doors = np.flatnonzero(bank.joint_type == 0)
    bank.select(doors).save(tmp_path / "scenes.npz")
    views.of_scenes(doors).save(tmp_path / "views.npz")
    with pytest.raises(UserError, match=r"split train: the data has no drawer \(slide\)"):
        run(tmp_path, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_the_bundled_objects_are_quick_and_own_ones_get_what_the_machine_can_do(monkeypatch):
    assert default_preset(own_data=False) == "quick" and default_preset(own_data=True) == "cpu"
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert default_preset(own_data=False) == "quick" and default_preset(own_data=True) == "gpu"


def test_doors_have_a_hinge_where_the_settings_say_so_and_drawers_never():
    plain = replace(TINY, perception=replace(TINY.perception, networks=NetworksConfig()))
    for task in TASKS.values():
        assert perception_config(TINY, task).networks.predict_axis == task.is_hinge
        assert not perception_config(plain, task).networks.predict_axis


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_survives_json(name):
    settings = PRESETS[name]
    assert from_json(Settings, to_json(settings)) == settings


def test_json_of_another_shape_is_refused_by_field():
    value = to_json(replace(TINY))
    value["env"]["batch"] = "many"
    with pytest.raises(ValueError, match=r"config\.env\.batch: expected int, found str"):
        from_json(Settings, value)
