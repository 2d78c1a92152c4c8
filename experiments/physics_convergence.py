"""Is the physics converged, and does the gripper do what it is told? Numbers for docs/physics.md.

    python experiments/physics_convergence.py --data DATA

Per task, over the train Scenes of a converted folder: halving the time step, tracking of the free hand, coasting after
the last waypoint, penetration and violation of the joint's limit when the hand presses on, slip while pulling.
"""

import json
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import tyro

from vatmart_jax.atomic_io import write_json
from vatmart_jax.bench.benchmarks import Choice, device, random_trials
from vatmart_jax.data.banks import SceneBank, ViewBank
from vatmart_jax.envs import TASKS, Env, EnvConfig, EnvState, TrialStart, make_env
from vatmart_jax.envs.scripted_policy import run_scripted_policy
from vatmart_jax.physics import PhysicsConfig
from vatmart_jax.physics.controller import waypoint_controls
from vatmart_jax.physics.gripper import PART
from vatmart_jax.physics.scene_model import scene_model
from vatmart_jax.pipeline.exploration import start_pool
from vatmart_jax.trajectory import WAYPOINTS


@dataclass(frozen=True)
class Study:
    """Converged physics, on `c`."""

    data: Path
    """what `vatmart convert` made"""
    trials: int = 512
    """per task"""
    split: str = "train"
    seed: int = 0
    out: Path = Path(__file__).parent / "results" / "physics-convergence.json"


def time_step(env: Env, finer: Env, start: TrialStart, residuals: jax.Array) -> dict[str, float]:
    """The same trials at half the time step: where the part ends, and the label."""
    a, b = (jax.jit(e.execute)(start, residuals) for e in (env, finer))
    apart = np.abs(np.asarray(a.displacement - b.displacement))
    return {
        "moved": round(float(np.mean(np.abs(a.displacement) > 0.01)), 3),
        "median": float(np.median(apart)),
        "p90": float(np.percentile(apart, 90)),
        "above_0.02": round(float(np.mean(apart > 0.02)), 4),
        "labels_changed": round(float(np.mean(a.success != b.success)), 4),
    }


def uniform_residuals(env: Env, n: int, key: jax.Array) -> jax.Array:
    """[n, 4, 6] anything the action space allows, each axis on its own."""
    limits = jnp.array([env.config.max_translation] * 3 + [env.config.max_rotation] * 3)
    return jax.random.uniform(key, (n, WAYPOINTS, 6), minval=-1.0) * limits


def tracking(env: Env, n: int, key: jax.Array) -> dict[str, float]:
    """How far the hand, in free air, is from its target at the end of a waypoint."""
    physics, config = env.physics, env.config
    nowhere = jnp.tile(jnp.array([-5.0, 0, 0, 1, 0, 0, 0]), (n, 1))
    reach = jnp.array([config.max_translation] * 3 + [config.max_rotation] * 3 + [0.0] * 2)
    target = jax.random.uniform(key, (n, physics.gripper.num_ctrl), minval=-1.0) * reach
    state = jax.jit(physics.reset)(jnp.zeros(n, jnp.int32), nowhere, jnp.zeros((n, physics.gripper.num_ctrl + 1)))
    path = waypoint_controls(jnp.zeros((n, physics.gripper.num_ctrl)), target, physics.config)
    state = jax.jit(physics.rollout)(state, path, jnp.ones(n, bool))
    error = np.abs(np.asarray(state.qpos[:, physics.gripper.hand_qpos] - target[:, :6]))
    place, angle = error[:, :3].max(1), np.degrees(error[:, 3:].max(1))
    return {
        "position_median_mm": 1e3 * float(np.median(place)),
        "position_p95_mm": 1e3 * float(np.percentile(place, 95)),
        "angle_median_deg": float(np.median(angle)),
        "angle_p95_deg": float(np.percentile(angle, 95)),
    }


def coasting(env: Env, final: EnvState) -> dict[str, float]:
    """How far the part would go on without the hand, and how far it goes in another waypoint of the hand standing
    still, which may yet be on its way: its force is limited."""
    config, kind = env.physics.config, env.task.joint_type
    still = jnp.repeat(final.ctrl[:, None], config.steps_per_waypoint, 1)
    later = jax.jit(env.physics.rollout)(final.physics, still, final.valid)
    sound = np.asarray(final.valid)
    drift = np.abs(np.asarray(later.qpos[:, PART] - final.physics.qpos[:, PART]))[sound]
    speed = np.abs(np.asarray(final.physics.qvel[:, PART]))[sound]
    alone = speed * config.part_inertia[kind] / config.part_damping[kind]
    return {
        "without_hand_median": float(np.median(alone)),
        "without_hand_p95": float(np.percentile(alone, 95)),
        "with_hand_median": float(np.median(drift)),
        "with_hand_p95": float(np.percentile(drift, 95)),
    }


