"""The perception networks: encoders of view, contact, goal and trajectory, and the heads (paper, 4.2 and B).

Layer sizes are the paper's. It leaves the activations open, and the released code leaves out most of them (its
decoder is affine in z); here every hidden layer of a head or of the trajectory encoder is followed by a leaky ReLU,
and the paper's single fully connected layers (contact, task) are linear.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from vatmart_jax.perception.articulation_flow import (
    AXIS_AND_ARM,
    FLOW,
    POSITION_SCALE,
    articulation_flow,
    unpack_flow,
)
from vatmart_jax.perception.config import NetworksConfig
from vatmart_jax.perception.encoder import PointEncoder, Prepared
from vatmart_jax.perception.heads import HEADS, TRAJECTORY_SCALE, Head, TrajectoryHead
from vatmart_jax.perception.layers import Params, apply, flatten_last_two, init
from vatmart_jax.rotations import matrix_from_rot6d, normalize, rot6d_from_matrix
from vatmart_jax.trajectory import TRAJECTORY


class Features(NamedTuple):
    """What the heads read of a view at Q query points; the first three are one array where they share an encoder."""

    scorer: jax.Array  # [Q, feature_dim]
    proposal: jax.Array  # [Q, feature_dim]
    actionability: jax.Array  # [Q, feature_dim]
    local_offsets: jax.Array  # [Q, 3 K] from the query to the points around it; K = 0 without a gripper patch


@dataclass(frozen=True)
class Networks:
    """The networks as functions of their parameters.

    Heads broadcast: features [..., F], contact [..., 3], goal [...], trajectory [..., 30] and z [..., latent] may
    have any leading dimensions that broadcast against each other. What is shared is computed once: P proposals at Q
    points take features [Q, 1, F] and z [P, latent].
    """

    config: NetworksConfig = field(default_factory=NetworksConfig)

    @property
    def encoder(self) -> PointEncoder:
        """The point cloud encoder, one for all heads or of each of them."""
        return self.config.encoder.build()

    @partial(jax.jit, static_argnums=0)
    def init(self, key: jax.Array) -> Params:
        """Consumes the key. Returns a plain dict with one entry per network."""
        f, contact, goal = jnp.zeros(self.encoder.feature_dim), jnp.zeros(3), jnp.zeros(())
        trajectory, z = jnp.zeros(TRAJECTORY), jnp.zeros(self.config.latent_dim)
        flow = (jnp.zeros(FLOW),) if self.config.flow_hidden else ()
        local_offsets = jnp.zeros(3) if self.config.gripper_patch_hidden else None
        keys = iter(jax.random.split(key, 8))
        params = {name: self.encoder.init(next(keys)) for name in self.encoders("scorer", "proposal", "actionability")}
        params["scorer"] = init(
            self._scorer, next(keys), trajectory, f, contact, goal, *flow, local_offsets=local_offsets
        )
        params["posterior"] = init(self._posterior, next(keys), trajectory, f, contact, goal, *flow)
        params["decoder"] = init(self._decoder, next(keys), f, contact, goal, *flow, z)
        params["actionability"] = init(self._actionability, next(keys), f, contact, goal, *flow)
        if self.config.flow_hidden:
            params["flow"] = init(self._flow, next(keys), f, contact, goal)
        for name in self.config.extra_heads:
            own = jax.random.fold_in(key, zlib.crc32(name.encode()))
            params[name] = init(self._extra(name), own, trajectory, f, contact, goal)
        return params

    def encoders(self, *heads: str) -> tuple[str, ...]:
        """Names in the parameters of the point cloud encoders that these heads read."""
        return tuple(f"{head}_encoder" for head in heads) if self.config.separate_encoders else ("encoder",)

    def features(
        self, params: Params, points: jax.Array, prepared: Prepared, query_index: jax.Array | None = None
    ) -> Features:
        """Encodes one view: points [N, 3], query_index [Q] int into the queries it was prepared with (None for all).

        vmap it over views. What no head reads afterwards is not computed under jit.
        """
        names = self.encoders("scorer", "proposal", "actionability")
        found = [self.encoder.apply(params[name], points, prepared, query_index) for name in names]
        scorer, proposal, actionability = found if self.config.separate_encoders else found * 3
        offsets = jnp.zeros((len(scorer), 0))
        if self.config.gripper_patch_hidden:
            offsets = flatten_last_two(self.encoder.local_offsets(points, prepared, query_index))
        return Features(scorer, proposal, actionability, offsets)

    def score(
        self,
        params: Params,
        f: Features,
        contact: jax.Array,
        goal: jax.Array,
        trajectory: jax.Array,
        *,
        flow: jax.Array | None = None,
    ) -> jax.Array:
        """Logit [...] that the trajectory reaches the goal; trajectories as `trajectory.pack_trajectory` makes them.

        flow: [..., 15], read in place of the networks' own prediction.
        """
        inputs = self._inputs(params, f, f.scorer, contact, goal, flow=flow)
        local_offsets = f.local_offsets if self.config.gripper_patch_hidden else None
        return apply(self._scorer, params["scorer"], trajectory, *inputs, local_offsets=local_offsets)[..., 0]

    def posterior(
        self, params: Params, f: Features, contact: jax.Array, goal: jax.Array, trajectory: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Mean and log variance [..., latent] of the cVAE's encoder."""
        inputs = self._inputs(params, f, f.proposal, contact, goal)
        mean, log_variance = jnp.split(apply(self._posterior, params["posterior"], trajectory, *inputs), 2, -1)
        return mean, log_variance

    def decode(self, params: Params, f: Features, contact: jax.Array, goal: jax.Array, z: jax.Array) -> jax.Array:
        """The decoder's raw output [..., 30]: as `propose`, the first six numbers not orthonormal."""
        inputs = self._inputs(params, f, f.proposal, contact, goal)
        out = apply(self._decoder, params["decoder"], *inputs, z) / jnp.array(TRAJECTORY_SCALE)
        if self.config.flow_hidden:  # then the decoder's output is the hand's departure from it
            displacements, _ = unpack_flow(inputs[-1])
            steps = jnp.diff(displacements, axis=-2, prepend=0.0)
            steps = flatten_last_two(jnp.concatenate([steps, jnp.zeros_like(steps)], -1))
            out = out + jnp.concatenate([jnp.zeros_like(steps[..., :6]), steps], -1)
        return out

    def propose(self, params: Params, f: Features, contact: jax.Array, goal: jax.Array, z: jax.Array) -> jax.Array:
        """Trajectories [..., 30] for z [..., latent] drawn from a standard normal distribution."""
        raw = self.decode(params, f, contact, goal, z)
        return jnp.concatenate([rot6d_from_matrix(matrix_from_rot6d(raw[..., :6])), raw[..., 6:]], -1)

    def actionability(self, params: Params, f: Features, contact: jax.Array, goal: jax.Array) -> jax.Array:
        """Logit [...] of the actionability score."""
        inputs = self._inputs(params, f, f.actionability, contact, goal)
        return apply(self._actionability, params["actionability"], *inputs)[..., 0]

    def flow(self, params: Params, f: Features, contact: jax.Array, goal: jax.Array) -> jax.Array:
        """[..., 15] the predicted articulation flow of the contact under the goal, see `articulation_flow`."""
        if not self.config.predict_axis:
            return apply(self._flow, params["flow"], f.scorer, contact, goal)
        axis, arm = self.joint_axis(params, f, contact, goal)
        return articulation_flow(normalize(axis), arm, goal, hinge=True)

    def joint_axis(
        self, params: Params, f: Features, contact: jax.Array, goal: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """The predicted axis [..., 3] that the part turns about, of a length near 1 and signed as the goal turns, and
        the vector [..., 3] (unit lengths) from the contact to the nearest point on it; with `predict_axis`."""
        out = apply(self._flow, params["flow"], f.scorer, contact, goal)
        return out[..., :3], out[..., 3:] / POSITION_SCALE

    def extra(
        self, name: str, params: Params, f: Features, contact: jax.Array, goal: jax.Array, *, trajectory: jax.Array
    ) -> jax.Array:
        """The output of one of `extra_heads`, which read the scorer's feature."""
        return apply(self._extra(name), params[name], trajectory, f.scorer, contact, goal)

    def _inputs(
        self,
        params: Params,
        f: Features,
        feature: jax.Array,
        contact: jax.Array,
        goal: jax.Array,
        *,
        flow: jax.Array | None = None,
    ) -> tuple[jax.Array, ...]:
        """What every head reads: its own feature, contact, goal and, where there is a head for it, the flow."""
        if not self.config.flow_hidden:
            return feature, contact, goal
        flow = self.flow(params, f, contact, goal) if flow is None else flow
        return feature, contact, goal, jax.lax.stop_gradient(flow)

    @property
    def _scorer(self) -> TrajectoryHead:
        return TrajectoryHead(self.config, (*self.config.scorer_hidden, 1))

    @property
    def _posterior(self) -> TrajectoryHead:
        return TrajectoryHead(self.config, (*self.config.posterior_hidden, 2 * self.config.latent_dim))

    @property
    def _decoder(self) -> Head:
        return Head(self.config, (*self.config.decoder_hidden, TRAJECTORY))

    @property
    def _actionability(self) -> Head:
        return Head(self.config, (*self.config.actionability_hidden, 1))

    @property
    def _flow(self) -> Head:
        return Head(self.config, (*self.config.flow_hidden, AXIS_AND_ARM if self.config.predict_axis else FLOW))

    def _extra(self, name: str) -> nn.Module:
        return HEADS.get(name)(self.config)
