"""Many trials with random actions over all objects of a converted folder: does any number escape, does anything crash?

vatmart convert REAL --out DATA; python experiments/random_trials.py --data DATA --out million.json

Rerunning the command resumes an interrupted run. Exit code 1 if a number that is not finite got out.
"""

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from vatmart_jax.atomic_io import write_json
from vatmart_jax.data.banks import SceneBank, ViewBank
from vatmart_jax.envs import TASKS, Env, EnvConfig, make_env
from vatmart_jax.trajectory import WAYPOINTS


@dataclass(frozen=True)
class RandomTrials:
    """Trials with uniformly random actions, the four tasks alike, over all Scenes with views."""

    data: Path
    """what `vatmart convert` made"""
    out: Path
    """JSON file; what it holds already is not done again"""
    trials: int = 1_000_000
    batch: int = 1024
    impl: str = "c"
    seed: int = 0


def main(args: RandomTrials) -> None:
    bank, views = SceneBank.load(args.data / "scenes.npz"), ViewBank.load(args.data / "views.npz")
    settings = {"impl": args.impl, "batch": args.batch, "seed": args.seed, "trials_wanted": args.trials}
    result = json.loads(args.out.read_text()) if args.out.is_file() else {**settings, "seconds": 0.0, "tasks": {}}
    if {name: result.get(name) for name in settings} != settings:
        sys.exit(f"{args.out}: made with other settings; remove it or name another file")
    batches = -(-args.trials // (len(TASKS) * args.batch))
    escaped = 0
    for number, task in enumerate(TASKS.values()):
        env = make_env(bank, views, task, args.impl, EnvConfig(num_envs=args.batch))
        counts = result["tasks"].setdefault(
            task.name, {"objects": len(np.unique(env.bank.object_id)), "scenes": len(env.bank), "batches": 0}
        )
        run = jax.jit(lambda key, env=env: _trials(env, key))
        while counts["batches"] < batches:
            start = time.monotonic()
            key = jax.random.fold_in(jax.random.fold_in(jax.random.key(args.seed), number), counts["batches"])
            for name, value in jax.device_get(run(key)).items():
                counts[name] = counts.get(name, 0) + int(value)
            counts["batches"] += 1
            result["seconds"] = round(result["seconds"] + time.monotonic() - start, 2)
            write_json(args.out, result)
            if counts["batches"] % 16 == 0 or counts["batches"] == batches:
                print(f"{task.name} {counts['batches']}/{batches}: {counts}", file=sys.stderr, flush=True)
        escaped += counts["not_finite"]
    sys.exit(int(escaped > 0))


def _trials(env: Env, key: jax.Array) -> dict[str, jax.Array]:
    """Counts over one batch. Trials go on after a success or a lost grip: random actions all the way."""
    k_reset, k_policy = jax.random.split(key)
    begun = env.reset(k_reset)

    def step(state, key):
        action = jax.random.uniform(key, (len(state.done), env.action_size), minval=-1, maxval=1)
        state = env.step(state, action, terminate_on_failure=False)
        return state, _not_finite(state)

    final, bad = jax.lax.scan(step, begun, jax.random.split(k_policy, WAYPOINTS))
    diverged = final.physics.diverged
    return {
        "trials": jnp.int32(len(final.done)),
        "in_collision": final.in_collision.sum(),
        "no_grasp": (~begun.in_collision & ~begun.grasp_held).sum(),
        "lost_grip": (begun.valid & ~final.grasp_held & ~diverged).sum(),
        "diverged": diverged.sum(),
        "success": final.success.sum(),
        "not_finite": (_not_finite(begun) | bad.any(0)).sum(),
    }


def _not_finite(state) -> jax.Array:
    """[B] bool: something that a policy, a network or a reader of results gets to see is not a number."""
    rows = (state.obs, state.reward, state.displacement, state.trajectory, state.physics.qpos, state.physics.qvel)
    return jnp.stack([~jnp.isfinite(x.reshape(len(x), -1)).all(1) for x in rows]).any(0)


if __name__ == "__main__":
    main(tyro.cli(RandomTrials))
