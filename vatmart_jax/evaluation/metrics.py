"""Numbers of the evaluation (paper, appendix E.1), on host arrays."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import binomtest

COVERAGE_THRESHOLD = 10.0  # the paper's
ALIASES = {"predicted": "said", "observed": "happened", "calibration_gap": "gap", "ece": "expected_error"}
"""JSON keys of a reliability curve -> the names that version 0.1 gave them, which stay."""


class Reliability(NamedTuple):
    """Predicted against observed success, in K equal bins of the prediction; empty bins are NaN."""

    predicted: np.ndarray  # [K] mean prediction
    observed: np.ndarray  # [K] share of positives
    count: np.ndarray  # [K] int
    calibration_gap: float  # |mean prediction - share of positives|, over all rows
    ece: float  # expected calibration error: mean over rows of their bin's |predicted - observed|

    def to_json(self) -> dict[str, Any]:
        """Its filled bins, and both errors; each also by the name that version 0.1 gave it."""
        filled = self.count > 0
        curve = {name: getattr(self, name)[filled].round(4).tolist() for name in ("predicted", "observed", "count")}
        curve |= {"calibration_gap": self.calibration_gap, "ece": self.ece}
        return curve | {old: curve[new] for new, old in ALIASES.items()}


def scorer_metrics(scores: np.ndarray, labels: np.ndarray, threshold: float = 0.5) -> dict[str, float]:
    """Accuracy (mean of the two classes' recalls), precision, recall and F-score of the positives.

    scores: [n] probabilities; labels: [n], true or 1 where positive. A ratio without anything below the line is 0.
    """
    predicted, true = np.asarray(scores) > threshold, np.asarray(labels).astype(bool)
    ratio = lambda a, b: float(a / b) if b else 0.0
    hits = np.sum(predicted & true)
    precision, recall = ratio(hits, predicted.sum()), ratio(hits, true.sum())
    rejected = ratio(np.sum(~predicted & ~true), np.sum(~true))
    return {
        "accuracy": (recall + rejected) / 2,
        "precision": precision,
        "recall": recall,
        "f_score": ratio(2 * precision * recall, precision + recall),
    }


def trajectory_distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """D [...] = 5 D_pos + D_ori of trajectories [..., 30] that broadcast.

    D_pos is the L1 distance of the fingertip's positions relative to the start (residuals summed up, unit lengths),
    D_ori the angle (rad) between the hand's rotations, as the released code's 6D rotation loss takes it. Both are
    summed over the waypoints, the start pose included. The paper does not say whether it sums or averages; the sum is
    the stricter.
    """
    (position_a, rotation_a), (position_b, rotation_b) = _poses(a), _poses(b)
    position = np.abs(position_a - position_b).sum((-2, -1))
    trace = np.sum(rotation_a * rotation_b, (-2, -1))
    return 5 * position + np.arccos(np.clip((trace - 1) / 2, -1, 1)).sum(-1)


def coverage(proposed: np.ndarray, truth: np.ndarray, threshold: float = COVERAGE_THRESHOLD) -> float:
    """Share of true trajectories [n, 30] that one of their proposals [n, P, 30] comes closer to than the threshold."""
    return float(np.mean(trajectory_distance(proposed, np.asarray(truth)[:, None]).min(-1) < threshold))


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson's score interval of a success rate; (0, 1) without trials."""
    if trials == 0:
        return 0.0, 1.0
    found = binomtest(successes, trials).proportion_ci(confidence, method="wilson")
    return float(found.low), float(found.high)


def reliability(scores: np.ndarray, labels: np.ndarray, bins: int = 10) -> Reliability:
    """The reliability curve of scores [n] in [0, 1] against labels [n]."""
    scores, labels = np.asarray(scores, float), np.asarray(labels, float)
    where = np.minimum((scores * bins).astype(int), bins - 1)
    count = np.bincount(where, minlength=bins)
    total: Any = np.where(count > 0, count, np.nan)
    predicted = np.bincount(where, scores, bins) / total
    observed = np.bincount(where, labels, bins) / total
    n = max(len(scores), 1)
    gap = abs(float(scores.sum() - labels.sum())) / n
    return Reliability(predicted, observed, count, gap, float(np.nansum(count * np.abs(predicted - observed)) / n))


def _poses(trajectory: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions relative to the start [..., 5, 3] and rotations [..., 5, 3, 3] of the waypoints."""
    trajectory = np.asarray(trajectory, np.float64)
    lead = trajectory.shape[:-1]
    up, forward = trajectory[..., :3], trajectory[..., 3:6]
    up = up / np.maximum(np.linalg.norm(up, axis=-1, keepdims=True), 1e-9)
    forward = forward - np.sum(forward * up, -1, keepdims=True) * up
    forward = forward / np.maximum(np.linalg.norm(forward, axis=-1, keepdims=True), 1e-9)
    start = np.stack([forward, np.cross(up, forward), up], -1)
    steps = np.cumsum(trajectory[..., 6:].reshape(*lead, -1, 6), -2)
    steps = np.concatenate([np.zeros((*lead, 1, 6)), steps], -2)
    turns = Rotation.from_euler("XYZ", steps[..., 3:].reshape(-1, 3)).as_matrix().reshape(*lead, -1, 3, 3)
    return steps[..., :3], start[..., None, :, :] @ turns
