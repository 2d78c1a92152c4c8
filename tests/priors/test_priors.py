"""Priors: what is saved is what is loaded; damaged folders and wrong input are refused in one line."""

import json
from pathlib import Path

import jax
import numpy as np
import pytest
import trimesh
from flax import serialization
from jax import export as jax_export

from vatmart_jax.cli.main import main
from vatmart_jax.errors import UserError
from vatmart_jax.perception.config import NetworksConfig
from vatmart_jax.perception.networks import Networks
from vatmart_jax.perception.pointnet2 import PointNet2Config, SetAbstraction
from vatmart_jax.priors import load_priors
from vatmart_jax.priors.export import export
from vatmart_jax.priors.priors import Priors, PriorsConfig, PriorsError, random_order

TINY = PointNet2Config(
    n_points=64, levels=(SetAbstraction(16, 0.3, 8, (16,)), SetAbstraction(4, 0.8, 4, (16,))), propagation=((16,),) * 2
)


@pytest.fixture(scope="module")
def priors() -> Priors:
    config = PriorsConfig("push-drawer", 0.1, 0.7, NetworksConfig(encoder=TINY))
    return Priors(config, Networks(config.networks).init(jax.random.key(0)))


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    return np.random.default_rng(0).uniform(-0.5, 0.5, (100, 3)).astype(np.float32)


def test_loaded_priors_predict_what_the_saved_ones_do(priors: Priors, points: np.ndarray, tmp_path: Path) -> None:
    priors.save(tmp_path / "priors")
    priors.save(tmp_path / "priors")
    loaded = Priors.load(tmp_path / "priors")
    assert [p.name for p in tmp_path.iterdir()] == ["priors"]
    assert loaded.config == priors.config == Priors.load(tmp_path).config
    key = jax.random.key(1)
    for a, b in zip(priors.predict(points, 0.3, key=key), loaded.predict(points, 0.3, key=key), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_prediction_has_the_promised_shapes_and_order(priors: Priors, points: np.ndarray) -> None:
    found = priors.predict(points, 0.3, n_proposals=20)
    assert found.actionability.shape == (100,)
    assert found.trajectories.shape == (20, 30)
    assert found.contact_index == found.actionability.argmax()
    np.testing.assert_array_equal(found.contact, points[found.contact_index])
    assert (np.diff(found.scores) <= 0).all() and (found.scores >= 0).all() and (found.scores <= 1).all()
    up, forward = found.trajectories[:, :3], found.trajectories[:, 3:6]
    np.testing.assert_allclose(np.linalg.norm(up, axis=1), 1, atol=1e-5)
    np.testing.assert_allclose((up * forward).sum(1), 0, atol=1e-5)


def test_the_contact_lies_on_the_masked_part(priors: Priors, points: np.ndarray) -> None:
    mask = points[:, 2] > 0.2
    assert mask[priors.predict(points, 0.3, mask).contact_index]


@pytest.mark.parametrize("n", [10, 64, 500])
def test_clouds_of_any_size_are_taken(priors: Priors, n: int) -> None:
    found = priors.predict(np.random.default_rng(n).normal(size=(n, 3)), 0.3, n_proposals=5)
    assert np.isfinite(found.actionability).all() and found.actionability.shape == (n,)


def test_clouds_of_ten_sizes_compile_three_programs_at_most(priors: Priors) -> None:
    compiled: list[str] = []
    listen = lambda event, seconds, **_: compiled.append(event) if event.endswith("backend_compile_duration") else None
    key = jax.random.key(7)
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        for n in (70, 300, 900, 1024, 1025, 1600, 1700, 2048, 2049, 4000):
            cloud = np.random.default_rng(n).uniform(-0.5, 0.5, (n, 3))
            assert priors.predict(cloud, 0.3, key=key, n_proposals=3).actionability.shape == (n,)
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert 1 <= len(compiled) <= 3


@pytest.mark.parametrize("count", [1, 2, 64, 1000, 1625, 1626, 2000, 2048])
def test_the_order_of_a_padded_cloud_is_the_permutation_of_the_cloud(count: int) -> None:
    key = jax.random.key(count)
    order = np.asarray(random_order(key, 2048, count))
    np.testing.assert_array_equal(order[:count], jax.random.permutation(key, count))
    np.testing.assert_array_equal(np.sort(order), np.arange(2048))


def test_a_task_outside_of_training_is_warned_of(priors: Priors, points: np.ndarray) -> None:
    with pytest.warns(UserWarning, match=r"task 1.5: the priors were trained on 0.1 to 0.7"):
        priors.predict(points, 1.5, n_proposals=2)


def test_missing_fields_take_defaults_and_a_name_loads_what_comes_with_the_package(priors, tmp_path) -> None:
    priors.save(tmp_path / "priors")
    file = tmp_path / "priors" / "config.json"
    written = json.loads(file.read_text())
    assert written["format"] == 2
    del written["num_augmentations"], written["networks"]["latent_dim"], written["networks"]["encoder"]["kind"]
    file.write_text(json.dumps(written))
    assert load_priors(tmp_path).config == priors.config
    assert load_priors("push-drawer").config.task == "push-drawer"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": np.zeros((4, 2))}, r"points: expected finite \[N, 3\] coordinates, found shape \(4, 2\)"),
        ({"points": np.full((4, 3), np.nan)}, "points: expected finite"),
        ({"points": np.zeros((0, 3))}, "points: expected finite"),
        ({"task": -0.1}, "task: expected a goal above 0, found -0.1"),
        ({"task": float("nan")}, "task: expected a goal above 0"),
        ({"part_mask": np.zeros(100, bool)}, "part_mask: expected 100 booleans, one of them true"),
        ({"part_mask": np.ones(3, bool)}, "part_mask: expected 100 booleans"),
    ],
)
def test_wrong_input_is_named(priors: Priors, points: np.ndarray, change: dict, message: str) -> None:
    with pytest.raises(PriorsError, match=message):
        priors.predict(**({"points": points, "task": 0.3} | change))


