"""MJX on a bank of boxes: how long a step takes, and its parts beside MJX's own.

vatmart generate --out GENERATED --count 24 --seed 1
vatmart convert GENERATED --out BOXES --collision box
taskset -c 0 python experiments/mjx_study.py --data BOXES --out experiments/results/mjx-study.json

`--parts step` runs on commits from before there were parts to compare. NPROC=2 lets callbacks run on one core.
"""

import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import tyro
from mujoco import mjx
from scipy.spatial.transform import Rotation

from vatmart_jax.atomic_io import write_json
from vatmart_jax.bench.common import SceneSubset, device, timed
from vatmart_jax.envs import Env, EnvConfig, EnvState, make_env
from vatmart_jax.physics.controller import waypoint_controls

STEPS = 40  # physics steps of a push
OVERLAP = 1e-3  # of two boxes, along a random direction


@dataclass(frozen=True)
class MjxStudy:
    data: Path
    """a box bank and its views"""
    out: Path
    parts: tuple[str, ...] = ("step", "solver", "contacts")
    batch: int = 256
    task: str = "push-drawer"
    pairs: int = 3000
    seconds: float = 5.0
    seed: int = 0


def pressing(env: Env, state: EnvState) -> jax.Array:
    """[B, T, nu] controls of a steady push."""
    tip = state.tip + 0.05 * state.start.rotation[:, :, 2]
    target = env.physics.gripper.targets(tip, state.euler, state.start.rotation, jnp.zeros(len(tip)))
    return waypoint_controls(state.ctrl, target, env.physics.config)


def step(env: Env, state: EnvState, seconds: float) -> dict[str, float]:
    """Microseconds of a simulation and physics step."""
    push = jax.jit(lambda state: env.physics.rollout(state.physics, pressing(env, state)[:, :STEPS], state.valid))
    timing = timed(lambda _: push(state), seconds)
    batch = len(state.valid)
    return {
        "microseconds": round(1e6 * timing.seconds / batch / STEPS, 2),
        "compile_seconds": round(timing.compile_seconds, 1),
    }


def solver(env: Env, state: EnvState, seconds: float) -> dict[str, Any]:
    """Microseconds of a simulation by ours and by mjx.solve in the middle of a push, and what is left to gain."""
    from vatmart_jax.physics import mjx_solver
    from vatmart_jax.physics.backend_mjx import ITERATIONS, LS_ITERATIONS

    physics: Any = env.physics
    ctrl = pressing(env, state)
    middle = jax.jit(lambda: physics.rollout(state.physics, ctrl[:, :50], state.valid))()
    rows, pose = physics._rows(middle.scene), middle.gripper_pose
    warm = jax.lax.bitcast_convert_type(middle.backend_state, jnp.float32)
    near = jax.jit(jax.vmap(physics._nearest))(rows, pose, middle.qpos)
    begun = middle.qpos, middle.qvel, warm
    data = jax.jit(jax.vmap(physics._unconstrained))(rows, pose, near, begun, ctrl[:, 50])
    found = data._impl
    problem = mjx_solver.Problem(found.M, data.qacc_smooth, found.efc_J, found.efc_D, found.efc_aref)
    options = physics._model.opt.replace(iterations=ITERATIONS, ls_iterations=LS_ITERATIONS)
    theirs = jax.jit(jax.vmap(lambda data: mjx.solve(physics._model.replace(opt=options), data).qacc))
    ours = jax.jit(
        lambda problem, warm, limit: mjx_solver.solve(problem, warm, iterations=limit, ls_iterations=LS_ITERATIONS)[0],
        static_argnums=2,
    )
    last = jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), problem)
    cost = lambda qacc: np.asarray(last.cost(qacc.T, last.residual(qacc.T)))
    batch, best = len(warm), ours(problem, warm, 20)
    spent = {}
    for name, call in (("ours", lambda _: ours(problem, warm, ITERATIONS)), ("mjx", lambda _: theirs(data))):
        timing = timed(call, seconds)
        excess = (cost(timing.result) - cost(best)) / (cost(best) + 1e-3)
        spent[name] = {
            "microseconds": round(1e6 * timing.seconds / batch, 2),
            "cost_above_best": {"median": float(np.median(excess)), "p99": float(np.quantile(excess, 0.99))},
        }
    settled = (np.abs(np.asarray(ours(problem, warm, mjx_solver.ALL_ITERATIONS) - best)).max(1) < 1e-3).mean()
    return spent | {
        "rows": int(found.efc_J.shape[1]),
        "simulations_in_contact": round(float((found.contact.dist < 0).any(1).mean()), 3),
        "settled_after_the_first_iterations": round(float(settled), 3),
    }


