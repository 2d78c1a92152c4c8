"""Trials become samples for the perception networks: by the policy, or by the networks' own proposals."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp

from vatmart_jax.envs import Env, EnvState, TrialStart
from vatmart_jax.perception.grouped_views import GroupedViews
from vatmart_jax.perception.interaction_buffer import Interactions
from vatmart_jax.perception.layers import Params
from vatmart_jax.perception.predictor import TTAPredictor, explore_actions, select_actions
from vatmart_jax.trajectory import unpack_trajectory


def interactions_of(final: EnvState, trajectory: jax.Array | None = None) -> Interactions:
    """The samples [B] that finished trials make; `trajectory` [B, 30] where the networks proposed it."""
    start = final.start
    return Interactions(
        view=start.view,
        contact=start.contact,
        goal=start.goal,
        trajectory=final.trajectory if trajectory is None else trajectory,
        displacement=final.displacement,
        valid=final.valid & final.grasp_held,
        from_proposal=jnp.full(start.view.shape, trajectory is not None),
    )


def curious(samples: Interactions, score: jax.Array, tolerance: float) -> Interactions:
    """The samples that the curiosity stage teaches, the rest emptied (paper, appendix C).

    Successes are half surprising (score [B] below 0.5) and half expected ones, failures as many as successes.
    """
    success = samples.success(tolerance)
    novel, known, failed = success & (score < 0.5), success & (score >= 0.5), ~success
    known &= jnp.cumsum(known) <= jnp.maximum(novel.sum(), 1)
    failed &= jnp.cumsum(failed) <= jnp.maximum((novel | known).sum(), 1)
    return samples.replace(view=jnp.where(novel | known | failed, samples.view, -1))


TASKS_PER_VIEW = 8


class ProposalTrials:
    """Executes what the networks propose in an environment whose views are `grouped_views`."""

    def __init__(self, env: Env, grouped_views: GroupedViews, predictor: TTAPredictor, proposals: int):
        grouped_views.check_same_views(env.views)
        self._env, self._grouped_views, self._ensemble, self._proposals = env, grouped_views, predictor, proposals
        self._execute = jax.jit(self._executed)
        self._sample_by_view = jax.jit(self._sampled_by_view)

    def _executed(self, start: TrialStart, trajectory: jax.Array) -> EnvState:
        rotation, residuals = unpack_trajectory(trajectory)
        return self._env.execute(start.replace(rotation=rotation), residuals)

    def _sampled_by_view(self, key: jax.Array) -> TrialStart:
        """A batch of starts in which every TASKS_PER_VIEW in a row share a view."""
        kv, kt, ka = jax.random.split(key, 3)
        view = jnp.repeat(
            self._env.sample(kv, max(1, self._env.config.num_envs // TASKS_PER_VIEW)).view, TASKS_PER_VIEW
        )
        return self._env.sample_approach(ka, view, self._env.sample_goal(kt, view), self._env.config.guided_fraction)

    def best(self, params: Params, start: TrialStart, key: jax.Array) -> tuple[EnvState, jax.Array, jax.Array]:
        """The networks' choice for the views and tasks of `start`: final states, trajectories [B, 30], scores [B].

        Consumes the key.
        """
        chosen = select_actions(
            self._ensemble, params, self._grouped_views, start.view, start.goal, key=key, num_proposals=self._proposals
        )
        final = self._execute(replace(start, contact=chosen.contact), chosen.trajectory)
        return final, chosen.trajectory, chosen.score

    def explore(self, params: Params, key: jax.Array) -> tuple[EnvState, Interactions, jax.Array]:
        """A batch of trials to learn from, several tasks in each random view: see `explore_actions`.

        Returns final states, samples, and which of them [B] bool are the networks' choice. Consumes the key.
        """
        ks, ke = jax.random.split(key)
        start = self._sample_by_view(ks)
        rows = (-1, TASKS_PER_VIEW)
        contact, trajectory = explore_actions(
            self._ensemble, params, self._grouped_views, start.view.reshape(rows)[:, 0], start.contact.reshape(rows),
            goal=start.goal.reshape(rows), key=ke, num_proposals=self._proposals,
        )  # fmt: skip
        trajectory = trajectory.reshape(len(start.view), -1)
        final = self._execute(replace(start, contact=contact.reshape(-1)), trajectory)
        return final, interactions_of(final, trajectory), jnp.arange(len(trajectory)) % 4 == 0