def test_no_proposals_are_refused(priors: Priors, points: np.ndarray) -> None:
    with pytest.raises(UserError, match="n_proposals 0: must be at least 1"):
        priors.predict(points, 0.3, n_proposals=0)


def damage(folder: Path, how: str) -> None:
    params, config = folder / "params.msgpack", folder / "config.json"
    if how == "truncated":
        params.write_bytes(params.read_bytes()[: params.stat().st_size // 2])
    elif how == "empty":
        params.write_bytes(b"")
    elif how == "noise":
        params.write_bytes(np.random.default_rng(0).bytes(1000))
    elif how == "no params":
        params.unlink()
    elif how == "no config":
        config.unlink()
    elif how == "config not JSON":
        config.write_text("{")
    elif how == "config of something else":
        config.write_text("[1, 2]")
    elif how == "unknown field":
        config.write_text(json.dumps(json.loads(config.read_text()) | {"colour": 1}))
    elif how == "too many copies":
        config.write_text(json.dumps(json.loads(config.read_text()) | {"num_augmentations": 10**9}))
    elif how == "other sizes":
        text = json.loads(config.read_text())
        text["networks"]["latent_dim"] = 7
        config.write_text(json.dumps(text))
    else:
        tree = serialization.msgpack_restore(params.read_bytes())
        if how == "missing network":
            del tree["decoder"]
        elif how == "not finite":
            tree["scorer"]["Dense_0"]["bias"] = np.full_like(tree["scorer"]["Dense_0"]["bias"], np.nan)
        params.write_bytes(serialization.msgpack_serialize(tree))


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("truncated", r"params.msgpack: cannot be read \(.*\); train or export the priors again"),
        ("empty", "params.msgpack: cannot be read"),
        ("noise", "params.msgpack: "),
        ("no params", "params.msgpack: cannot be read"),
        ("no config", "config.json: no such file; expected a folder of priors"),
        ("config not JSON", "config.json: not a config of priors"),
        ("config of something else", "config.json: not a config of priors"),
        ("unknown field", "colour"),
        ("too many copies", r"config.json: not a config of priors \(num_augmentations 1000000000: expected 1 to 64"),
        ("other sizes", r"params.msgpack: parameter \['decoder'\].*expected float32"),
        ("missing network", "parameter .*decoder.* is missing"),
        ("not finite", "parameter .*scorer.* is not finite"),
    ],
)
def test_damaged_priors_are_refused_in_one_line(priors: Priors, tmp_path: Path, how: str, message: str) -> None:
    priors.save(tmp_path / "priors")
    damage(tmp_path / "priors", how)
    with pytest.raises(PriorsError, match=message) as caught:
        Priors.load(tmp_path / "priors")
    assert "\n" not in str(caught.value)