def pressing(env: Env, start: TrialStart, trials: int) -> dict[str, float]:
    """The hand presses straight on, 1 unit past the contact: how deep it gets into anything, and the joint past its
    limit. From the contacts that plain MuJoCo finds at the end."""
    residuals = jnp.zeros((len(start.view), WAYPOINTS, 6)).at[:, :, :3].set(0.25 * start.rotation[:, None, :, 2])
    final = jax.device_get(jax.jit(env.execute)(start, residuals))
    depth, past = [], []
    models: dict[int, mujoco.MjModel] = {}
    for i in np.flatnonzero(final.valid)[:trials]:
        scene = int(final.physics.scene[i])
        model = models.setdefault(scene, scene_model(env.bank, scene, env.physics.config))
        data = mujoco.MjData(model)
        data.qpos[:] = final.physics.qpos[i]
        data.mocap_pos[1], data.mocap_quat[1] = np.split(final.physics.gripper_pose[i], [3])
        mujoco.mj_forward(model, data)
        depth.append(-float(data.contact.dist.min()) if data.ncon else 0.0)
        q, width = data.qpos[PART], env.bank.joint_range[scene]
        past.append(max(0.0, -q, q - width))
    share = float(np.mean(np.array(depth) > 0.05))
    return {
        "trials": len(depth),
        "depth_median_mm": 1e3 * float(np.median(depth)),
        "depth_p95_mm": 1e3 * float(np.percentile(depth, 95)),
        "deeper_than_50_mm": round(share, 4),
        "past_limit_median": float(np.median(past)),
        "past_limit_p95": float(np.percentile(past, 95)),
    }


def slip(env: Env, start: TrialStart, key: jax.Array) -> dict[str, float]:
    """How far the fingertips move along the part from the grasp to the end of the scripted expert's pull, of the
    trials that hold."""
    final = run_scripted_policy(env, start, key)
    begun = jax.jit(env.begin_trials)(final.start)
    expected = env.apply_joint_motion(begun, env.tip(begun), final.displacement - begun.displacement)
    held = np.asarray(final.grasp_held & final.valid)
    along = 1e3 * np.linalg.norm(np.asarray(env.tip(final) - expected), axis=-1)[held]
    return {
        "held": round(float(held.mean()), 3),
        "success": round(float(np.mean(final.success)), 3),
        "median_mm": float(np.median(along)),
        "p90_mm": float(np.percentile(along, 90)),
    }


def study(args: Study, name: str, bank: SceneBank, views: ViewBank) -> dict[str, Any]:
    config = PhysicsConfig()
    halved = replace(config, timestep=config.timestep / 2, steps_per_waypoint=2 * config.steps_per_waypoint)
    make = lambda physics: make_env(bank, views, name, "c", EnvConfig(num_envs=args.trials), physics)
    env, finer = make(config), make(halved)
    k_start, k_noise, k_any, k_track = jax.random.split(jax.random.key(args.seed), 4)
    start = start_pool(env, k_start, args.trials)
    noisy = jax.jit(partial(random_trials, env))(start, k_noise)
    result = {
        "scenes": len(np.unique(noisy.physics.scene)),
        "time_step_halved": {
            "noisy_expert": time_step(env, finer, start, noisy.residuals),
            "uniform": time_step(env, finer, start, uniform_residuals(env, args.trials, k_any)),
        },
        "tracking": tracking(env, args.trials, k_track),
        "coasting": coasting(env, noisy),
    }
    if env.task.grasps:
        return {**result, "slip": slip(env, start, k_any)}
    return {**result, "pressing": pressing(env, start, args.trials)}


def main(args: Study) -> None:
    begun = time.monotonic()
    bank, views = Choice(args.data, args.split).banks(args.seed)
    result: dict[str, Any] = {
        "trials_per_task": args.trials, "split": args.split, "collision": bank.collision, "seed": args.seed,
        "device": device(),
    }  # fmt: skip
    for name in TASKS:
        result[name] = study(args, name, bank, views)
        print(name, json.dumps(result[name], indent=2))
    result["seconds"] = round(time.monotonic() - begun, 1)
    write_json(args.out, result)


if __name__ == "__main__":
    main(tyro.cli(Study))
