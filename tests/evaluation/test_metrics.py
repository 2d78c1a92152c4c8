"""Metrics against scikit-learn, SciPy and closed forms."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm
from sklearn import metrics as sk
from sklearn.calibration import calibration_curve

from vatmart_jax.evaluation import metrics as m


@pytest.mark.parametrize("seed", range(5))
def test_scorer_metrics_are_those_of_scikit_learn(seed: int) -> None:
    rng = np.random.default_rng(seed)
    labels, scores = rng.random(200) < 0.3, rng.random(200)
    predicted, found = scores > 0.5, m.scorer_metrics(scores, labels)
    assert found["accuracy"] == pytest.approx(sk.balanced_accuracy_score(labels, predicted))
    assert found["precision"] == pytest.approx(sk.precision_score(labels, predicted))
    assert found["recall"] == pytest.approx(sk.recall_score(labels, predicted))
    assert found["f_score"] == pytest.approx(sk.f1_score(labels, predicted))


def test_a_scorer_that_rejects_all_scores_zero_without_warnings() -> None:
    assert m.scorer_metrics(np.zeros(4), np.array([1, 1, 0, 0])) == {
        "accuracy": 0.5, "precision": 0.0, "recall": 0.0, "f_score": 0.0,
    }  # fmt: skip


def wilson(successes: int, trials: int, z: float) -> tuple[float, float]:
    """The closed form (Wilson 1927)."""
    rate, scale = successes / trials, 1 + z * z / trials
    half = z * np.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials**2)) / scale
    centre = (rate + z * z / (2 * trials)) / scale
    return centre - half, centre + half


@given(trials=st.integers(1, 2000), share=st.floats(0, 1), confidence=st.floats(0.5, 0.999))
def test_wilson_interval_is_its_closed_form(trials: int, share: float, confidence: float) -> None:
    k = round(share * trials)
    expected = wilson(k, trials, norm.ppf(0.5 + confidence / 2))
    np.testing.assert_allclose(m.wilson_interval(k, trials, confidence), expected, atol=1e-9)


def test_a_reliability_curve_has_its_old_keys_beside_the_new_ones() -> None:
    found = m.reliability(np.array([0.2, 0.9]), np.array([0, 1])).to_json()
    assert found["said"] == found["predicted"] and found["happened"] == found["observed"] == [0.0, 1.0]
    assert found["gap"] == found["calibration_gap"] and found["expected_error"] == found["ece"]


def test_without_trials_nothing_is_known() -> None:
    assert m.wilson_interval(0, 0) == (0.0, 1.0)


def test_reliability_curve_is_that_of_scikit_learn() -> None:
    rng = np.random.default_rng(0)
    scores = rng.random(3000)
    labels = rng.random(3000) < scores**2
    found = m.reliability(scores, labels)
    observed, predicted = calibration_curve(labels, scores, n_bins=10)
    np.testing.assert_allclose(found.observed, observed)
    np.testing.assert_allclose(found.predicted, predicted)
    assert found.calibration_gap == pytest.approx(1 / 2 - 1 / 3, abs=0.02)
    assert found.ece == pytest.approx(1 / 6, abs=0.02)
    assert found.count.sum() == 3000


def test_empty_bins_of_a_reliability_curve_are_nan_and_do_not_count() -> None:
    found = m.reliability(np.array([0.05, 1.0]), np.array([0, 1]))
    assert np.isnan(found.predicted[1:9]).all()
    assert found.ece == pytest.approx(0.025)


def trajectory(**changes) -> np.ndarray:
    t = np.zeros(30)
    t[:6] = [1, 0, 0, 0, 0, 1]
    for name, value in changes.items():
        t[int(name[1:])] = value
    return t


def test_distance_of_positions_is_five_times_their_l1_at_every_waypoint() -> None:
    # The first move is 0.1 longer along x, so that four waypoints are off by 0.1.
    assert m.trajectory_distance(trajectory(), trajectory(_6=0.1)) == pytest.approx(5 * 4 * 0.1)
    assert m.trajectory_distance(trajectory(), trajectory(_24=0.1, _25=-0.2)) == pytest.approx(5 * 0.3)


def test_distance_of_rotations_is_the_angle_at_every_waypoint() -> None:
    assert m.trajectory_distance(trajectory(), trajectory(_9=0.3)) == pytest.approx(4 * 0.3)
    turned = trajectory(_0=np.cos(0.2), _1=np.sin(0.2))
    assert m.trajectory_distance(trajectory(), turned) == pytest.approx(5 * 0.2)


def test_coverage_counts_truths_that_have_a_near_proposal() -> None:
    truth = np.stack([trajectory(), trajectory(_6=1.0)])
    far, near = trajectory(_6=3.0), trajectory(_6=0.4)
    proposed = np.stack([np.stack([far, near]), np.stack([far, far])])
    assert m.coverage(proposed, truth) == 0.5
    assert m.coverage(proposed, truth, threshold=1.0) == 0.0
