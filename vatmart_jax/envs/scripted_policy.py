"""A scripted expert with privileged knowledge of the joint: pushes along the part's motion, or pulls along it.

It tests the physics, shows how far the gripper can get (the ceiling of every method), and warms the policy up.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from vatmart_jax import rotations as rot
from vatmart_jax.data.banks import HINGE
from vatmart_jax.envs.env import Env, EnvState, Start
from vatmart_jax.trajectory import WAYPOINTS

CANDIDATES = 8  # starts tried per trial, until one is free and, when pulling, its grasp holds


def expert_action(env: Env, state: EnvState) -> jax.Array:
    """[B, 6] in [-1, 1] for `env.step`: what is left of the task, in equal shares over the waypoints that are left.

    The fingertips go where the point of the part that they touch or hold will be, and the hand turns with the part.
    """
    config = env.config
    left = state.start.task - state.moved
    share = left / jnp.maximum(WAYPOINTS - state.waypoint, 1)
    tip = env.tip(state)
    # The first push starts off the part: it goes to the contact; later ones go on from where they are.
    touched = jnp.where((state.waypoint == 0) & (not env.task.opening), state.point, tip)
    target = env.carried(state, touched, share)
    move = rot.unrotate(state.frame, target - tip) / config.move_range
    turn = jnp.zeros_like(move)
    if env.task.joint_type == HINGE:
        turn = turn.at[:, 2].set(share / config.turn_range)
    return jnp.clip(jnp.concatenate([move, turn], -1), -1, 1)


def expert_start(env: Env, start: Start, key: jax.Array) -> Start:
    """Contacts and orientations of the expert's choice for the views and tasks of `start`: of CANDIDATES promising
    ones, the first that is valid. Consumes the key."""
    n = len(start.view)

    def tried(carry, key):
        best, found = carry
        candidate = env.approach(key, start.view, start.task, 1.0)
        good = env.begin(candidate).valid
        take = good & ~found
        best = jax.tree.map(lambda a, b: jnp.where(take.reshape(-1, *[1] * (a.ndim - 1)), b, a), best, candidate)
        return (best, found | good), None

    first = env.approach(key, start.view, start.task, 1.0)
    (best, _), _ = jax.lax.scan(tried, (first, jnp.zeros(n, bool)), jax.random.split(key, CANDIDATES))
    return best


@partial(jax.jit, static_argnums=0)
def run_expert(env: Env, start: Start, key: jax.Array) -> EnvState:
    """The expert's trials at the views and tasks of `start`. Consumes the key."""
    begun = env.begin(expert_start(env, start, key))
    step = lambda state, _: (env.step(state, expert_action(env, state), False), None)  # noqa: E731
    return jax.lax.scan(step, begun, length=WAYPOINTS)[0]