def contacts(pairs: int, seed: int) -> dict[str, Any]:
    """Of boxes that overlap a little: how far the deepest contact is from C's, by ours and by MJX's own kernel."""
    from mujoco.mjx._src import mesh
    from mujoco.mjx._src.collision_convex import _box_box
    from mujoco.mjx._src.collision_types import GeomInfo

    from vatmart_jax.physics.mjx_boxes import Boxes, box_contacts

    rng = np.random.default_rng(seed)
    half = rng.uniform(0.01, 0.5, (pairs, 3)), rng.uniform(0.005, 0.04, (pairs, 3))
    board = Rotation.random(pairs, rng=rng)
    nearly = (board * Rotation.from_rotvec(rng.normal(0, 0.05, (pairs, 3)))).as_matrix()
    anyhow = Rotation.random(pairs, rng=rng).as_matrix()
    finger = np.where(np.arange(pairs)[:, None, None] % 2, nearly, anyhow)
    boxes = lambda *x: Boxes(*(jnp.asarray(v, jnp.float32) for v in x))
    first = boxes(rng.normal(0, 0.1, (pairs, 3)), board.as_matrix(), half[0])
    direction = rng.normal(size=(pairs, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    inside = np.asarray(first.pos) + board.apply(rng.uniform(-0.6, 0.6, (pairs, 3)) * half[0])
    ours = jax.jit(box_contacts)
    near, far = np.zeros(pairs), np.full(pairs, 2.0)
    for _ in range(30):
        middle = 0.5 * (near + far)
        touch = np.asarray(ours(first, boxes(inside + middle[:, None] * direction, finger, half[1]))[0].min(0) < 0)
        near, far = np.where(touch, middle, near), np.where(touch, far, middle)
    second = boxes(inside + (near - OVERLAP)[:, None] * direction, finger, half[1])

    def convex(box: Boxes) -> Any:
        shape = mesh.box(GeomInfo(*(x[None] for x in box)))
        return shape.replace(pos=box.pos, mat=box.mat, size=box.half, face=shape.face[0], vert=shape.vert[0])

    kernel = jax.jit(jax.vmap(lambda a, b: _box_box(convex(a), convex(b))[:2]))
    dist, pos, _ = ours(first, second)
    found = {"ours": (dist.T, pos.swapaxes(0, 1)), "mjx": kernel(first, second)}
    reference = [_deepest_of_c(first, second, k) for k in range(pairs)]
    touching = np.array([c is not None for c in reference])
    result: dict[str, Any] = {"pairs": pairs, "touching": int(touching.sum())}
    for name, (dist, pos) in found.items():
        rows = np.flatnonzero(touching)
        dist, pos = np.asarray(dist)[rows], np.asarray(pos)[rows]
        deepest = dist.argmin(1)
        wanted = [c for c in reference if c is not None]
        off = {
            "distance": np.abs(dist.min(1) - np.array([c[0] for c in wanted])),
            # C may have several contacts that are as deep.
            "position": np.array(
                [
                    min(np.linalg.norm(p - pos[i, d]) for p in c[1])
                    for i, (d, c) in enumerate(zip(deepest, wanted, strict=True))
                ]
            ),
        }
        result[name] = {
            what: {"median": float(np.median(x)), "p99": float(np.quantile(x, 0.99))} for what, x in off.items()
        }
    return result


def _deepest_of_c(first: Any, second: Any, k: int) -> tuple[float, list[np.ndarray]] | None:
    """Distance of the deepest contact in C, and the positions of all."""
    spec = mujoco.MjSpec()
    for box, mocap in ((first, True), (second, False)):
        quat = Rotation.from_matrix(np.asarray(box.mat[k], float)).as_quat(scalar_first=True)
        body = spec.worldbody.add_body(pos=np.asarray(box.pos[k], float), quat=quat, mocap=mocap)
        if not mocap:
            body.add_freejoint()
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=np.asarray(box.half[k], float))
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    found = [(c.dist, c.pos.copy()) for c in data.contact]
    return (min(d for d, _ in found), [p for _, p in found]) if found else None


def main(args: MjxStudy) -> None:
    bank, views = SceneSubset(args.data, split="all").banks(args.seed)
    env = make_env(bank, views, args.task, "jax", EnvConfig(num_envs=args.batch))
    state = jax.jit(env.begin_trials)(env.sample(jax.random.key(args.seed), args.batch))
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True)
    result: dict[str, Any] = {
        "commit": commit.stdout.strip(),
        "seed": args.seed,
        "batch": args.batch,
        "task": args.task,
        "objects": len(np.unique(env.bank.object_id)),
        "scenes": len(env.bank),
        "device": device(),
    }
    if "step" in args.parts:
        result["step"] = step(env, state, args.seconds)
    if "solver" in args.parts:
        result["solver"] = solver(env, state, args.seconds)
    if "contacts" in args.parts:
        result["contacts"] = contacts(args.pairs, args.seed)
    print(result)
    write_json(args.out, result)


if __name__ == "__main__":
    main(tyro.cli(MjxStudy))
