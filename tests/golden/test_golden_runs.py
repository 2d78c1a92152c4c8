"""Tiny runs through every stage log the metrics that they logged."""

from __future__ import annotations

import pytest
from adapter import RUNS, tiny_run
from record import held

pytestmark = pytest.mark.usefixtures("quick_to_compile")


@pytest.mark.slow
@pytest.mark.parametrize("task", RUNS)
def test_a_tiny_run_logs_what_it_logged(cabinets, tmp_path, task):
    rows = tiny_run(cabinets, task, tmp_path)
    golden = held(f"run-{task}.json", [_rounded(row) for row in rows])
    assert [(row["stage"], row["step"]) for row in rows] == [(row["stage"], row["step"]) for row in golden]
    for row, expected in zip(rows, golden, strict=True):
        where = f"{row.pop('stage')} {row['step']}"
        del expected["stage"]
        assert row == pytest.approx(expected, rel=2e-3, abs=2e-4), where


def _rounded(row: dict) -> dict:
    return {name: value if isinstance(value, str) else float(f"{value:.6g}") for name, value in row.items()}
