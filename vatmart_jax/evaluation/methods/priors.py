"""The priors: the contact of highest actionability and the best-scored of their proposals there, executed open loop."""

from __future__ import annotations

import jax

from vatmart_jax.envs import TrialStart
from vatmart_jax.evaluation.methods.base import EvalContext, Method, MethodOutput
from vatmart_jax.pipeline.proposal_rollouts import ProposalTrials


def make_priors_method(context: EvalContext) -> Method:
    """Raises UserError where the context has no priors."""
    priors = context.require_priors()
    trials = ProposalTrials(context.env, context.views, priors.predictor, context.num_proposals)

    def run(start: TrialStart, key: jax.Array) -> MethodOutput:
        final, _, score = trials.best(priors.params, start, key)
        return MethodOutput(final, score)

    return run
