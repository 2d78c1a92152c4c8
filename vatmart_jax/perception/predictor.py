"""Predictions of trained networks for views: where to act, how, and with what success probability.

A `TTAPredictor` averages scores over a view and mirrored and turned copies of it (test-time augmentation). The jitted
functions below it do so for batches of views.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vatmart_jax.perception.augmentation import SceneTransform, tta_transforms
from vatmart_jax.perception.encoder import Prepared
from vatmart_jax.perception.grouped_views import GroupedViews
from vatmart_jax.perception.layers import Params
from vatmart_jax.perception.networks import Features, Networks

_ROWS = 16  # worked on at once


@dataclass(frozen=True)
class TTAPredictor:
    """The networks, evaluated on `num_augmentations` of a view (1: the view alone).

    Heads broadcast as those of `Networks` do, with features that carry a leading dimension for the augmentations;
    contacts and trajectories are those of the view as it is.
    """

    networks: Networks
    num_augmentations: int = 1

    def features(
        self, params: Params, points: jax.Array, prepared: Prepared, query_index: jax.Array | None = None
    ) -> Features:
        """Features [A, Q, F] of one view, A augmentations of it: points [N, 3], query_index [Q] int into the queries
        that it was prepared with (None: all)."""

        def of_one(transform: SceneTransform) -> Features:
            transformed = self.networks.encoder.transform(prepared, transform)
            return self.networks.features(params, transform.points(points), transformed, query_index)

        # One after the other: the groups of one copy fill the caches.
        return jax.lax.map(of_one, tta_transforms(self.num_augmentations))

    def actionability(self, params: Params, f: Features, contact: jax.Array, goal: jax.Array) -> jax.Array:
        """Actionability [...] as a probability."""
        of_one = lambda t, f: jax.nn.sigmoid(self.networks.actionability(params, f, t.points(contact), goal))
        return jax.vmap(of_one)(tta_transforms(self.num_augmentations), f).mean(0)

    def score(
        self, params: Params, f: Features, contact: jax.Array, goal: jax.Array, trajectory: jax.Array
    ) -> jax.Array:
        """Predicted success probability [...] of the trajectory."""

        def of_one(transform: SceneTransform, f: Features) -> jax.Array:
            inputs = transform.points(contact), goal, transform.trajectory(trajectory)
            return jax.nn.sigmoid(self.networks.score(params, f, *inputs))

        return jax.vmap(of_one)(tta_transforms(self.num_augmentations), f).mean(0)

    def propose(
        self, params: Params, f: Features, contact: jax.Array, goal: jax.Array, key: jax.Array, count: int
    ) -> jax.Array:
        """Trajectories [..., count, 30] for the view as it is, at contacts [..., 3] with goals [...].

        Those made for the copies and brought back succeed less (docs/learning.md). Consumes the key.
        """
        z = jax.random.normal(key, (count, self.networks.config.latent_dim))
        itself = Features(*(x[0][..., None, :] for x in f))
        return self.networks.propose(params, itself, contact[..., None, :], goal[..., None], z)

    def propose_and_score(
        self, params: Params, f: Features, contact: jax.Array, goal: jax.Array, key: jax.Array, count: int
    ) -> tuple[jax.Array, jax.Array]:
        """As `propose`, and the trajectories' scores [..., count]. Consumes the key."""
        trajectory = self.propose(params, f, contact, goal, key, count)
        lifted = Features(*(x[..., None, :] for x in f))
        return trajectory, self.score(params, lifted, contact[..., None, :], goal[..., None], trajectory)


class Selection(NamedTuple):
    """The networks' choice in B views."""

    contact: jax.Array  # [B] int32, index into the view's contacts
    trajectory: jax.Array  # [B, 30]
    score: jax.Array  # [B] probability
    actionability: jax.Array  # [B, C] probability


class EncodedContacts(NamedTuple):
    """One contact in each of B views, encoded."""

    features: Features  # [B, A, F], A augmentations
    contact: jax.Array  # [B, 3] object frame


@partial(jax.jit, static_argnames=("predictor", "num_proposals"))
def select_actions(
    predictor: TTAPredictor,
    params: Params,
    grouped_views: GroupedViews,
    view: jax.Array,
    goal: jax.Array,
    *,
    key: jax.Array,
    num_proposals: int = 100,
) -> Selection:
    """The contact of highest actionability in each view [B], and its best-scored of num_proposals trajectories.

    goal: [B] > 0, rad or unit lengths. Consumes the key (paper, B: downstream manipulation).
    """

    def select(view: jax.Array, goal: jax.Array, key: jax.Array) -> Selection:
        contacts = grouped_views.contacts[view]
        f = _encode(predictor, params, grouped_views, view)
        actionability = predictor.actionability(params, f, contacts, goal)
        contact = jnp.argmax(actionability).astype(jnp.int32)
        at = Features(*(x[:, contact] for x in f))
        trajectory, score = predictor.propose_and_score(params, at, contacts[contact], goal, key, num_proposals)
        best = jnp.argmax(score)
        return Selection(contact, trajectory[best], score[best], actionability)

    return _over_rows(select, view, goal, jax.random.split(key, len(view)))


