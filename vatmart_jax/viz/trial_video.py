# MuJoCo's compiled names are invisible to pyright.
# pyright: reportAttributeAccessIssue=false

"""`vatmart play`: one trial as an animated picture, or in MuJoCo's viewer."""

from __future__ import annotations

import os
import sys
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from vatmart_jax.atomic_io import atomic_write
from vatmart_jax.data.banks import SceneBank, ViewBank
from vatmart_jax.envs import Env, EnvConfig, EnvState, Task, TrialStart, get_task, make_env
from vatmart_jax.envs.scripted_policy import run_scripted_policy
from vatmart_jax.errors import OpenGLError, UserError, summarize_error
from vatmart_jax.physics.scene_model import scene_model
from vatmart_jax.priors.priors import Priors
from vatmart_jax.trajectory import TRAJECTORY, unpack_trajectory

EVERY = 5  # physics steps per frame
FRAME_MS = 40  # half as fast as in the simulation
SIZE = (480, 360)
TRIES = 16  # random starts of the expert, of which the best is shown
COLOURS = {"object": (0.74, 0.74, 0.76, 1), "part": (0.36, 0.58, 0.85, 1)}


@dataclass(frozen=True)
class Recording:
    """One trial, frame by frame."""

    model: mujoco.MjModel  # the Scene's own
    gripper_pose: np.ndarray  # [7]
    qpos: np.ndarray  # [F, nq]
    path: np.ndarray  # [7, 3] contact point, then where the fingertips were sent: start, grasp (pull), waypoints
    azimuth: float  # rad, of the camera that took the view
    state: EnvState  # the end, B = 1


def play(
    folder: Path,
    scene: str,
    *,
    task: str | None = None,
    amount: float | None = None,
    trajectory: Path | None = None,
    contact: tuple[float, float, float] | None = None,
    run: Path | None = None,
    seed: int = 0,
) -> tuple[Recording, dict[str, Any]]:
    """One trial in a Scene of a converted folder, and what came of it.

    scene: object id, id:part, or index. The trial is the scripted policy's, the best proposal of a run's priors, or a
    trajectory file of 30 numbers at a contact point. Raises UserError for what does not fit.
    """
    bank, views = SceneBank.load(folder / "scenes.npz"), ViewBank.load(folder / "views.npz")
    chosen = np.array([find_scene(bank, scene)])
    priors = Priors.load(run) if run else None
    name = task or (priors.config.task if priors else f"push-{bank.part_kind[chosen[0]]}")
    env = make_env(bank.select(chosen), views.of_scenes(chosen), get_task(name), "c", EnvConfig(num_envs=TRIES))
    start = jax.jit(lambda key: env.sample(key, TRIES))(jax.random.key(seed))
    if amount is not None:
        start = start.replace(goal=jnp.full((TRIES,), _amount(amount, env.task)))
    if priors is not None:
        start, numbers = _proposed(env, priors, start, seed)
    elif trajectory is not None:
        start, numbers = _given(env, start, trajectory, contact)
    else:
        final = run_scripted_policy(env, start, jax.random.key(seed + 1))
        best = int(np.argmax(np.asarray(final.valid) + 2 * np.asarray(final.success)))
        start, numbers = jax.tree.map(lambda x: x[best : best + 1], (final.start, final.trajectory))
    recording = record(env, start, numbers)
    end = recording.state
    return recording, {
        "object": str(env.bank.object_id[0]),
        "part": str(env.bank.part[0]),
        "task": name,
        "amount": round(float(end.start.goal[0]), 4),
        "moved": round(float(end.displacement[0]), 4),
        "success": bool(end.success[0]),
        "start_in_collision": bool(end.in_collision[0]),
        "held": bool(end.grasp_held[0]),
        "frames": len(recording.qpos),
    }


def _amount(amount: float, task: Task) -> float:
    if not amount > 0:
        raise UserError(f"amount {amount}: must be above 0, in {task.unit} for task {task.name}")
    return amount


