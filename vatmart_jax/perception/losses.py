"""Losses of the three heads (paper, 4.2). Every term is a mean over rows, weighted where some rows are left out."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import optax

from vatmart_jax.trajectory import cumulative_residuals


def score_loss(logits: jax.Array, labels: jax.Array) -> jax.Array:
    """Binary cross-entropy of logits and labels (0 or 1), both [...], with both classes of equal weight."""
    share = jnp.clip(labels.mean(), 0.05, 0.95)
    weights = jnp.where(labels > 0.5, 0.5 / share, 0.5 / (1 - share))
    return jnp.mean(optax.sigmoid_binary_cross_entropy(logits, labels) * weights)


def reconstruction_losses(
    predicted: jax.Array, truth: jax.Array, weights: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Of trajectories [..., 30] with row weights [...]: mean L1 of where the fingertips are after each waypoint (unit
    lengths) and of the hand's Euler angles there (rad), and the squared distance of the start rotation's two columns.

    Both are relative to the start: errors of residuals add up to where the part is left, which decides success. Where
    the paper has one L1, the released code averages moves and turns. Its angle between rotations has no finite
    gradient at 0; the squared distance of 6D numbers (Zhou et al. 2019) has, and keeps the raw output near unit length.
    """
    difference = predicted - truth
    steps = jnp.abs(cumulative_residuals(difference))
    mean = lambda x: jnp.sum(x * weights) / jnp.maximum(weights.sum(), 1)
    moves, turns = steps[..., :3].mean((-2, -1)), steps[..., 3:].mean((-2, -1))
    return mean(moves), mean(turns), mean(jnp.sum(difference[..., :6] ** 2, -1))


def kl_loss(mean: jax.Array, log_variance: jax.Array, weights: jax.Array) -> jax.Array:
    """KL divergence (nats, summed over the latent dimensions) of Gaussians [..., latent] from the standard normal."""
    kl = 0.5 * jnp.sum(jnp.exp(log_variance) + mean**2 - 1 - log_variance, -1)
    return jnp.sum(kl * weights) / jnp.maximum(weights.sum(), 1)


def actionability_target(scores: jax.Array, best: int) -> jax.Array:
    """Mean [...] of the `best` highest of P scores (probabilities) [..., P]."""
    return jax.lax.top_k(scores, best)[0].mean(-1)


def actionability_loss(logits: jax.Array, target: jax.Array) -> jax.Array:
    """L1 between predicted and target actionability, both in [0, 1]; logits and target [...]."""
    return jnp.abs(jax.nn.sigmoid(logits) - target).mean()
