"""Views as the perception networks read them."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax.struct import PyTreeNode

from vatmart_jax.data.banks import ViewBank
from vatmart_jax.errors import UserError
from vatmart_jax.perception.encoder import EncoderConfig, PointEncoder, Prepared

_BATCH = 16  # views that are prepared at once


class GroupedViews(PyTreeNode, kw_only=True):
    """V views as the networks read them: N points each, and the C contact candidates as the encoder's queries."""

    points: jax.Array  # [V, N, 3] float16, object frame
    contacts: jax.Array  # [V, C, 3] float32, object frame
    prepared: Prepared  # what the encoder prepared, [V, ...] in every leaf
    fingerprint: jax.Array  # [] uint32, of the contacts: whose views these are
    joints: tuple[jax.Array, jax.Array] | None = None  # [V, 3] axes and anchors, see Env.joints; labels, never inputs

    def __len__(self) -> int:
        return len(self.points)

    def check_same_views(self, views: ViewBank) -> None:
        """Raises ValueError unless these are the bank's views: indices into one would mean others in the other."""
        if int(self.fingerprint) != int(fingerprint(views.contacts)):
            raise ValueError(
                f"the grouped views ({len(self)}) are not the environment's ({len(views)}): group the views of this "
                "environment"
            )


def fingerprint(contacts: np.ndarray | jax.Array) -> np.uint32:
    """A number of contact points [V, C, 3] that no other views have but by accident."""
    contacts = np.ascontiguousarray(contacts, np.float32)
    return np.uint32(zlib.crc32(contacts.tobytes(), zlib.crc32(str(contacts.shape).encode())))


def network_points(bank: ViewBank, config: EncoderConfig) -> np.ndarray:
    """The first n_points of every view. Raises UserError where the bank's views have fewer."""
    if bank.points.shape[1] < config.n_points:
        raise UserError(
            f"the views have {bank.points.shape[1]} points, the networks read {config.n_points}; convert again with "
            f"{config.n_points} points, or choose another preset"
        )
    return bank.points[:, : config.n_points]


def group_views(
    bank: ViewBank, config: EncoderConfig, on_progress: Callable[[int, int], None] = lambda done, total: None
) -> GroupedViews:
    """The points that the networks read of every view, prepared; `on_progress(done, total)` counts views.

    Raises UserError where the bank's views have too few.
    """
    return group_points(network_points(bank, config), bank.contacts, config.build(), on_progress)


def group_points(
    points: np.ndarray,
    contacts: np.ndarray,
    encoder: PointEncoder,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> GroupedViews:
    """As `group_views`, of clouds [V, N, 3] in random order with contact candidates [V, C, 3]."""
    total, parts = len(points), []
    for start in range(0, total, _BATCH):
        # The last batch is filled up with the last view: one shape, one compilation.
        rows = np.minimum(np.arange(start, start + _BATCH), total - 1)
        parts.append(jax.device_get(_prepare(points[rows], contacts[rows], encoder)))
        on_progress(min(start + _BATCH, total), total)
    return GroupedViews(
        points=jnp.asarray(points, jnp.float16),
        contacts=jnp.asarray(contacts, jnp.float32),
        prepared=jax.tree.map(lambda *a: jnp.asarray(np.concatenate(a)[:total]), *parts),
        fingerprint=jnp.asarray(fingerprint(contacts)),
    )


@partial(jax.jit, static_argnames=("encoder",))
def _prepare(points: jax.Array, queries: jax.Array, encoder: PointEncoder) -> Prepared:
    return jax.vmap(encoder.prepare)(points, queries)
