"""The environment alone: random actions and the scripted expert on a converted folder, any physics.

vatmart generate --out objects --count 10 && vatmart convert objects --out data
python experiments/env_example.py --data data --task push-door --impl c
"""

import time
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import tyro

from vatmart_jax.data.banks import SceneBank, ViewBank
from vatmart_jax.envs import EnvConfig, make_env
from vatmart_jax.envs.scripted_policy import scripted_action
from vatmart_jax.trajectory import WAYPOINTS


@dataclass(frozen=True)
class Example:
    """Run a batch of trials twice: with random actions, and with those of the scripted expert."""

    data: Path
    """what `vatmart convert` made"""
    task: str = "push-door"
    impl: str = "c"
    batch: int = 64
    seed: int = 0


def main(args: Example) -> None:
    bank, views = SceneBank.load(args.data / "scenes.npz"), ViewBank.load(args.data / "views.npz")
    env = make_env(bank, views, args.task, args.impl, EnvConfig(num_envs=args.batch))
    policies = {
        "random": lambda state, key: jax.random.uniform(key, (args.batch, env.action_size), minval=-1, maxval=1),
        "expert": lambda state, key: scripted_action(env, state),
    }
    print(f"{args.task}, {args.impl}: {len(env.bank)} Scenes, {len(env.views)} views, {args.batch} trials")
    for name, policy in policies.items():

        @jax.jit
        def episode(key, policy=policy):
            k_reset, k_policy = jax.random.split(key)

            def step(state, key):
                state = env.step(state, policy(state, key))
                return state, state.reward

            return jax.lax.scan(step, env.reset(k_reset), jax.random.split(k_policy, WAYPOINTS))

        jax.block_until_ready(episode(jax.random.key(args.seed)))
        begun = time.perf_counter()
        final, rewards = jax.block_until_ready(episode(jax.random.key(args.seed + 1)))
        seconds = time.perf_counter() - begun
        started = jnp.maximum((~final.in_collision).sum(), 1)
        print(
            f"{name}: return {rewards.sum(0).mean():.0f}, success {final.success.mean():.2f} of all and "
            f"{final.success.sum() / started:.2f} of free starts, {args.batch / seconds:.0f} trials/s"
        )


if __name__ == "__main__":
    main(tyro.cli(Example))