def test_exported_stablehlo_computes_what_the_priors_do(priors: Priors, points: np.ndarray, tmp_path: Path) -> None:
    files = export(priors, tmp_path / "out", n_proposals=10)
    assert {str(f.relative_to(tmp_path / "out")) for f in files} == {
        "flax/config.json",
        "flax/params.msgpack",
        "stablehlo/priors.bin",
        "stablehlo/signature.json",
    }
    assert Priors.load(tmp_path / "out" / "flax").config == priors.config
    signature = json.loads((tmp_path / "out/stablehlo/signature.json").read_text())
    assert signature["inputs"]["points"] == {"shape": [64, 3], "dtype": "float32"}
    call = jax_export.deserialize(bytearray((tmp_path / "out/stablehlo/priors.bin").read_bytes())).call
    found = call(points[:64], np.ones(64, bool), np.float32(0.3), np.uint32(5))
    expected = priors.predict(points[:64], 0.3, key=jax.random.key(5), n_proposals=10)
    assert int(found[0]) == expected.contact_index
    for a, b in zip(found[1:], expected[2:], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


def test_an_export_that_cannot_be_made_writes_nothing(priors: Priors, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="format onnx: not one of flax, stablehlo"):
        export(priors, tmp_path / "out", ("flax", "onnx"))
    with pytest.raises(UserError, match="n_proposals 0: must be at least 1"):
        export(priors, tmp_path / "out", n_proposals=0)
    assert not (tmp_path / "out").exists()


def test_the_command_predicts_what_the_library_does(priors: Priors, points: np.ndarray, tmp_path: Path, capsys) -> None:
    priors.save(tmp_path / "run" / "priors")
    np.save(tmp_path / "cloud.npy", points)
    trimesh.PointCloud(points).export(tmp_path / "cloud.ply")
    printed = []
    for cloud in ("cloud.npy", "cloud.ply"):
        main(
            [
                "predict",
                str(tmp_path / "run"),
                "--cloud",
                str(tmp_path / cloud),
                "--task",
                "0.3",
                "--out",
                str(tmp_path / "found.npz"),
                "--json",
            ]
        )
        printed.append(json.loads(capsys.readouterr().out.splitlines()[-1]))
    found = priors.predict(points, 0.3)
    assert printed[0] == printed[1]
    assert printed[0]["contact"] == found.contact.tolist()
    assert printed[0]["actionability_max"] == pytest.approx(float(found.actionability.max()))
    np.testing.assert_array_equal(np.float32(printed[0]["trajectories"]), found.trajectories)
    with np.load(tmp_path / "found.npz") as saved:
        np.testing.assert_array_equal(saved["scores"], found.scores)


def test_the_command_exports_priors_that_load(priors: Priors, tmp_path: Path, capsys) -> None:
    priors.save(tmp_path / "run" / "priors")
    main(["export", str(tmp_path / "run"), "--out", str(tmp_path / "out"), "--format", "flax", "--json"])
    files = json.loads(capsys.readouterr().out.splitlines()[-1])["files"]
    assert {Path(f).name for f in files} == {"config.json", "params.msgpack"}
    assert Priors.load(tmp_path / "out" / "flax").config == priors.config
