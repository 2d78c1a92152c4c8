"""Where random trials begin: balanced views, goals that fit, contacts and approaches."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vatmart_jax import rotations as rot
from vatmart_jax.data.banks import SceneBank, ViewBank
from vatmart_jax.envs.types import EnvConfig, TrialStart, ViewTable


class StartTable(struct.PyTreeNode, kw_only=True):
    """Probabilities of V views and their C contacts, on device; object frame."""

    view_cdf: jax.Array  # [V] cumulative probability of the views
    candidate: jax.Array  # [V, C] bool, the task may be done there
    grasp: tuple[jax.Array, jax.Array] | None  # canonical approach and closing axis [V, C, 3] each; None of a push


def view_probabilities(bank: SceneBank, views: ViewBank) -> np.ndarray:
    """[V] uniform over categories, then over the objects of one, the Scenes of that, and its views."""
    probability = np.ones(len(views))
    parents: list[tuple] = [()] * len(views)
    levels = (bank.category[views.scene], bank.object_id[views.scene], views.scene, np.arange(len(views)))
    for level in levels:
        keys = [(*parent, key) for parent, key in zip(parents, level.tolist(), strict=True)]
        children: dict[tuple, set] = {}
        for parent, key in zip(parents, keys, strict=True):
            children.setdefault(parent, set()).add(key)
        probability /= [len(children[parent]) for parent in parents]
        parents = keys
    return probability


def sample_views(key: jax.Array, table: StartTable, n: int) -> jax.Array:
    """[n] int32. Consumes the key."""
    cdf = table.view_cdf
    view = jnp.searchsorted(cdf, jax.random.uniform(key, (n,)) * cdf[-1])
    return jnp.minimum(view, len(cdf) - 1).astype(jnp.int32)


def sample_goals(
    key: jax.Array, joint_range: jax.Array, remaining: jax.Array, goal_range: tuple[float, float]
) -> jax.Array:
    """[B] goals for parts with joint ranges [B], of which `remaining` [B] is left in the task's direction.

    Their density given the start is that of the paper's order: the goal uniform, then a start that leaves room for it.
    Consumes the key.
    """
    smallest, largest = goal_range
    high = jnp.minimum(largest, remaining)
    # p(goal | start) is proportional to 1 / (joint_range - goal) on [smallest, high]; inverted here.
    rest = jnp.maximum(joint_range - smallest, 1e-3)
    share = jnp.maximum(joint_range - high, 1e-3) / rest
    goal = joint_range - rest * share ** jax.random.uniform(key, joint_range.shape)
    return jnp.clip(goal, smallest, jnp.maximum(high, smallest))


def sample_approaches(
    key: jax.Array,
    view: jax.Array,
    goal: jax.Array,
    guided_fraction: float,
    *,
    table: StartTable,
    views: ViewTable,
    config: EnvConfig,
) -> TrialStart:
    """Random contacts and hand orientations for views [B] and goals [B].

    A share of them are guided: at candidate contacts, and grasps near the canonical one. The rest have any contact, an
    approach within the cone about the inward normal, any roll. Consumes the key.
    """
    kc, kg, ka, kr, ks, ko = jax.random.split(key, 6)
    # A guided start weighs candidates so much that others are drawn only where a view has none.
    guided = jax.random.uniform(kg, (len(view), 1)) < guided_fraction
    contact = jax.random.categorical(kc, jnp.where(guided & table.candidate[view], 20.0, 0.0), axis=-1)
    up = rot.sample_cone_direction(ka, -views.normals[view, contact], config.approach_cone)
    forward = jax.random.normal(kr, up.shape)
    if table.grasp is not None:
        canonical, closing_axis = (x[view, contact] for x in table.grasp)
        aligned = guided & table.candidate[view, contact][:, None]
        up = jnp.where(aligned, rot.sample_cone_direction(ks, canonical, config.grasp_approach_cone), up)
        # The fingers close along the hand's y; either finger may be on either side.
        k_side, k_off = jax.random.split(ko)
        side = jax.random.rademacher(k_side, (len(view), 1), up.dtype)
        off = jnp.tan(0.5 * config.grasp_approach_cone) * jax.random.normal(k_off, up.shape)
        forward = jnp.where(aligned, rot.normalize(side * jnp.cross(closing_axis, up)) + off, forward)
    return TrialStart(view=view, contact=contact.astype(jnp.int32), goal=goal, rotation=rot.gripper_frame(up, forward))
