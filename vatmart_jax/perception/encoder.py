"""What the rest of the package knows of a point cloud encoder: a protocol, and the registry of its kinds.

An encoder is chosen by the class of `NetworksConfig.encoder`. To add one: a frozen dataclass with its sizes, derived
from `EncoderConfig`; the encoder that its `build` returns; and one line `ENCODERS.register(kind, class)`.
"""

from __future__ import annotations

from typing import Any, ClassVar, Protocol

import jax

from vatmart_jax.config import Variant
from vatmart_jax.perception.augmentation import SceneTransform
from vatmart_jax.perception.layers import Params
from vatmart_jax.registry import Registry

Prepared = Any
"""A pytree of arrays that an encoder computes once per view, whatever its parameters; opaque to all others."""


class PointEncoder(Protocol):
    """Features of Q query points in one view's cloud of N points; vmap it over views.

    A static argument of jitted functions: hashable, and equal to another of the same config.
    """

    @property
    def num_points(self) -> int:
        """N in training; at inference the cloud is resampled to as many."""
        ...

    @property
    def feature_dim(self) -> int:
        """Width of a query's feature."""
        ...

    @property
    def num_local_points(self) -> int:
        """K, the points about a query that `local_offsets` returns; 0 where the encoder looks for none."""
        ...

    def prepare(self, points: jax.Array, queries: jax.Array) -> Prepared:
        """What does not depend on parameters, of points [N, 3] in random order and queries [C, 3] (object frame)."""
        ...

    def transform(self, prepared: Prepared, transform: SceneTransform) -> Prepared:
        """What `prepare` would return for the transformed scene, near enough to train and predict with."""
        ...

    def init(self, key: jax.Array) -> Params:
        """Initial parameters. Consumes the key."""
        ...

    def apply(
        self, params: Params, points: jax.Array, prepared: Prepared, query_index: jax.Array | None = None
    ) -> jax.Array:
        """[Q, feature_dim] of the queries that `query_index` [Q] selects; None: of all, Q = C."""
        ...

    def local_offsets(self, points: jax.Array, prepared: Prepared, query_index: jax.Array | None = None) -> jax.Array:
        """[Q, K, 3] from the selected queries to the points about each."""
        ...


class EncoderConfig(Variant):
    """Base of the frozen dataclasses that hold an encoder's sizes."""

    default_kind: ClassVar[str] = "pointnet2"

    n_points: int
    """Points of a view that training sees; inference takes any number."""
    feature_dim: int
    """Width of a query's feature."""

    def build(self) -> PointEncoder:
        """The encoder of these sizes."""
        raise NotImplementedError

    @classmethod
    def of_kind(cls, kind: str) -> type[EncoderConfig]:
        return ENCODERS.get(kind)


ENCODERS: Registry[type[EncoderConfig]] = Registry("point encoder")
"""Kinds of encoders, as the config's JSON names them, and the class of their configs."""
ENCODERS.register("pointnet2", "vatmart_jax.perception.pointnet2:PointNet2Config")
