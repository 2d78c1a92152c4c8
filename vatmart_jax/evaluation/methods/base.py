"""What a method is, what it gets to work with, and the methods that there are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, Protocol

import jax

from vatmart_jax.envs import Env, EnvState, TrialStart
from vatmart_jax.errors import UserError
from vatmart_jax.perception.grouped_views import GroupedViews, group_views
from vatmart_jax.priors.priors import Priors
from vatmart_jax.registry import Registry


class MethodOutput(NamedTuple):
    """B trials."""

    final: EnvState
    predicted: jax.Array | None  # [B] success probabilities, of a method that predicts them


class Method(Protocol):
    """Executes trials in the views and for the goals of `start`, whose contact and rotation it may replace."""

    def __call__(self, start: TrialStart, key: jax.Array) -> MethodOutput: ...


@dataclass(frozen=True, kw_only=True)
class EvalContext:
    """One split, and what there is to manipulate it with."""

    env: Env
    priors: Priors | None = None
    num_proposals: int = 100
    run_dir: Path | None = None  # where a trained method finds its parameters

    def require_priors(self) -> Priors:
        """Raises UserError where there are none."""
        if self.priors is None:
            raise UserError("this method needs priors, and the evaluation has none")
        return self.priors

    @cached_property
    def views(self) -> GroupedViews:
        """The environment's views as the priors' networks read them."""
        grouped = group_views(self.env.views, self.require_priors().config.networks.encoder)
        return grouped.padded(self.env.num_views)


METHODS: Registry[Callable[[EvalContext], Method]] = Registry("method")
METHODS.register("ours", "vatmart_jax.evaluation.methods.priors:make_priors_method")
METHODS.register("priors", "vatmart_jax.evaluation.methods.priors:make_priors_method")
METHODS.register("random", "vatmart_jax.evaluation.methods.random:make_random_method")
METHODS.register("expert", "vatmart_jax.evaluation.methods.scripted:make_scripted_method")
METHODS.register("scripted", "vatmart_jax.evaluation.methods.scripted:make_scripted_method")
