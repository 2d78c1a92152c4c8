"""The perception networks: encoders of view, contact, task and trajectory, and the three heads (paper, 4.2 and B).

Layer sizes are the paper's. It leaves the activations open, and the released code leaves out most of them (its
decoder is affine in z); here every hidden layer of a head or of the trajectory encoder is followed by a leaky ReLU,
and the paper's single fully connected layers (contact, task) are linear.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from vatmart_jax.perception.pointnet2 import Grouping, PointNet2, PointNetConfig, Shared, surroundings
from vatmart_jax.rotations import carried, matrix_from_rot6d, normalize, rot6d_from_matrix
from vatmart_jax.trajectory import TRAJECTORY, WAYPOINTS, since_start

Params = dict  # of the networks' names to their Flax parameters

# What enters a network is brought to the order of 1: residual moves are 0.05 to 0.3 unit lengths, Euler residuals
# 0.1 to 0.5 rad, tasks 0.1 to 1.2 (rad or unit lengths), contacts already -1 to 1. The decoder's output is scaled back.
TASK_SCALE = 3.0
MOVE_SCALE = 5.0
TURN_SCALE = 2.0
HAND_SCALE = 10.0  # of where points around the contact are, within 0.15 unit lengths of it in the presets
COURSE = 3 * WAYPOINTS + 3
AXIS_AND_ARM = 6
SCALE = (1.0,) * 6 + ((MOVE_SCALE,) * 3 + (TURN_SCALE,) * 3) * WAYPOINTS  # of the 30 numbers of a trajectory


@dataclass(frozen=True)
class NetworksConfig:
    """Sizes of the networks; the defaults are the paper's."""

    pointnet: PointNetConfig = field(default_factory=PointNetConfig)
    separate: bool = False
    """One point cloud encoder for each head, as in the released code, instead of one for all three."""
    contact_dim: int = 32
    """Width of the contact point's feature."""
    task_dim: int = 32
    """Width of the task's feature."""
    positions: bool = True
    """The trajectory encoder also reads where the fingertips are sent: residuals summed up. The paper's does not."""
    trajectory: tuple[int, ...] = (128, 128, 128)
    """Widths of the trajectory encoder."""
    latent_dim: int = 128
    """Dimensions of the cVAE's Gaussian."""
    posterior: tuple[int, ...] = (128, 128)
    """Hidden widths of the cVAE's encoder."""
    decoder: tuple[int, ...] = (512, 256)
    """Hidden widths of the cVAE's decoder."""
    scorer: tuple[int, ...] = (128,)
    """Hidden widths of the trajectory scoring head."""
    actionability: tuple[int, ...] = (128, 128, 128, 128)
    """Hidden widths of the actionability head."""
    course: tuple[int, ...] = ()
    """Hidden widths of a head that tells where the touched point goes when the task is done; the others read what it
    says. Without it, as in the paper, they find out for themselves."""
    hinge: bool = False
    """The course of a door is an arc: its head tells where the hinge is, the rest is geometry. Drawers have none."""
    hand: tuple[int, ...] = ()
    """Widths of a network over the points around the contact as the hand at the start sees them, which the scorer
    reads: what the fingers would close on or run into. The paper has none."""

    def __post_init__(self) -> None:
        if self.course and self.separate:
            raise ValueError("a course needs the shared encoder: leave out one of `course` and `separate`")
        if self.hinge and not self.course:
            raise ValueError("a hinge is told by the course's head: give `course` its widths, or leave out `hinge`")
        if self.hand and not self.pointnet.around:
            raise ValueError("the hand sees the groups of `pointnet.around`: give it some, or leave out `hand`")


class Features(NamedTuple):
    """What the heads read of a view at Q query points; the first three are one array where they share an encoder."""

    scorer: jax.Array  # [Q, feature_dim]
    proposal: jax.Array  # [Q, feature_dim]
    actionability: jax.Array  # [Q, feature_dim]
    around: jax.Array  # [Q, 3 K] from the query to the points around it, K of them where the networks have `hand`


