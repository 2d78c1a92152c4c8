"""What trained networks say of views: where to act, how, and how likely that is to do the task.

An `Ensemble` asks several networks about a view and about mirrored and turned copies of it; the scores it gives are
means.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vatmart_jax.perception.clouds import Clouds
from vatmart_jax.perception.networks import Features, Networks, Params
from vatmart_jax.perception.pointnet2 import Grouping
from vatmart_jax.perception.transform import Transform, spread


@dataclass(frozen=True)
class Ensemble:
    """`members` networks of the same kind, each asked about `copies` of a view (1: the view alone).

    Parameters are those of one network or, where there are several, stacked along a leading dimension. Heads broadcast
    as those of `Networks` do, with features that carry a leading dimension for the answers of every member about every
    copy; contacts and trajectories are those of the view as it is.
    """

    networks: Networks
    copies: int = 1
    members: int = 1

    def features(
        self, params: Params, points: jax.Array, grouping: Grouping, which: jax.Array | None = None
    ) -> Features:
        """Features [members * copies, Q, F] of one view: points [N, 3], which [Q] int into the grouping's queries
        (None: all)."""

        def answer(member: Params, transform: Transform) -> Features:
            queries = transform.points(grouping.queries)
            return self.networks.features(member, transform.points(points), grouping.replace(queries=queries), which)

        # By turns: the groups of one copy fill the caches.
        of_member = lambda member: jax.lax.map(partial(answer, member), spread(self.copies))  # noqa: E731
        if self.members == 1:
            return of_member(params)
        return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), jax.lax.map(of_member, params))

    def actionability(self, params: Params, f: Features, contact: jax.Array, task: jax.Array) -> jax.Array:
        """Actionability [...] as a probability."""
        return self._mean(lambda p, t, f: self.networks.actionability(p, f, t.points(contact), task), params, f)

    def score(
        self, params: Params, f: Features, contact: jax.Array, task: jax.Array, trajectory: jax.Array
    ) -> jax.Array:
        """Probability [...] that the trajectory does the task."""

        def logit(params: Params, transform: Transform, f: Features) -> jax.Array:
            return self.networks.score(params, f, transform.points(contact), task, transform.trajectory(trajectory))

        return self._mean(logit, params, f)

    def propose(
        self, params: Params, f: Features, contact: jax.Array, task: jax.Array, key: jax.Array, count: int
    ) -> tuple[jax.Array, jax.Array]:
        """Trajectories [..., count, 30] for the view as it is, of the members by turns, and their scores.

        Contacts [..., 3] and tasks [...]. Those made for the copies and brought back succeed less (docs/learning.md).
        Consumes the key.
        """
        each = -(-count // self.members)
        z = jax.random.normal(key, (self.members, each, self.networks.config.latent_dim))
        contact, task = contact[..., None, :], task[..., None]
        f = Features(*(x[..., None, :] for x in f))
        itself = Features(*(x[:: self.copies] for x in f))
        of_member = lambda p, f, z: self.networks.propose(p, f, contact, task, z)  # noqa: E731
        proposed = jax.vmap(of_member, (0 if self.members > 1 else None, 0, 0), -2)(params, itself, z)
        proposed = proposed.reshape(*proposed.shape[:-3], -1, proposed.shape[-1])[..., :count, :]
        return proposed, self.score(params, f, contact, task, proposed)

    def _mean(self, logit: Callable[..., jax.Array], params: Params, f: Features) -> jax.Array:
        """The mean probability [...] of all answers; logit: of a member's parameters, a transform and features."""
        transforms = jax.tree.map(lambda a: jnp.tile(a, self.members), spread(self.copies))
        axis = None
        if self.members > 1:
            axis, params = 0, jax.tree.map(lambda a: jnp.repeat(a, self.copies, 0), params)
        probability = lambda *of_one: jax.nn.sigmoid(logit(*of_one))  # noqa: E731
        return jax.vmap(probability, (axis, 0, 0))(params, transforms, f).mean(0)


class Selection(NamedTuple):
    """What the networks would do in B views."""

    contact: jax.Array  # [B] int32, index into the view's contacts
    trajectory: jax.Array  # [B, 30]
    score: jax.Array  # [B] probability
    actionability: jax.Array  # [B, C] probability


