import json
import os
import subprocess
import sys

import jax
import numpy as np
import pytest
from PIL import Image

from vatmart_jax import rotations as rot
from vatmart_jax.data.banks import SceneBank, ViewBank
from vatmart_jax.envs import EnvConfig, make_env
from vatmart_jax.errors import UserError
from vatmart_jax.trajectory import pack_trajectory, unpack_trajectory
from vatmart_jax.viz.trial_video import find_scene, play


@pytest.fixture(scope="module")
def data(cabinets, tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    cabinets[0].save(folder / "scenes.npz")
    cabinets[1].save(folder / "views.npz")
    return folder


@pytest.fixture(scope="module")
def trajectory(data):
    """A push of 0.1 straight into the fronts, as a file."""
    up = np.array([1.0, 0, 0])
    frame = np.asarray(rot.gripper_frame(up, np.array([0.0, 0, 1])))
    residuals = np.zeros((4, 6))
    residuals[:2, :3] = 0.06 * up
    np.save(data / "push.npy", np.asarray(pack_trajectory(frame, residuals)))
    return data / "push.npy"


def test_scenes_are_named_by_object_by_part_and_by_index(cabinets):
    bank = cabinets[0]
    assert [find_scene(bank, name) for name in ("100", "100:drawer", "300", "5")] == [0, 1, 4, 5]
    for name, message in (("100:lid", "parts door, drawer"), ("99", "index below 6"), ("-1", "index below 6")):
        with pytest.raises(UserError, match=message):
            find_scene(bank, name)


def test_a_recording_ends_where_the_environment_does(data, trajectory):
    recording, result = play(data, "200:drawer", trajectory=trajectory)
    bank, views = SceneBank.load(data / "scenes.npz"), ViewBank.load(data / "views.npz")
    env = make_env(bank.select([3]), views.of_scenes([3]), "push-drawer", config=EnvConfig(num_envs=1))
    start = recording.state.start
    end = jax.jit(env.execute)(start, unpack_trajectory(np.load(trajectory)[None])[1])
    np.testing.assert_allclose(recording.qpos[-1], end.physics.qpos[0], atol=1e-4)
    assert result["moved"] == pytest.approx(float(end.displacement[0]), abs=1e-3) and result["moved"] > 0.02
    assert len(recording.qpos) == result["frames"] == 81
    steps = np.abs(np.diff(recording.qpos, axis=0)).max(1)
    assert 0 < steps.max() < 0.1  # no frame is missing


def test_the_command_writes_an_animated_picture_in_which_things_move(data, trajectory, tmp_path):
    out = tmp_path / "push.gif"
    command = [
        sys.executable,
        "-m",
        "vatmart_jax.cli",
        "play",
        "100:drawer",
        "--data",
        data,
        "--out",
        out,
        "--json",
    ]
    command += ["--trajectory", trajectory, "--contact", "-0.5", "0", "-0.2"]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "DISPLAY": ""})
    if done.returncode == 2 and "no OpenGL" in done.stderr:
        assert "libosmesa6" in done.stderr and not list(tmp_path.iterdir())
        pytest.skip("no OpenGL on this machine")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout.splitlines()[-1])
    assert result["file"] == str(out) and result["task"] == "push-drawer"
    picture = Image.open(out)
    assert picture.n_frames > 20 and picture.size == (480, 360)
    first = np.asarray(picture.convert("RGB"), int)
    picture.seek(picture.n_frames - 1)
    assert (np.abs(np.asarray(picture.convert("RGB"), int) - first).max(-1) > 30).mean() > 1e-3
    assert [p.name for p in tmp_path.iterdir()] == ["push.gif"]


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        (np.zeros(24), r"expected 30 numbers, found shape \(24,\)"),
        (np.full(30, np.nan), "not finite"),
        (None, "not a .npy"),
    ],
)
def test_files_that_hold_no_trajectory_are_refused(data, tmp_path, numbers, message):
    file = tmp_path / "bad.npy"
    if numbers is None:
        file.write_text("30")
    else:
        np.save(file, numbers)
    with pytest.raises(UserError, match=message):
        play(data, "100", trajectory=file)


def test_tasks_that_a_scene_cannot_do_are_refused(data):
    with pytest.raises(UserError, match="has no drawer"):
        play(data, "100:door", task="pull-drawer")
    with pytest.raises(UserError, match=r"task .shove. is not known"):
        play(data, "100", task="shove")
    with pytest.raises(UserError, match="amount -1"):
        play(data, "100", amount=-1)
