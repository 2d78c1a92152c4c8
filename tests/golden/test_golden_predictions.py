"""Pretrained priors answer about one cloud as they answered."""

from __future__ import annotations

import numpy as np
import pytest
from adapter import PRETRAINED, predict
from record import VALUES, held


def box_cloud() -> tuple[np.ndarray, np.ndarray]:
    """3,000 points [N, 3] of a cabinet's front, side and top, and which of them lie on its upper front [N] bool."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (3000, 3)) * (0.3, 0.4, 0.45)
    front, side = points[:1800], points[1800:2400]
    front[:, 0], side[:, 1], points[2400:, 2] = -0.3, 0.4, 0.45
    handle = front[:120]
    handle[:] = rng.uniform(-1, 1, handle.shape) * (0.01, 0.08, 0.01) + (-0.34, 0.0, 0.2)
    mask = np.zeros(3000, bool)
    mask[:1800] = front[:, 2] > 0
    order = rng.permutation(3000)
    return points[order].astype(np.float32), mask[order]


@pytest.mark.slow
@pytest.mark.parametrize("name", PRETRAINED)
def test_pretrained_priors_answer_as_they_did(name):
    points, mask = box_cloud()
    found = predict(name, points, mask, 0.4, 8)
    shown = {
        "contact_index": int(found["contact_index"]),
        "actionability_mean": found["actionability"].mean(dtype=np.float64),
        "actionability_max": found["actionability"].max(),
        "actionability_first": found["actionability"][:5],
        "best_trajectory": found["trajectories"][0],
        "scores": found["scores"],
    }
    shown = {k: v if isinstance(v, int) else np.round(np.asarray(v, np.float64), 7).tolist() for k, v in shown.items()}
    golden = held(f"predict-{name}.json", shown)
    assert shown.keys() == golden.keys()
    assert shown["contact_index"] == golden["contact_index"]
    for key, value in golden.items():
        assert shown[key] == pytest.approx(value, rel=0, abs=2e-5), key


def test_no_pretrained_priors_are_gone():
    assert {path.stem for path in VALUES.glob("predict-*.json")} == {f"predict-{name}" for name in PRETRAINED}
