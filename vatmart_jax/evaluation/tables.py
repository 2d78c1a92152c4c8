"""Results as Markdown tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

Row = Mapping[str, Any]


def success_table(rows: Sequence[Row]) -> str:
    """Downstream success, one line per task, method and split. `predicted` is the mean of the method's own scores."""
    header = ("task", "method", "split", "success", "95% interval", "predicted", "any waypoint", "start in collision")
    lines = []
    for row in rows:
        predicted = f"{row['predicted']:.1%}" if "predicted" in row else "-"
        lines.append((
            row["task"], row["method"], row["split"], f"{row['success']:.1%}", _interval(row), predicted,
            f"{row['success_any_waypoint']:.1%}", f"{row['in_collision']:.1%}", row["trials"],
        ))  # fmt: skip
    return _markdown((*header, "trials"), lines)


def priors_table(rows: Sequence[Row]) -> str:
    """Scorer and proposals, one line per task and split."""
    names = ("accuracy", "precision", "recall", "f_score", "coverage")
    lines = [(row["task"], row["split"], *(f"{row[name]:.1%}" for name in names)) for row in rows]
    return _markdown(("task", "split", *names), lines)


def policy_table(rows: Sequence[Row]) -> str:
    """The policy on its training objects, one line per task."""
    header = ("task", "policy's success on training objects", "95% interval", "trials")
    return _markdown(header, [(r["task"], f"{r['success']:.1%}", _interval(r), r["trials"]) for r in rows])


def evaluation_tables(runs: Sequence[Row]) -> str:
    """All tables of evaluated runs that have rows, and the splits that were left out."""
    of = lambda metric: [{"task": run["task"], **row} for run in runs for row in run[metric]]
    parts = [success_table(rows)] if (rows := of("downstream")) else []
    if rows := [row for row in of("priors") if row["positives"]]:
        parts.append(priors_table(rows))
    if rows := of("policy"):
        parts.append(policy_table(rows))
    parts += [left_out(run["task"], run["left_out"]) for run in runs if run["left_out"]]
    return "\n\n".join(parts)


def left_out(task: str, reasons: Mapping[str, str]) -> str:
    """One line per split that was left out."""
    return "\n".join(f"{task}, {split}: left out; {reason}" for split, reason in reasons.items())


def _interval(row: Row) -> str:
    low, high = row["ci95"]
    return f"{low:.1%} to {high:.1%}"


def _markdown(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    lines = [f"| {' | '.join(map(str, row))} |" for row in (header, *rows)]
    return "\n".join([lines[0], "|---" * len(header) + "|", *lines[1:]])
