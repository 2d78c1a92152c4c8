"""Heads: dense networks on a query's feature, contact and goal, some of them on a trajectory too.

Names of modules are names in trained parameters, and initial values follow from them.
"""

from __future__ import annotations

from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp

from vatmart_jax.perception.articulation_flow import EULER_SCALE, POSITION_SCALE, unpack_flow
from vatmart_jax.perception.config import NetworksConfig
from vatmart_jax.perception.layers import SharedMLP, flatten_last_two
from vatmart_jax.registry import Registry
from vatmart_jax.rotations import matrix_from_rot6d
from vatmart_jax.trajectory import WAYPOINTS, cumulative_residuals

# What enters a network is brought to the order of 1: goals are 0.1 to 1.2 (rad or unit lengths), points of the gripper
# patch lie within 0.15 unit lengths of the contact in the presets, contacts are -1 to 1 already.
GOAL_SCALE = 3.0
PATCH_SCALE = 10.0
TRAJECTORY_SCALE = (1.0,) * 6 + ((POSITION_SCALE,) * 3 + (EULER_SCALE,) * 3) * WAYPOINTS

HEADS: Registry[Callable[[NetworksConfig], nn.Module]] = Registry("head")
"""Makers of heads beyond the paper's, for `NetworksConfig.extra_heads`. Their modules are called as
`module(trajectory [..., 30], feature [..., F], contact [..., 3], goal [...])`."""


class Head(nn.Module):
    """Dense layers on the view's feature, the encoded contact and goal, and further inputs, if any."""

    config: NetworksConfig
    widths: tuple[int, ...]

    @nn.compact
    def __call__(self, f: jax.Array, contact: jax.Array, goal: jax.Array, *more: jax.Array) -> jax.Array:
        contact = nn.Dense(self.config.contact_dim, name="contact")(contact)
        goal = nn.Dense(self.config.task_dim, name="task")(GOAL_SCALE * goal[..., None])
        x = DenseOfParts(self.widths[0])(f, contact, goal, *more)
        for width in self.widths[1:]:
            x = nn.Dense(width)(nn.leaky_relu(x))
        return x


class TrajectoryHead(nn.Module):
    """A Head that also reads an encoded trajectory and, where it gets the points around the contact [..., 3 K], an
    encoding of these in the gripper's frame at the start."""

    config: NetworksConfig
    widths: tuple[int, ...]

    @nn.compact
    def __call__(
        self,
        trajectory: jax.Array,
        f: jax.Array,
        contact: jax.Array,
        goal: jax.Array,
        *flow: jax.Array,
        local_offsets: jax.Array | None = None,
    ) -> jax.Array:
        parts = [trajectory * jnp.array(TRAJECTORY_SCALE)]
        moved = cumulative_residuals(trajectory)[..., :3]
        if self.config.absolute_waypoints:
            # What the residuals sum up to decides whether the part arrives; the encoder need not learn to add.
            parts.append(flatten_last_two(contact[..., None, :] + moved))
        parts += [flatten_last_two(POSITION_SCALE * (moved - unpack_flow(c)[0])) for c in flow]
        leading = jnp.broadcast_shapes(*(part.shape[:-1] for part in parts))
        x = jnp.concatenate([jnp.broadcast_to(part, (*leading, part.shape[-1])) for part in parts], -1)
        for width in self.config.trajectory_hidden[:-1]:
            x = nn.leaky_relu(nn.Dense(width)(x))
        more = [nn.Dense(self.config.trajectory_hidden[-1])(x)]
        if local_offsets is not None:
            points = local_offsets.reshape(*local_offsets.shape[:-1], local_offsets.shape[-1] // 3, 3)
            patch = PATCH_SCALE * points @ matrix_from_rot6d(trajectory[..., :6])
            more.append(SharedMLP(self.config.gripper_patch_hidden, name="hand")(patch).max(-2))
        return Head(self.config, self.widths)(f, contact, goal, *flow, *more)


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
