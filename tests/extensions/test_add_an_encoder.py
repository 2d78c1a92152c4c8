"""A point encoder added in one file: a PointNet without neighbourhoods, chosen by its config, trained and stored."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import SPEC, boxes, samples

from vatmart_jax.config import from_json, to_json
from vatmart_jax.errors import UserError
from vatmart_jax.perception.augmentation import SceneTransform
from vatmart_jax.perception.config import NetworksConfig, PerceptionConfig
from vatmart_jax.perception.encoder import ENCODERS, EncoderConfig
from vatmart_jax.perception.layers import Params, SharedMLP, apply, init
from vatmart_jax.perception.networks import Networks
from vatmart_jax.perception.predictor import TTAPredictor, select_actions
from vatmart_jax.perception.trainer import init_state, train
from vatmart_jax.priors import Priors, PriorsConfig

pytestmark = pytest.mark.usefixtures("quick_to_compile")


@dataclass(frozen=True)
class PointNetConfig(EncoderConfig):
    kind: ClassVar[str] = "pointnet"

    n_points: int = 128
    feature_dim: int = 32
    widths: tuple[int, ...] = (32, 32)

    def build(self) -> PointNetEncoder:
        return PointNetEncoder(self)


class PointNet(nn.Module):
    config: PointNetConfig

    @nn.compact
    def __call__(self, points: jax.Array, queries: jax.Array) -> jax.Array:
        """Points [N, 3] and queries [Q, 3] to features [Q, F]: the maximum over all points beside each query."""
        whole = SharedMLP(self.config.widths)(points).max(0)
        return SharedMLP((self.config.feature_dim,))(
            jnp.concatenate([queries, jnp.broadcast_to(whole, (len(queries), len(whole)))], -1)
        )


@dataclass(frozen=True)
class PointNetEncoder:
    config: PointNetConfig
    num_local_points: ClassVar[int] = 0

    @property
    def num_points(self) -> int:
        return self.config.n_points

    @property
    def feature_dim(self) -> int:
        return self.config.feature_dim

    def prepare(self, points: jax.Array, queries: jax.Array) -> jax.Array:
        return queries

    def transform(self, prepared: jax.Array, transform: SceneTransform) -> jax.Array:
        return transform.points(prepared)

    def init(self, key: jax.Array) -> Params:
        return init(PointNet(self.config), key, jnp.zeros((self.num_points, 3)), jnp.zeros((1, 3)))

    def apply(self, params: Params, points: jax.Array, prepared: jax.Array, query_index=None) -> jax.Array:
        queries = prepared if query_index is None else prepared[query_index]
        return apply(PointNet(self.config), params, points.astype(jnp.float32), queries)

    def local_offsets(self, points: jax.Array, prepared: jax.Array, query_index=None) -> jax.Array:
        return jnp.zeros((len(prepared if query_index is None else query_index), 0, 3))


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    ENCODERS.register("pointnet", PointNetConfig)
    yield
    ENCODERS.unregister("pointnet")


SMALL = NetworksConfig(
    encoder=PointNetConfig(), trajectory_hidden=(16,), latent_dim=4, posterior_hidden=(16,), decoder_hidden=(16,),
    scorer_hidden=(16,), actionability_hidden=(16,),
)  # fmt: skip
CONFIG = PerceptionConfig(
    networks=SMALL, views_per_batch=4, samples_per_view=16, actionability_queries=4, num_proposals=8, log_every=20
)


def test_a_new_encoder_trains_predicts_and_is_stored(tmp_path) -> None:
    grouped_views, normals = boxes(0, 12, CONFIG.networks.encoder)
    data, losses = samples(1, grouped_views, normals, 400), []
    state = train(
        init_state(jax.random.key(0), CONFIG), grouped_views, data, CONFIG, SPEC,
        stage="joint", steps=60, on_metrics=lambda _, metrics: losses.append(metrics["loss"]),
    )  # fmt: skip
    assert np.isfinite(losses).all() and losses[-1] < losses[0]
    predictor = TTAPredictor(Networks(CONFIG.networks), 2)
    chosen = select_actions(
        predictor, state.params, grouped_views, jnp.arange(4), jnp.full(4, 0.3), key=jax.random.key(1), num_proposals=4
    )
    assert np.isfinite(chosen.trajectory).all()
    Priors(PriorsConfig("push-drawer", 0.1, 0.5, CONFIG.networks), state.params).save(tmp_path / "priors")
    loaded = Priors.load(tmp_path / "priors")
    assert loaded.config.networks == CONFIG.networks
    cloud = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 3))
    assert loaded.predict(cloud, 0.3, n_proposals=3).trajectories.shape == (3, 30)
    ENCODERS.unregister("pointnet")
    with pytest.raises(UserError, match="'pointnet' is not known; use one of pointnet2"):
        Priors.load(tmp_path / "priors")
    ENCODERS.register("pointnet", PointNetConfig)


def test_json_names_the_encoder_and_may_leave_out_the_first() -> None:
    written = to_json(SMALL)
    assert written["encoder"]["kind"] == "pointnet"
    assert from_json(NetworksConfig, written) == SMALL
    first = to_json(NetworksConfig())
    assert first["encoder"].pop("kind") == "pointnet2"
    assert from_json(NetworksConfig, first) == NetworksConfig()


def test_an_encoder_without_local_points_has_no_gripper_patch() -> None:
    with pytest.raises(ValueError, match="the gripper patch reads the encoder's local groups"):
        replace(SMALL, gripper_patch_hidden=(8,))