def _proposed(env: Env, priors: Priors, start: TrialStart, seed: int) -> tuple[TrialStart, jax.Array]:
    """The priors' best proposal for the first of `start`'s views and tasks."""
    if priors.config.task != env.task.name:
        raise UserError(f"run: its priors are of {priors.config.task}, not of {env.task.name}")
    view = int(start.view[0])
    cloud, mask = env.views.points[view].astype(np.float32), env.views.part_mask[view]
    found = priors.predict(cloud, float(start.goal[0]), mask, jax.random.key(seed))
    return _at(env, jax.tree.map(lambda x: x[:1], start), found.contact), jnp.asarray(found.trajectories[:1])


def _given(
    env: Env, start: TrialStart, file: Path, contact: tuple[float, float, float] | None
) -> tuple[TrialStart, jax.Array]:
    """The trajectory of a file, at a contact point or at the one of the first of `start`."""
    try:
        numbers = np.load(file, allow_pickle=False)
    except (OSError, ValueError, EOFError) as e:
        raise UserError(f"{file}: not a .npy file ({summarize_error(e)}); give {TRAJECTORY} numbers") from e
    if not isinstance(numbers, np.ndarray) or numbers.shape != (TRAJECTORY,) or numbers.dtype.kind not in "fiu":
        found = f"shape {numbers.shape}" if isinstance(numbers, np.ndarray) else "an archive"
        raise UserError(f"{file}: expected {TRAJECTORY} numbers, found {found}; see trajectory.pack_trajectory")
    if not np.isfinite(numbers).all():
        raise UserError(f"{file}: holds numbers that are not finite")
    start = jax.tree.map(lambda x: x[:1], start)
    return (_at(env, start, contact) if contact else start), jnp.asarray(numbers[None], jnp.float32)


def _at(env: Env, start: TrialStart, contact) -> TrialStart:
    """`start` at that contact of its view which is nearest to a point."""
    distance = np.linalg.norm(env.views.contacts[int(start.view[0])] - np.asarray(contact), axis=-1)
    return start.replace(contact=jnp.array([distance.argmin()], jnp.int32))


def find_scene(bank: SceneBank, name: str) -> int:
    """The Scene that `name` means: object id, id:part, or index. Raises UserError where there is none."""
    object_id, _, part = name.partition(":")
    rows = np.flatnonzero((bank.object_id == object_id) & ((bank.part == part) | (part == "")))
    if len(rows):
        return int(rows[0])
    if name.isdecimal() and int(name) < len(bank):
        return int(name)
    parts = ", ".join(sorted(set(bank.part[bank.object_id == object_id].tolist())))
    wanted = f"one of its parts {parts}" if parts else f"an object id, id:part, or an index below {len(bank)}"
    raise UserError(f"SCENE {name}: not in the data; give {wanted}")


def record(env: Env, start: TrialStart, trajectory: jax.Array) -> Recording:
    """Run one trial ([1] each) frame by frame: what `env.execute` does, in plain MuJoCo."""
    rotation, residuals = unpack_trajectory(trajectory)
    end, qpos = jax.jit(env.record, static_argnums=2)(start.replace(rotation=rotation), residuals, EVERY)
    scene, view = int(end.physics.scene[0]), int(start.view[0])
    hand = np.asarray(end.physics.gripper_pose[0])
    tip = np.asarray(end.point - env.config.standoff * end.start.rotation[:, :, 2])[0]
    # Backwards from where the fingertips were last sent, so that a grasp's advance is in it.
    moves = np.asarray(residuals[0, ::-1, :3])
    path = np.concatenate(
        [np.asarray(end.point), tip[None], (tip + end.tip - np.cumsum(moves, 0))[::-1], tip + end.tip]
    )
    model = scene_model(env.bank, scene, env.physics.config)
    return Recording(model, hand, np.asarray(qpos[:, 0]), path, float(env.views.azimuth[view]), end)


