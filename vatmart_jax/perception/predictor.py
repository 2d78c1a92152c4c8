"""What trained networks say of views: where to act, how, and how likely that is to do the task.

An `Ensemble` asks them about a view and about mirrored and turned copies of it; the scores it gives are means.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vatmart_jax.perception.augmentation import Transform, spread
from vatmart_jax.perception.grouped_views import Clouds
from vatmart_jax.perception.networks import Features, Networks, Params
from vatmart_jax.perception.pointnet2 import Grouping


@dataclass(frozen=True)
class Ensemble:
    """The networks, asked about `copies` of a view (1: the view alone).

    Heads broadcast as those of `Networks` do, with features that carry a leading dimension for the copies; contacts
    and trajectories are those of the view as it is.
    """

    networks: Networks
    copies: int = 1

    def features(
        self, params: Params, points: jax.Array, grouping: Grouping, which: jax.Array | None = None
    ) -> Features:
        """Features [copies, Q, F] of one view: points [N, 3], which [Q] int into the grouping's queries (None: all)."""

        def of_copy(transform: Transform) -> Features:
            queries = transform.points(grouping.queries)
            return self.networks.features(params, transform.points(points), grouping.replace(queries=queries), which)

        return jax.lax.map(of_copy, spread(self.copies))  # by turns: the groups of one copy fill the caches

    def actionability(self, params: Params, f: Features, contact: jax.Array, task: jax.Array) -> jax.Array:
        """Actionability [...] as a probability."""
        of_copy = lambda t, f: jax.nn.sigmoid(self.networks.actionability(params, f, t.points(contact), task))  # noqa: E731
        return jax.vmap(of_copy)(spread(self.copies), f).mean(0)

    def score(
        self, params: Params, f: Features, contact: jax.Array, task: jax.Array, trajectory: jax.Array
    ) -> jax.Array:
        """Probability [...] that the trajectory does the task."""

        def of_copy(transform: Transform, f: Features) -> jax.Array:
            asked = transform.points(contact), task, transform.trajectory(trajectory)
            return jax.nn.sigmoid(self.networks.score(params, f, *asked))

        return jax.vmap(of_copy)(spread(self.copies), f).mean(0)

    def propose(
        self, params: Params, f: Features, contact: jax.Array, task: jax.Array, key: jax.Array, count: int
    ) -> tuple[jax.Array, jax.Array]:
        """Trajectories [..., count, 30] for the view as it is, and their scores [..., count].

        Contacts [..., 3] and tasks [...]. Those made for the copies and brought back succeed less (docs/learning.md).
        Consumes the key.
        """
        lifted = Features(*(x[..., None, :] for x in f)), contact[..., None, :], task[..., None]
        z = jax.random.normal(key, (count, self.networks.config.latent_dim))
        itself = Features(*(x[0] for x in lifted[0]))
        proposed = self.networks.propose(params, itself, *lifted[1:], z)
        return proposed, self.score(params, *lifted, proposed)


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
