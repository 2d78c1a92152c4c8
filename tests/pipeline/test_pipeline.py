"""A whole training run at toy sizes: same code path as every preset."""

import json
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from flax import serialization
from tiny import TINY, run_config, run_tiny

from vatmart_jax.config import from_json, to_json
from vatmart_jax.data.banks import SceneBank, ViewBank
from vatmart_jax.data.dataset import Data
from vatmart_jax.envs import TASKS, Env, get_task
from vatmart_jax.errors import UserError
from vatmart_jax.evaluation.methods.base import METHODS, EvalContext
from vatmart_jax.evaluation.success import evaluate_success
from vatmart_jax.perception.networks import NetworksConfig
from vatmart_jax.pipeline import format_1
from vatmart_jax.pipeline.presets import PRESETS, default_preset
from vatmart_jax.pipeline.run_config import RunConfig, load_run_policy
from vatmart_jax.pipeline.run_dir import RunDir, RunError, read_metrics
from vatmart_jax.pipeline.settings import EvaluationConfig, Settings
from vatmart_jax.pipeline.trainer import PipelineTrainer, perception_config
from vatmart_jax.priors.pretrained import run_folder
from vatmart_jax.priors.priors import Priors
from vatmart_jax.reporting import NullReporter
from vatmart_jax.rl.agent import load_policy
from vatmart_jax.workflows.environments import split_environments
from vatmart_jax.workflows.evaluate import METRICS, EvaluationPlan, evaluate

pytestmark = pytest.mark.usefixtures("quick_to_compile")


def environment(folder: Path, split: str, task: str) -> Env:
    return split_environments(Data(folder), get_task(task), "c", TINY)[0][split]