def animate(recording: Recording, path: Path, size: tuple[int, int] = SIZE) -> None:
    """Write an animated GIF of `size` (width, height), complete or not at all. Raises UserError without OpenGL."""
    from PIL import Image

    images = [Image.fromarray(pixels).quantize(96) for pixels in _rendered(recording, size)]
    with atomic_write(path) as part:
        images[0].save(
            part, format="GIF", save_all=True, append_images=images[1:], duration=FRAME_MS, loop=0, optimize=True
        )


def show(recording: Recording) -> None:
    """Play the trial over and over in MuJoCo's viewer until its window is closed. Raises UserError without display."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise UserError("--viewer: there is no display (DISPLAY is not set); leave it out for an animated picture")
    import mujoco.viewer

    model, data = recording.model, mujoco.MjData(recording.model)
    _colour(model)
    with mujoco.viewer.launch_passive(model, data) as viewer:
        viewer.opt.geomgroup[3] = 1
        while viewer.is_running():
            for qpos in recording.qpos:
                _pose(model, data, recording, qpos)
                viewer.sync()
                time.sleep(FRAME_MS / 1000)


def _rendered(recording: Recording, size: tuple[int, int]) -> list[np.ndarray]:
    model, data = recording.model, mujoco.MjData(recording.model)
    _colour(model)
    model.vis.global_.offwidth, model.vis.global_.offheight = size
    try:
        renderer = mujoco.Renderer(model, size[1], size[0])
    except Exception as e:  # whatever the GL loaders raise: ImportError, AttributeError, RuntimeError, FatalError
        raise OpenGLError from e
    option = mujoco.MjvOption()
    option.geomgroup[3] = 1
    images = []
    with renderer:
        for qpos in recording.qpos:
            _pose(model, data, recording, qpos)
            renderer.update_scene(data, _camera(recording), option)
            _mark(renderer.scene, recording.path)
            pixels = renderer.render().copy()
            pixels[~pixels.any(-1)] = 255
            images.append(pixels)
    return images


def _pose(model: mujoco.MjModel, data: mujoco.MjData, recording: Recording, qpos: np.ndarray) -> None:
    data.qpos[:] = qpos
    base = model.body("gripper_base").mocapid[0]
    data.mocap_pos[base], data.mocap_quat[base] = recording.gripper_pose[:3], recording.gripper_pose[3:]
    mujoco.mj_forward(model, data)


def _camera(recording: Recording) -> mujoco.MjvCamera:
    """Beside the hand, on the side from where the view was taken, looking at the contact and the object around it."""
    turned = np.zeros(9)
    mujoco.mju_quat2Mat(turned, recording.gripper_pose[3:].astype(float))
    approach = np.degrees(np.arctan2(turned[5], turned[2]))
    seen = np.degrees(recording.azimuth)
    camera = mujoco.MjvCamera()
    camera.azimuth = min((approach - 60, approach + 60), key=lambda a: abs((a - seen + 180) % 360 - 180))
    camera.elevation, camera.distance = -30, 2.4
    camera.lookat[:] = 0.6 * recording.path[0]
    return camera


def _mark(scene: mujoco.MjvScene, path: np.ndarray) -> None:
    """The contact point in red, the commanded path of the fingertips in green."""
    capsule, sphere = mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_SPHERE
    for before, after in pairwise(path):
        geom = _added(scene, capsule, np.zeros(3), (0.1, 0.6, 0.2, 1))
        mujoco.mjv_connector(geom, capsule, 0.006, before, after)
    _added(scene, sphere, np.full(3, 0.018), (0.85, 0.1, 0.1, 1)).pos = path[0]


def _added(scene: mujoco.MjvScene, kind: mujoco.mjtGeom, size: np.ndarray, rgba: tuple) -> mujoco.MjvGeom:
    geom = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(geom, kind, size, np.zeros(3), np.eye(3).ravel(), np.array(rgba, np.float32))
    scene.ngeom += 1
    return geom


def _colour(model: mujoco.MjModel) -> None:
    for name in ("object", "part"):
        model.geom_rgba[model.geom_bodyid == model.body(name).id] = COLOURS[name]
    model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.45, 0.55
