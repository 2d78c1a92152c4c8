"""How exact a trajectory has to be: the policy's successes executed again, open loop to the end, as they are and off.

python experiments/replay.py --priors pull-door --data DATA --out results/replay.json
"""

import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import tyro

from vatmart_jax.atomic_io import write_json
from vatmart_jax.data.dataset import Data
from vatmart_jax.envs import TASKS, Env, TrialStart
from vatmart_jax.pipeline.exploration import ExplorationLoop
from vatmart_jax.pipeline.proposal_rollouts import interactions_of
from vatmart_jax.pipeline.run_config import settings_of
from vatmart_jax.pipeline.run_dir import read_config
from vatmart_jax.priors.pretrained import run_folder
from vatmart_jax.trajectory import unpack_trajectory
from vatmart_jax.workflows.evaluate import load_policy


@dataclass(frozen=True)
class ReplayBuffer:
    """The policy's trials stop at success; what of them succeeds when only the trajectory is known?"""

    priors: Path
    """a finished run, or the name of a pretrained one"""
    data: Path
    """what `vatmart convert` made"""
    out: Path
    splits: tuple[str, ...] = ("train", "test_shapes")
    batches: int = 2
    """of trials, per split"""
    noise: tuple[float, ...] = (1e-4, 1e-3, 5e-3, 1e-2, 2e-2)
    """standard deviations of what is added to every residual, unit lengths and rad"""
    elsewhere: float = 0.02
    """distance to another contact of the view, unit lengths; that which comes nearest to it is taken"""
    seed: int = 0


def main(args: ReplayBuffer) -> None:
    folder = run_folder(args.priors)
    config = read_config(folder)
    settings, task = settings_of(config), TASKS[config["task"]]
    found = {}
    for split in args.splits:
        env = Data(args.data).env(split, task, "c", settings.env, settings.physics)
        explorer = ExplorationLoop(env, settings.explore)
        found[split] = study(args, env, explorer, load_policy(folder, explorer))
        print(split, found[split], file=sys.stderr, flush=True)
        write_json(args.out, {"priors": str(args.priors), "seed": args.seed, "splits": found})


def study(args: ReplayBuffer, env: Env, explorer: ExplorationLoop, policy: Any) -> dict[str, Any]:
    """How many of the policy's successes there were, and the shares that succeed again, by what was changed."""
    tolerance, contacts = env.config.tolerance, jnp.asarray(env.views.contacts)

    @jax.jit
    def again(start: TrialStart, trajectory: jax.Array) -> jax.Array:
        rotation, residuals = unpack_trajectory(trajectory)
        return interactions_of(env.execute(start.replace(rotation=rotation), residuals), trajectory).success(tolerance)

    successes, wins, distances = 0, Counter[str](), []
    for batch in range(args.batches):
        k_run, k_noise = jax.random.split(jax.random.fold_in(jax.random.key(args.seed), batch))
        final, _ = explorer.rollout(policy, None, k_run, 0.05, 0.0, terminate_on_failure=False)
        start, made = final.start, interactions_of(final)
        won, trajectory = made.success(tolerance), made.trajectory
        successes += int(won.sum())
        wins["as they are"] += int((won & again(start, trajectory)).sum())
        # A trial that stopped early has zeros from there on; they stay, so that the hand rests there.
        noise = (trajectory != 0).at[:, :6].set(False) * jax.random.normal(k_noise, trajectory.shape)
        for size in args.noise:
            wins[f"off by {size:g}"] += int((won & again(start, trajectory + size * noise)).sum())
        all_contacts = contacts[start.view]
        distance = jnp.linalg.norm(all_contacts - all_contacts[jnp.arange(len(won)), start.contact][:, None], axis=-1)
        other = jnp.argmin(jnp.abs(jnp.where(distance > 0, distance, jnp.inf) - args.elsewhere), -1).astype(jnp.int32)
        distances.append(distance[jnp.arange(len(won)), other])
        wins["elsewhere"] += int((won & again(start.replace(contact=other), trajectory)).sum())
    return {
        "successes": successes,
        "again": {change: round(n / max(1, successes), 4) for change, n in wins.items()},
        "elsewhere_distance": round(float(jnp.median(jnp.concatenate(distances))), 4),
    }


if __name__ == "__main__":
    main(tyro.cli(ReplayBuffer))