@pytest.fixture(scope="module")
def converted(cabinets, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("converted")
    for bank, name in zip(cabinets, ("scenes", "views"), strict=True):
        bank.save(folder / f"{name}.npz")
    return folder


@pytest.fixture(scope="module")
def finished(converted, tmp_path_factory) -> tuple[Path, dict]:
    out = tmp_path_factory.mktemp("runs") / "whole"
    return out, run_tiny(converted, out)


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
    result = run_tiny(converted, tmp_path / "run", task="push-door")
    assert set(result["success"]) == {"test_shapes", "test_categories"}
    for line in read_metrics(tmp_path / "run"):
        assert ("axis_loss" in line) == (line["stage"] in ("flow", "scorer", "proposal", "curiosity", "finetune"))
        assert all(np.isfinite(value) for value in line.values() if not isinstance(value, str))
    assert Priors.load(tmp_path / "run").config.networks.predict_axis


def test_an_evaluation_has_the_priors_the_trials_the_policy_and_what_the_scores_were_worth(finished, tmp_path):
    out, _ = finished
    plan = EvaluationPlan(impl="c", metrics=METRICS, methods=("ours", "expert"), trials=24)
    result, table = evaluate([out], plan, out=tmp_path)
    (found,) = result["runs"]
    assert [(row["split"], row["method"]) for row in found["downstream"]] == [
        (split, method) for split in ("test_shapes", "test_categories") for method in ("ours", "expert")
    ]
    assert {row["split"] for row in found["priors"]} == {"test_shapes", "test_categories"}
    (policy,) = found["policy"]
    assert policy["split"] == "train" and policy["trials"] == 24 and 0 <= policy["success"] <= 1
    ours, expert = found["downstream"][:2]
    curve = ours["reliability"]
    assert sum(curve["count"]) == 24
    assert ours["predicted"] == pytest.approx(np.average(curve["predicted"], weights=curve["count"]), abs=1e-3)
    assert ours["said"] == ours["predicted"] and ours["lost_grip"] == ours["grasp_lost"]
    assert ours["no_grasp"] == ours["grasp_failed"] and found["left_out"] == {}
    assert "said" not in expert and "reliability" not in expert
    assert json.loads((tmp_path / "evaluation.json").read_text())["runs"] == [found]
    assert (tmp_path / "evaluation.md").read_text().startswith(table)
    assert (tmp_path / "reliability.png").stat().st_size > 10_000


@pytest.mark.parametrize("task", ["push-drawer", "pull-drawer"])
def test_failures_are_told_apart(converted, task):
    env = environment(converted, "test_shapes", task)
    row = evaluate_success(env, METHODS.get("random")(EvalContext(env=env)), 48, jax.random.key(0))
    assert row["no_grasp"] <= row["lost_grip"] and (row["no_grasp"] > 0) == (task == "pull-drawer")


def test_a_run_keeps_the_running_mean_of_its_policy(finished, converted):
    out, _ = finished
    env = environment(converted, "train", "push-drawer")
    with RunDir(out, run_config(converted).to_json()) as run:
        td3 = PipelineTrainer(run, env, TINY, seed=0).train().explore.agent
    assert (out / "policy.msgpack").read_bytes() == serialization.to_bytes(jax.device_get(td3.target_policy))
    assert any(np.any(a != b) for a, b in zip(*map(jax.tree.leaves, (td3.policy, td3.target_policy)), strict=True))


@pytest.mark.parametrize("stage, done", [("explore", 2), ("scorer", 1)])
def test_a_run_killed_at_any_stage_resumes_to_the_same_result(finished, converted, tmp_path, monkeypatch, stage, done):
    class Killed(Exception):
        pass

    class Killer(NullReporter):
        def progress(self, name, unit, *_):
            if (name, unit) == (stage, done):
                raise Killed

    monkeypatch.setattr(RunDir, "save", lambda run, state, _=0.0, save=RunDir.save: save(run, state))
    with pytest.raises(Killed):
        run_tiny(converted, tmp_path / "run", Killer())
    resumed = run_tiny(converted, tmp_path / "run")
    whole, result = finished
    assert resumed["results"] == result["results"]
    metrics = [
        [{k: v for k, v in line.items() if k != "seconds"} for line in read_metrics(folder)]
        for folder in (whole, tmp_path / "run")
    ]
    assert metrics[0] == metrics[1]


def test_a_folder_with_another_config_is_refused(finished, converted):
    out, _ = finished
    with pytest.raises(RunError, match=r"another config \(seed differ\); choose another folder"):
        run_tiny(converted, out, seed=1)


def test_a_folder_with_something_else_is_refused(converted, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(RunError, match="holds no run"):
        run_tiny(converted, tmp_path)


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


def test_unknown_names_are_refused_by_name(converted):
    with pytest.raises(UserError, match="task 'push-lift' is not known; use one of push-door, pull-door"):
        run_config(converted, "push-lift")
    with pytest.raises(UserError, match="impl 'x' is not known; use one of c, warp, jax"):
        replace(run_config(converted), impl="x")


def test_a_number_of_copies_that_cannot_be_is_refused_before_anything_is_written(converted, tmp_path):
    settings = replace(TINY, evaluation=EvaluationConfig(num_augmentations=0))
    with pytest.raises(UserError, match="num_augmentations 0: expected 1 to 64"):
        run_tiny(converted, tmp_path / "run", settings=settings)
    assert not (tmp_path / "run").exists()


def test_a_task_without_objects_is_refused(cabinets, tmp_path):
    bank, views = cabinets
    doors = np.flatnonzero(bank.joint_type == 0)
    bank.select(doors).save(tmp_path / "scenes.npz")
    views.of_scenes(doors).save(tmp_path / "views.npz")
    with pytest.raises(UserError, match=r"split train: the data has no drawer \(slide\)"):
        run_tiny(tmp_path, tmp_path / "run")
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
    value["env"]["num_envs"] = "many"
    with pytest.raises(ValueError, match=r"config\.env\.num_envs: expected int, found str"):
        from_json(Settings, value)


def test_a_policy_loads_by_path_alone_and_without_a_replay_buffer(finished, monkeypatch):
    out, _ = finished
    monkeypatch.setattr("vatmart_jax.rl.replay_buffer.ReplayBuffer.create", None)
    agent, policy = load_policy(out)
    assert agent.act(policy, jax.numpy.zeros((2, 33))).shape == (2, 6)
    (described := json.loads((out / "policy.json").read_text())).pop("config")
    assert described == {
        "format": 2, "agent": "td3", "observation_size": 33, "action_size": 6, "task": "push-drawer",
    }  # fmt: skip


def test_a_policy_of_format_1_loads_through_the_config_of_its_run(monkeypatch):
    monkeypatch.setattr("vatmart_jax.rl.replay_buffer.ReplayBuffer.create", None)
    agent, policy = load_run_policy(run_folder(Path("push-drawer")))
    assert np.isfinite(agent.act(policy, jax.numpy.ones((1, 33)))).all()


@pytest.mark.parametrize(
    ("field", "value"), [("hand_mass", 2.0), ("slide_gains", [5000.0, 160.0, 61.0]), ("finger_armature", 0.2)]
)
def test_a_run_of_format_1_with_another_hand_than_the_panda_is_refused_by_field(field, value):
    old = json.loads((run_folder(Path("push-drawer")) / "config.json").read_text())
    assert RunConfig.from_json(old).settings.physics.gripper == "panda"
    old["settings"]["physics"][field] = value
    with pytest.raises(ValueError, match=rf"physics\.{field}: the gripper panda has "):
        format_1.settings(old["settings"])
    with pytest.raises(UserError, match=rf"physics\.{field}"):
        RunConfig.from_json(old)


def test_a_policy_of_other_sizes_than_described_is_refused(finished, tmp_path):
    out, _ = finished
    described = json.loads((out / "policy.json").read_text())
    (tmp_path / "policy.msgpack").write_bytes((out / "policy.msgpack").read_bytes())
    (tmp_path / "policy.json").write_text(json.dumps({**described, "observation_size": 7}))
    with pytest.raises(UserError, match=r"policy\.msgpack: holds other networks"):
        load_policy(tmp_path)


def test_a_run_config_survives_json(converted):
    config = replace(run_config(converted), more_data=("a", "b"))
    assert RunConfig.from_json(json.loads(json.dumps(config.to_json()))) == config


def test_a_run_config_that_does_not_fit_is_refused_by_field(converted):
    value = run_config(converted).to_json()
    with pytest.raises(UserError, match=r"config\.data\.kind: expected one of bundled, folder, external, found web"):
        RunConfig.from_json({**value, "data": {"kind": "web"}})
    with pytest.raises(UserError, match="format 3, expected one up to 2"):
        RunConfig.from_json({**value, "format": 3})
    with pytest.raises(UserError, match="a folder has a path"):
        RunConfig.from_json({**value, "data": {"kind": "folder"}})


def test_two_processes_cannot_have_one_run_folder_open(tmp_path):
    with RunDir(tmp_path / "run", {"a": 1}), pytest.raises(RunError, match="another process trains in this folder"):
        RunDir(tmp_path / "run", {"a": 1})
    with RunDir(tmp_path / "run", {"a": 1}):
        pass


def test_a_run_of_format_1_is_not_resumed_and_the_error_names_its_version(converted, tmp_path):
    out = tmp_path / "run"
    out.mkdir()
    old = {"version": "0.1.0", "task": "push-drawer", "data": None, "settings": {}}
    (out / "config.json").write_text(json.dumps(old))
    with pytest.raises(RunError, match=r"version 0\.1\.0 \(format 1\), which can be evaluated but not resumed here"):
        run_tiny(converted, out)


def test_a_test_split_without_objects_is_left_out_by_name_and_reason(converted, tmp_path):
    bank, views = SceneBank.load(converted / "scenes.npz"), ViewBank.load(converted / "views.npz")
    rows = np.flatnonzero(bank.split != "test_categories")
    bank.select(rows).save(tmp_path / "scenes.npz")
    views.of_scenes(rows).save(tmp_path / "views.npz")
    lines = []

    class Lines(NullReporter):
        def info(self, text):
            lines.append(text)

    settings = replace(TINY, schedule=replace(TINY.schedule, stages=("explore",)))
    result = run_tiny(tmp_path, tmp_path / "run", Lines(), settings=settings)
    assert list(result["left_out"]) == ["test_categories"] and "no object" in result["left_out"]["test_categories"]
    assert any(line.startswith("test_categories left out: ") for line in lines)
    found, table = evaluate([tmp_path / "run"], EvaluationPlan(impl="c", metrics=("downstream",), trials=8))
    assert list(found["runs"][0]["left_out"]) == ["test_categories"] and "test_categories: left out" in table


def test_an_error_that_is_not_the_users_is_not_taken_for_missing_data(converted, monkeypatch):
    def broken(*_, **__):
        raise ValueError("operands could not be broadcast together")

    monkeypatch.setattr("vatmart_jax.workflows.environments.make_envs", broken)
    with pytest.raises(ValueError, match="broadcast"):
        environment(converted, "test_shapes", "push-drawer")
    assert not issubclass(UserError, ValueError)


def test_pretrained_sets_of_unknown_objects_are_not_evaluated_on_other_ones():
    plan = EvaluationPlan(impl="c", metrics=("downstream",), trials=8)
    with pytest.raises(UserError, match=r"push-door: was trained on objects that are not part .* --data"):
        evaluate([Path("push-door")], plan)
