"""Trials become samples for the perception networks: by the policy, or by the networks' own proposals."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp

from vatmart_jax import geometry as g
from vatmart_jax.env import Env, EnvState, Start
from vatmart_jax.perception.networks import Networks, Params
from vatmart_jax.perception.train import Clouds, Samples, propose_trajectories, select_actions


def samples_of(final: EnvState, trajectory: jax.Array | None = None) -> Samples:
    """The samples [B] that finished trials make; `trajectory` [B, 30] where it is not what the state recorded."""
    start = final.start
    return Samples(
        start.view,
        start.contact,
        start.task,
        final.trajectory if trajectory is None else trajectory,
        final.moved,
        final.valid & final.held,
    )


def curious(samples: Samples, score: jax.Array, tolerance: float) -> Samples:
    """The samples that the curiosity stage teaches, the rest emptied (paper, appendix C).

    Successes are half surprising (score [B] below 0.5) and half expected ones, failures as many as successes.
    """
    success = samples.success(tolerance)
    novel, known, failed = success & (score < 0.5), success & (score >= 0.5), ~success
    known &= jnp.cumsum(known) <= jnp.maximum(novel.sum(), 1)
    failed &= jnp.cumsum(failed) <= jnp.maximum((novel | known).sum(), 1)
    return samples.replace(view=jnp.where(novel | known | failed, samples.view, -1))


class ProposalTrials:
    """Executes what the networks propose in an environment whose views are `clouds`."""

    def __init__(self, env: Env, clouds: Clouds, networks: Networks, proposals: int):
        self._env, self._clouds, self._networks, self._proposals = env, clouds, networks, proposals
        self._execute = jax.jit(self._executed)
        self._sample = jax.jit(lambda key: env.sample(key, env.config.batch))

    def _executed(self, start: Start, trajectory: jax.Array) -> EnvState:
        rotation, residuals = g.unpack_trajectory(trajectory)
        return self._env.execute(start.replace(rotation=rotation), residuals)

    def best(self, params: Params, start: Start, key: jax.Array) -> tuple[EnvState, jax.Array, jax.Array]:
        """The networks' choice for the views and tasks of `start`: final states, trajectories [B, 30], scores [B].

        Consumes the key.
        """
        chosen = select_actions(self._networks, params, self._clouds, start.view, start.task, key, self._proposals)
        final = self._execute(replace(start, contact=chosen.contact), chosen.trajectory)
        return final, chosen.trajectory, chosen.score

    def explore(self, params: Params, key: jax.Array) -> tuple[EnvState, Samples]:
        """A batch of random views and tasks: half the networks' choice, half at random contacts, there half the best
        and half any proposal. Consumes the key.
        """
        ks, kb, kp, kc = jax.random.split(key, 4)
        start = self._sample(ks)
        chosen = select_actions(self._networks, params, self._clouds, start.view, start.task, kb, self._proposals)
        proposed, score = propose_trajectories(
            self._networks, params, self._clouds, start.view, start.contact, start.task, kp, self._proposals
        )
        contact, trajectory = _mixed(chosen, start.contact, proposed, score, kc)
        final = self._execute(replace(start, contact=contact), trajectory)
        return final, samples_of(final, trajectory)


@partial(jax.jit)
def _mixed(chosen, contact, proposed, score, key):
    rows = jnp.arange(len(contact))
    own, best = rows % 2 == 0, rows % 4 == 1
    pick = jnp.where(best, score.argmax(1), jax.random.randint(key, contact.shape, 0, score.shape[1]))
    trajectory = jnp.where(own[:, None], chosen.trajectory, proposed[rows, pick])
    return jnp.where(own, chosen.contact, contact), trajectory
