"""How good the scorer and the proposals are: labelled trajectories of the policy on objects not trained on."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vatmart_jax.evaluation import metrics as m
from vatmart_jax.perception.grouped_views import GroupedViews
from vatmart_jax.perception.interaction_buffer import Interactions
from vatmart_jax.perception.layers import Params
from vatmart_jax.perception.predictor import TTAPredictor, encode_contacts, propose_from, score_trajectories
from vatmart_jax.pipeline.exploration import ExplorationLoop
from vatmart_jax.pipeline.proposal_rollouts import interactions_of

_NOISE = 0.05  # of the policy, share of the action range: varied trajectories, most of them good


def sample_labelled_trajectories(
    explorer: ExplorationLoop, policy: Any, count: int, key: jax.Array
) -> tuple[Interactions, Interactions]:
    """`count` positives and as many negatives of the policy, from random starts (paper, section 5.1).

    A positive is a trajectory that did its task. Negatives are, half and half where there are enough, positives whose
    task is shifted off the tolerance, and trials that failed (collisions and failed grasps among them). Consumes the
    key. Fewer come back where the policy has too few successes in 40 batches.
    """
    tolerance, task = explorer.env.config.tolerance, explorer.env.task
    good: list[Interactions] = []
    bad: list[Interactions] = []
    found = 0
    for batch in range(40):
        final, _ = explorer.rollout(
            policy, None, jax.random.fold_in(key, batch), noise=_NOISE, terminate_on_failure=False
        )
        samples = jax.device_get(interactions_of(final))
        success = np.asarray(samples.success(tolerance))
        good.append(jax.tree.map(lambda a: a[success], samples))  # noqa: B023
        bad.append(jax.tree.map(lambda a: a[~success], samples))  # noqa: B023
        found += int(success.sum())
        if found >= count:
            break
    positive, failed = (jax.tree.map(lambda *a: np.concatenate(a)[:count], *rows) for rows in (good, bad))
    n = len(positive.view)
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    off = np.exp(rng.choice([-1, 1], n) * rng.uniform(0.2, 1.0, n))  # a fifth to e times off, either way
    shifted = positive.replace(
        goal=np.clip(positive.displacement * off, 0.5 * task.goal_range[0], 1.5 * task.goal_range[1])
    )
    wrong = ~np.asarray(shifted.success(tolerance))
    shifted = jax.tree.map(lambda a: a[wrong], shifted)
    half = min(n // 2, len(failed.view))
    negative = jax.tree.map(lambda a, b: np.concatenate([a[:half], b[: n - half]]), failed, shifted)
    return jax.tree.map(jnp.asarray, positive), jax.tree.map(jnp.asarray, negative)


def priors_metrics(
    predictor: TTAPredictor,
    params: Params,
    grouped_views: GroupedViews,
    positive: Interactions,
    negative: Interactions,
    *,
    key: jax.Array,
    runs: int = 10,
    proposals: int = 100,
) -> dict[str, Any]:
    """Accuracy, precision, recall, F-score and reliability of the scorer, coverage of the proposals (appendix E.1).

    Coverage is the mean of `runs` draws of `proposals` trajectories per positive. Consumes the key.
    """
    score = lambda s: np.asarray(
        score_trajectories(predictor, params, grouped_views, s.view, s.contact, goal=s.goal, trajectory=s.trajectory)
    )
    p, n = score(positive), score(negative)
    labels = np.concatenate([np.ones(len(p)), np.zeros(len(n))])
    scores = np.concatenate([p, n])
    result = {**m.scorer_metrics(scores, labels), "reliability": m.reliability(scores, labels).to_json()}
    covered = []
    proposer = TTAPredictor(predictor.networks)  # proposals are made for the view as it is
    encoded = encode_contacts(proposer, params, grouped_views, positive.view, positive.contact)
    for run in range(runs):
        proposed = propose_from(
            proposer, params, encoded, positive.goal, key=jax.random.fold_in(key, run), num_proposals=proposals
        )
        covered.append(m.coverage(np.asarray(proposed), np.asarray(positive.trajectory)))
    return {**result, "coverage": float(np.mean(covered)), "positives": len(p), "negatives": len(n)}
