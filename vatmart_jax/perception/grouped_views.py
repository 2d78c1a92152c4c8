"""Views as the perception networks read them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vatmart_jax.data.banks import ViewBank
from vatmart_jax.errors import UserError
from vatmart_jax.perception.pointnet2 import Grouping, PointNetConfig, group


@struct.dataclass
class Clouds:
    """V views as the networks read them: N points each, the C contact candidates being the grouping's queries."""

    points: jax.Array  # [V, N, 3] float16, object frame
    grouping: Grouping
    joints: tuple[jax.Array, jax.Array] | None = None  # [V, 3] axes and anchors, see Env.joints; labels, never inputs

    @property
    def contacts(self) -> jax.Array:
        """[V, C, 3] float32, object frame."""
        return self.grouping.queries

    def __len__(self) -> int:
        return len(self.points)


def points_of(bank: ViewBank, config: PointNetConfig) -> np.ndarray:
    """The first n_points of every view. Raises UserError where the bank's views have fewer."""
    if bank.points.shape[1] < config.n_points:
        raise UserError(
            f"the views have {bank.points.shape[1]} points, the networks want {config.n_points}; convert again with "
            f"--points {config.n_points}, or choose another preset"
        )
    return bank.points[:, : config.n_points]


def clouds_of(
    bank: ViewBank, config: PointNetConfig, on_progress: Callable[[int, int], None] = lambda done, total: None
) -> Clouds:
    """The points that the networks see of every view, grouped; `on_progress(done, total)` counts views.

    Raises UserError where the bank's views have too few.
    """
    points = points_of(bank, config)
    total, size, parts = len(bank), 16, []
    for start in range(0, total, size):
        # The last batch is filled up with the last view: one shape, one compilation.
        rows = np.minimum(np.arange(start, start + size), total - 1)
        found = jax.device_get(_group(points[rows], bank.contacts[rows], config))
        parts.append(found)
        on_progress(min(start + size, total), total)
    grouping = jax.tree.map(lambda *a: jnp.asarray(np.concatenate(a)[:total]), *parts)
    return Clouds(jnp.asarray(points, jnp.float16), grouping)


@partial(jax.jit, static_argnames=("config",))
def _group(points: jax.Array, queries: jax.Array, config: PointNetConfig) -> Grouping:
    return jax.vmap(lambda p, q: group(p, q, config))(points, queries)
