"""`vatmart evaluate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from vatmart_jax.cli.common import JsonFlag, Output, names, physics_impl, prepare_jax
from vatmart_jax.errors import UserError, require_positive
from vatmart_jax.evaluation.methods.base import METHODS
from vatmart_jax.reporting import ConsoleReporter
from vatmart_jax.workflows.evaluate import METRICS, EvaluationPlan, evaluate


@dataclass(frozen=True)
class Evaluate:
    """Evaluate trained priors on test shapes and unseen categories."""

    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN")]
    """run folders of `vatmart train`, or names of pretrained priors, such as push-door"""
    data: Path | None = None
    """default: the data that the run was trained on"""
    metrics: str = "priors,downstream"
    """priors (accuracy, coverage), downstream (success), policy (on training objects); several with commas"""
    methods: str = "ours,random"
    """of downstream: ours, random, expert (a script that knows the joint: the ceiling)"""
    trials: int = 350
    """per method and split"""
    impl: str | None = None
    """physics; default as for training"""
    seed: int = 1
    out: Path | None = None
    """folder for evaluation.json, evaluation.md and reliability.png; default the run folder"""
    json: JsonFlag = False

    def run(self) -> Output:
        if not self.runs:
            raise UserError("no run; give one or more run folders of `vatmart train`")
        require_positive("--trials", self.trials)
        plan = EvaluationPlan(
            impl=physics_impl(self.impl),
            metrics=names("--metrics", self.metrics, METRICS),
            methods=names("--methods", self.methods, METHODS.names()),
            trials=self.trials,
            seed=self.seed,
            data=self.data,
        )
        prepare_jax()
        with ConsoleReporter() as reporter:
            return Output(*evaluate(self.runs, plan, out=self.out, reporter=reporter))
