"""A scripted policy with privileged knowledge of the joint: moves the contact along the part's motion.

It tests the physics, bounds every method from above, and warms the policy up.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from vatmart_jax import rotations as rot
from vatmart_jax.envs.env import Env
from vatmart_jax.envs.types import EnvState, TrialStart
from vatmart_jax.trajectory import WAYPOINTS

CANDIDATES = 8  # starts tried per trial, until one is free and, of a grasp, holds


def scripted_action(env: Env, state: EnvState) -> jax.Array:
    """[B, 6] in [-1, 1] for `env.step`: what remains of the goal, in equal shares over the remaining waypoints.

    The fingertips go where the point of the part that they touch or hold will be, and the hand turns with the part.
    """
    config = env.config
    left = state.start.goal - state.displacement
    share = left / jnp.maximum(WAYPOINTS - state.waypoint, 1)
    tip = env.tip(state)
    # The first push starts off the part: it goes to the contact; later ones go on from where they are.
    touched = jnp.where((state.waypoint == 0) & (not env.task.grasps), state.point, tip)
    target = env.apply_joint_motion(state, touched, share)
    move = rot.unrotate(state.frame, target - tip) / config.max_translation
    turn = jnp.zeros_like(move)
    if env.task.is_hinge:
        turn = turn.at[:, 2].set(share / config.max_rotation)
    return jnp.clip(jnp.concatenate([move, turn], -1), -1, 1)


def scripted_start(env: Env, start: TrialStart, key: jax.Array) -> TrialStart:
    """The policy's contacts and orientations for the views and goals of `start`: of CANDIDATES guided ones, the first
    that is valid. Consumes the key."""
    n = len(start.view)

    def tried(carry, key):
        best, found = carry
        candidate = env.sample_approach(key, start.view, start.goal, 1.0)
        good = env.begin_trials(candidate).valid
        take = good & ~found
        best = jax.tree.map(lambda a, b: jnp.where(take.reshape(-1, *[1] * (a.ndim - 1)), b, a), best, candidate)
        return (best, found | good), None

    first = env.sample_approach(key, start.view, start.goal, 1.0)
    (best, _), _ = jax.lax.scan(tried, (first, jnp.zeros(n, bool)), jax.random.split(key, CANDIDATES))
    return best


@jax.jit
def run_scripted_policy(env: Env, start: TrialStart, key: jax.Array) -> EnvState:
    """The scripted policy's trials at the views and goals of `start`. Consumes the key."""
    begun = env.begin_trials(scripted_start(env, start, key))
    step = lambda state, _: (env.step(state, scripted_action(env, state), terminate_on_failure=False), None)
    return jax.lax.scan(step, begun, length=WAYPOINTS)[0]