@dataclass(frozen=True)
class Networks:
    """The networks as functions of their parameters.

    Heads broadcast: features [..., F], contact [..., 3], task [...], trajectory [..., 30] and z [..., latent] may
    have any leading dimensions that broadcast against each other. What is shared is computed once: P proposals at Q
    points take features [Q, 1, F] and z [P, latent].
    """

    config: NetworksConfig = field(default_factory=NetworksConfig)

    @partial(jax.jit, static_argnums=0)
    def init(self, key: jax.Array) -> Params:
        """Consumes the key. Returns a plain dict with one entry per network."""
        pointnet = self.config.pointnet
        n = pointnet.levels[0].centroids
        sizes = [n, *(level.centroids for level in pointnet.levels)]
        index = lambda *shape: jnp.zeros(shape, jnp.int16)  # noqa: E731
        grouping = Grouping(
            jnp.zeros((1, 3)),
            tuple(index(m) for m in sizes[1:]),
            tuple(index(m, level.neighbours) for m, level in zip(sizes[1:], pointnet.levels, strict=True)),
            tuple(index(t, 3) for t in (1, *sizes[1:-1])),
            tuple(jnp.zeros((t, 3), jnp.float16) for t in (1, *sizes[1:-1])),
            tuple(index(1, around.neighbours) for around in pointnet.around),
        )
        f, contact, task = jnp.zeros(pointnet.feature_dim), jnp.zeros(3), jnp.zeros(())
        trajectory, z = jnp.zeros(TRAJECTORY), jnp.zeros(self.config.latent_dim)
        keys = iter(jax.random.split(key, 8))
        params = {
            name: PointNet2(pointnet).init(next(keys), jnp.zeros((n, 3)), grouping)["params"]
            for name in self.encoders("scorer", "proposal", "actionability")
        }
        course = (jnp.zeros(COURSE),) if self.config.course else ()
        around = jnp.zeros(3) if self.config.hand else None
        params["scorer"] = self._scorer.init(next(keys), trajectory, f, contact, task, *course, around=around)["params"]
        params["posterior"] = self._posterior.init(next(keys), trajectory, f, contact, task, *course)["params"]
        params["decoder"] = self._decoder.init(next(keys), f, contact, task, *course, z)["params"]
        params["actionability"] = self._actionability.init(next(keys), f, contact, task, *course)["params"]
        if self.config.course:
            params["course"] = self._course.init(next(keys), f, contact, task)["params"]
        return params

    def encoders(self, *heads: str) -> tuple[str, ...]:
        """Names in the parameters of the point cloud encoders that these heads read."""
        return tuple(f"{head}_encoder" for head in heads) if self.config.separate else ("encoder",)

    def features(
        self, params: Params, points: jax.Array, grouping: Grouping, which: jax.Array | None = None
    ) -> Features:
        """Encodes one view: points [N, 3], which [Q] int into the grouping's queries (None for all).

        vmap it over views. What no head reads afterwards is not computed under jit.
        """
        encode = lambda name: PointNet2(self.config.pointnet).apply({"params": params[name]}, points, grouping, which)  # noqa: E731
        found = [encode(name) for name in self.encoders("scorer", "proposal", "actionability")]
        around = jnp.zeros((len(found[0]), 0))
        if self.config.hand:
            around = jnp.concatenate(surroundings(points, grouping, which), -2).reshape(len(around), -1)
        return Features(*(found if self.config.separate else found * 3), around)  # pyright: ignore[reportArgumentType, reportCallIssue]

    def score(
        self,
        params: Params,
        f: Features,
        contact: jax.Array,
        task: jax.Array,
        trajectory: jax.Array,
        course: jax.Array | None = None,
    ) -> jax.Array:
        """Logit [...] that the trajectory does the task; trajectories as `geometry.pack_trajectory` makes them.

        course: [..., 15], read in place of what the networks themselves say of it.
        """
        at = self._at(params, f, f.scorer, contact, task, course)
        around = f.around if self.config.hand else None
        return self._scorer.apply({"params": params["scorer"]}, trajectory, *at, around=around)[..., 0]  # pyright: ignore

    def posterior(
        self, params: Params, f: Features, contact: jax.Array, task: jax.Array, trajectory: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Mean and log variance [..., latent] of the cVAE's encoder."""
        at = self._at(params, f, f.proposal, contact, task)
        out = self._posterior.apply({"params": params["posterior"]}, trajectory, *at)
        return tuple(jnp.split(out, 2, -1))  # pyright: ignore

    def decode(self, params: Params, f: Features, contact: jax.Array, task: jax.Array, z: jax.Array) -> jax.Array:
        """The decoder's raw output [..., 30]: as `propose`, the first six numbers not orthonormal."""
        at = self._at(params, f, f.proposal, contact, task)
        out: jax.Array = self._decoder.apply({"params": params["decoder"]}, *at, z) / jnp.array(SCALE)  # pyright: ignore
        if self.config.course:  # then the decoder says how the hand departs from it
            places, _ = places_and_turn(at[-1])
            steps = jnp.diff(places, axis=-2, prepend=0.0)
            steps = _flat(jnp.concatenate([steps, jnp.zeros_like(steps)], -1))
            out = out + jnp.concatenate([jnp.zeros_like(steps[..., :6]), steps], -1)
        return out

    def propose(self, params: Params, f: Features, contact: jax.Array, task: jax.Array, z: jax.Array) -> jax.Array:
        """Trajectories [..., 30] for z [..., latent] drawn from a standard normal distribution."""
        raw = self.decode(params, f, contact, task, z)
        return jnp.concatenate([rot6d_from_matrix(matrix_from_rot6d(raw[..., :6])), raw[..., 6:]], -1)

    def actionability(self, params: Params, f: Features, contact: jax.Array, task: jax.Array) -> jax.Array:
        """Logit [...] of the actionability score."""
        at = self._at(params, f, f.actionability, contact, task)
        return self._actionability.apply({"params": params["actionability"]}, *at)[..., 0]  # pyright: ignore

    def course(self, params: Params, f: Features, contact: jax.Array, task: jax.Array) -> jax.Array:
        """[..., 15] what becomes of a point of the part while the task is done: where it is after each quarter,
        relative to the contact, and the rotation vector of the part at the end; scaled (see `places_and_turn`)."""
        if not self.config.hinge:
            return self._course.apply({"params": params["course"]}, f.scorer, contact, task)  # pyright: ignore
        axis, arm = self.hinge(params, f, contact, task)
        return course_of(normalize(axis), arm, task, hinge=True)

    def hinge(self, params: Params, f: Features, contact: jax.Array, task: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The axis [..., 3] that the part turns about, of a length near 1 and signed as the task turns, and the way
        [..., 3] (unit lengths) from the contact to the nearest point on it; for networks with `hinge`."""
        out = self._course.apply({"params": params["course"]}, f.scorer, contact, task)
        return out[..., :3], out[..., 3:] / MOVE_SCALE  # pyright: ignore

    def _at(
        self,
        params: Params,
        f: Features,
        own: jax.Array,
        contact: jax.Array,
        task: jax.Array,
        course: jax.Array | None = None,
    ) -> tuple[jax.Array, ...]:
        """What every head reads: its own feature, contact, task and, where there is a head for it, the course."""
        if not self.config.course:
            return own, contact, task
        course = self.course(params, f, contact, task) if course is None else course
        return own, contact, task, jax.lax.stop_gradient(course)

    @property
    def _scorer(self) -> TrajectoryHead:
        return TrajectoryHead(self.config, (*self.config.scorer, 1))

    @property
    def _posterior(self) -> TrajectoryHead:
        return TrajectoryHead(self.config, (*self.config.posterior, 2 * self.config.latent_dim))

    @property
    def _decoder(self) -> Head:
        return Head(self.config, (*self.config.decoder, TRAJECTORY))

    @property
    def _actionability(self) -> Head:
        return Head(self.config, (*self.config.actionability, 1))

    @property
    def _course(self) -> Head:
        return Head(self.config, (*self.config.course, AXIS_AND_ARM if self.config.hinge else COURSE))


class Head(nn.Module):
    """Dense layers on the view's feature, the encoded contact and task, and further inputs, if any."""

    config: NetworksConfig
    widths: tuple[int, ...]

    @nn.compact
    def __call__(self, f: jax.Array, contact: jax.Array, task: jax.Array, *more: jax.Array) -> jax.Array:
        contact = nn.Dense(self.config.contact_dim, name="contact")(contact)
        task = nn.Dense(self.config.task_dim, name="task")(TASK_SCALE * task[..., None])
        x = DenseOfParts(self.widths[0])(f, contact, task, *more)
        for width in self.widths[1:]:
            x = nn.Dense(width)(nn.leaky_relu(x))
        return x


class TrajectoryHead(nn.Module):
    """A Head that also reads an encoded trajectory and, where it gets the points around the contact [..., 3 K], what
    the hand at the start sees of them."""

    config: NetworksConfig
    widths: tuple[int, ...]

    @nn.compact
    def __call__(
        self,
        trajectory: jax.Array,
        f: jax.Array,
        contact: jax.Array,
        task: jax.Array,
        *course: jax.Array,
        around: jax.Array | None = None,
    ) -> jax.Array:
        parts = [trajectory * jnp.array(SCALE)]
        moved = since_start(trajectory)[..., :3]
        if self.config.positions:
            # What the residuals sum up to decides whether the part arrives; the encoder need not learn to add.
            parts.append(_flat(contact[..., None, :] + moved))
        parts += [_flat(MOVE_SCALE * (moved - places_and_turn(c)[0])) for c in course]
        leading = jnp.broadcast_shapes(*(part.shape[:-1] for part in parts))
        x = jnp.concatenate([jnp.broadcast_to(part, (*leading, part.shape[-1])) for part in parts], -1)
        for width in self.config.trajectory[:-1]:
            x = nn.leaky_relu(nn.Dense(width)(x))
        more = [nn.Dense(self.config.trajectory[-1])(x)]
        if around is not None:
            points = around.reshape(*around.shape[:-1], around.shape[-1] // 3, 3)
            seen = HAND_SCALE * points @ matrix_from_rot6d(trajectory[..., :6])
            more.append(Shared(self.config.hand, name="hand")(seen).max(-2))
        return Head(self.config, self.widths)(f, contact, task, *course, *more)


def places_and_turn(course: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Displacements [..., 4, 3] (unit lengths) and rotation vector [..., 3] (rad) of a course [..., 15]."""
    places = course[..., : 3 * WAYPOINTS] / MOVE_SCALE
    return places.reshape(*places.shape[:-1], WAYPOINTS, 3), course[..., 3 * WAYPOINTS :] / TURN_SCALE


def pack_course(places: jax.Array, turn: jax.Array) -> jax.Array:
    """The inverse of `places_and_turn`."""
    return jnp.concatenate([MOVE_SCALE * _flat(places), TURN_SCALE * turn], -1)


def course_of(axis: jax.Array, arm: jax.Array, task: jax.Array, hinge: bool) -> jax.Array:
    """The course [..., 15] of points whose part turns about an axis (`hinge`) or slides along it by task [...].

    axis: [..., 3] unit; arm: [..., 3] from the point to any point on a hinge's axis.
    """
    amount = task[..., None] * jnp.arange(1, WAYPOINTS + 1) / WAYPOINTS
    arm = arm[..., None, :]
    places = carried(jnp.zeros_like(arm), axis[..., None, :], arm, amount, hinge)
    turn = axis * task[..., None]
    return pack_course(places, turn if hinge else jnp.zeros_like(turn))


def _flat(x: jax.Array) -> jax.Array:
    return x.reshape(*x.shape[:-2], x.shape[-2] * x.shape[-1])


class DenseOfParts(nn.Module):
    """A dense layer on the concatenation of parts [..., d_i], whose leading dimensions may differ and broadcast.

    The sum of one product per part, so that a part that many rows share is multiplied once.
    """

    width: int

    @nn.compact
    def __call__(self, *parts: jax.Array) -> jax.Array:
        sizes = [part.shape[-1] for part in parts]
        kernel = self.param("kernel", nn.initializers.lecun_normal(), (sum(sizes), self.width))
        total = self.param("bias", nn.initializers.zeros, (self.width,))
        start = 0
        for part, size in zip(parts, sizes, strict=True):
            total = total + part @ kernel[start : start + size]
            start += size
        return total