@partial(jax.jit, static_argnames=("ensemble", "n_proposals"))
def select_actions(
    ensemble: Ensemble,
    params: Params,
    clouds: Clouds,
    view: jax.Array,
    task: jax.Array,
    key: jax.Array,
    n_proposals: int = 100,
) -> Selection:
    """The contact of highest actionability in each view [B], and its best-scored of n_proposals trajectories.

    task: [B] > 0, rad or unit lengths. Consumes the key (paper, B: downstream manipulation).
    """

    def select(view: jax.Array, task: jax.Array, key: jax.Array) -> Selection:
        contacts = clouds.contacts[view]
        f = _encode(ensemble, params, clouds, view)
        actionability = ensemble.actionability(params, f, contacts, task)
        contact = jnp.argmax(actionability).astype(jnp.int32)
        at = Features(*(x[:, contact] for x in f))
        trajectory, score = ensemble.propose(params, at, contacts[contact], task, key, n_proposals)
        best = jnp.argmax(score)
        return Selection(contact, trajectory[best], score[best], actionability)

    return _over_rows(select, view, task, jax.random.split(key, len(view)))


@partial(jax.jit, static_argnames=("ensemble", "n_proposals"))
def propose_trajectories(
    ensemble: Ensemble,
    params: Params,
    clouds: Clouds,
    view: jax.Array,
    contact: jax.Array,
    task: jax.Array,
    key: jax.Array,
    n_proposals: int = 100,
) -> tuple[jax.Array, jax.Array]:
    """Proposals [B, P, 30] and their scores [B, P] (probabilities) at given contacts [B] int. Consumes the key."""

    def propose(view: jax.Array, contact: jax.Array, task: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        f = _encode(ensemble, params, clouds, view, contact)
        return ensemble.propose(params, f, clouds.contacts[view, contact], task, key, n_proposals)

    return _over_rows(propose, view, contact, task, jax.random.split(key, len(view)))


@partial(jax.jit, static_argnames=("ensemble", "n_proposals"))
def explore_actions(
    ensemble: Ensemble,
    params: Params,
    clouds: Clouds,
    view: jax.Array,
    contact: jax.Array,
    task: jax.Array,
    key: jax.Array,
    n_proposals: int = 100,
) -> tuple[jax.Array, jax.Array]:
    """What to try for views [V], T tasks in each [V, T]; one encoder pass per view serves all of them.

    Of four tasks in a row, the first gets what `select_actions` would choose; the second the best proposal at a contact
    drawn by actionability, the third at the given contact [V, T], and the last any proposal there. Returns contacts
    [V, T] and trajectories [V, T, 30]. Consumes the key.
    """

    def explore(view: jax.Array, contact: jax.Array, task: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        k_contact, k_proposals, k_pick = jax.random.split(key, 3)
        contacts = clouds.contacts[view]
        f = _encode(ensemble, params, clouds, view)
        actionability = ensemble.actionability(params, f, contacts, task[:, None])  # [T, C]
        kind = jnp.arange(len(task)) % 4
        drawn = jax.random.categorical(k_contact, jnp.log(actionability))
        contact = jnp.select([kind == 0, kind == 1], [jnp.argmax(actionability, -1), drawn], contact).astype(jnp.int32)
        at = Features(*(x[:, contact] for x in f))
        trajectory, score = ensemble.propose(params, at, contacts[contact], task, k_proposals, n_proposals)
        pick = jnp.where(kind == 3, jax.random.randint(k_pick, kind.shape, 0, n_proposals), score.argmax(-1))
        return contact, trajectory[jnp.arange(len(task)), pick]

    return _over_rows(explore, view, contact, task, jax.random.split(key, len(view)))


@partial(jax.jit, static_argnames=("ensemble",))
def score_trajectories(
    ensemble: Ensemble,
    params: Params,
    clouds: Clouds,
    view: jax.Array,
    contact: jax.Array,
    task: jax.Array,
    trajectory: jax.Array,
) -> jax.Array:
    """Probability [B] that trajectories [B, 30] from contacts [B] int do the tasks [B]."""

    def score(view: jax.Array, contact: jax.Array, task: jax.Array, trajectory: jax.Array) -> jax.Array:
        f = _encode(ensemble, params, clouds, view, contact)
        return ensemble.score(params, f, clouds.contacts[view, contact], task, trajectory)

    return _over_rows(score, view, contact, task, trajectory)


def _encode(
    ensemble: Ensemble, params: Params, clouds: Clouds, view: jax.Array, contact: jax.Array | None = None
) -> Features:
    """Features [copies, C, F] of one view's contacts, or [copies, F] of one of them."""
    points, grouping = jax.tree.map(lambda a: a[view], (clouds.points, clouds.grouping))
    if contact is None:
        return ensemble.features(params, points, grouping)
    return Features(*(x[:, 0] for x in ensemble.features(params, points, grouping, contact[None])))


def _over_rows(function: Callable, *rows: jax.Array):
    """function over the leading dimension, some rows at a time: a whole batch's groups would not fit into memory."""
    return jax.lax.map(lambda row: function(*row), rows, batch_size=min(16, len(rows[0])))