@partial(jax.jit, static_argnames=("predictor",))
def encode_contacts(
    predictor: TTAPredictor, params: Params, grouped_views: GroupedViews, view: jax.Array, contact: jax.Array
) -> EncodedContacts:
    """Contacts [B] int of views [B], encoded once for any number of proposals and scores."""

    def encode(view: jax.Array, contact: jax.Array) -> EncodedContacts:
        f = _encode(predictor, params, grouped_views, view, contact)
        return EncodedContacts(f, grouped_views.contacts[view, contact])

    return _over_rows(encode, view, contact)


@partial(jax.jit, static_argnames=("predictor", "num_proposals"))
def propose_from(
    predictor: TTAPredictor,
    params: Params,
    encoded: EncodedContacts,
    goal: jax.Array,
    *,
    key: jax.Array,
    num_proposals: int = 100,
) -> jax.Array:
    """Proposals [B, P, 30] at encoded contacts for goals [B], without scores. Consumes the key."""
    propose = lambda at, goal, key: predictor.propose(params, at.features, at.contact, goal, key, num_proposals)
    return _over_rows(propose, encoded, goal, jax.random.split(key, len(goal)))


@partial(jax.jit, static_argnames=("predictor", "num_proposals"))
def explore_actions(
    predictor: TTAPredictor,
    params: Params,
    grouped_views: GroupedViews,
    view: jax.Array,
    contact: jax.Array,
    *,
    goal: jax.Array,
    key: jax.Array,
    num_proposals: int = 100,
) -> tuple[jax.Array, jax.Array]:
    """What to try for views [V], T goals in each [V, T]; one encoder pass per view serves all of them.

    Of four goals in a row, the first gets what `select_actions` would choose; the second the best proposal at a contact
    drawn by actionability, the third at the given contact [V, T], and the last any proposal there. Returns contacts
    [V, T] and trajectories [V, T, 30]. Consumes the key.
    """

    def explore(view: jax.Array, contact: jax.Array, goal: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        k_contact, k_proposals, k_pick = jax.random.split(key, 3)
        contacts = grouped_views.contacts[view]
        f = _encode(predictor, params, grouped_views, view)
        actionability = predictor.actionability(params, f, contacts, goal[:, None])  # [T, C]
        kind = jnp.arange(len(goal)) % 4
        drawn = jax.random.categorical(k_contact, jnp.log(actionability))
        contact = jnp.select([kind == 0, kind == 1], [jnp.argmax(actionability, -1), drawn], contact).astype(jnp.int32)
        at = Features(*(x[:, contact] for x in f))
        trajectory, score = predictor.propose_and_score(params, at, contacts[contact], goal, k_proposals, num_proposals)
        pick = jnp.where(kind == 3, jax.random.randint(k_pick, kind.shape, 0, num_proposals), score.argmax(-1))
        return contact, trajectory[jnp.arange(len(goal)), pick]

    return _over_rows(explore, view, contact, goal, jax.random.split(key, len(view)))


@partial(jax.jit, static_argnames=("predictor",))
def score_trajectories(
    predictor: TTAPredictor,
    params: Params,
    grouped_views: GroupedViews,
    view: jax.Array,
    contact: jax.Array,
    *,
    goal: jax.Array,
    trajectory: jax.Array,
) -> jax.Array:
    """Predicted success probability [B] of trajectories [B, 30] from contacts [B] int under the goals [B]."""

    def score(view: jax.Array, contact: jax.Array, goal: jax.Array, trajectory: jax.Array) -> jax.Array:
        f = _encode(predictor, params, grouped_views, view, contact)
        return predictor.score(params, f, grouped_views.contacts[view, contact], goal, trajectory)

    return _over_rows(score, view, contact, goal, trajectory)


def _encode(
    predictor: TTAPredictor,
    params: Params,
    grouped_views: GroupedViews,
    view: jax.Array,
    contact: jax.Array | None = None,
) -> Features:
    """Features [A, C, F] of one view's contacts, or [A, F] of one of them."""
    points, prepared = jax.tree.map(lambda a: a[view], (grouped_views.points, grouped_views.prepared))
    if contact is None:
        return predictor.features(params, points, prepared)
    return Features(*(x[:, 0] for x in predictor.features(params, points, prepared, contact[None])))


def _over_rows(function: Callable, *rows):
    """function over the leading dimension, some rows at a time: a whole batch's groups would not fit into memory."""
    count = len(jax.tree.leaves(rows)[0])
    # In batches of our own, the last one filled up with the last row: `map` with a batch size compiles the function
    # twice where a remainder is left, and fails on arrays of no size (offsets of networks without a gripper patch).
    size = min(_ROWS, count)
    numbers = jnp.minimum(jnp.arange(-(-count // size) * size), count - 1).reshape(-1, size)
    of_row = lambda number: function(*jax.tree.map(lambda x: x[number], rows))
    out = jax.lax.map(jax.vmap(of_row), numbers)
    return jax.tree.map(lambda x: x.reshape(numbers.size, *x.shape[2:])[:count], out)
