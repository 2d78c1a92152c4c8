"""One task's trouble stays its own, and a loaded machine refuses nothing."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest

from conversion import worker_pool
from conversion.model import ObjectError
from conversion.worker_pool import Outcome, run_tasks


def _misbehave(folder: Path, how: str) -> str:
    if how == "hang":
        time.sleep(600)
    if how == "compute":  # within one call of a library, which hears no exception
        np.linalg.svd(np.ones((6000, 6000)))
    if how == "sleep":
        time.sleep(2.5)
    if how == "die":
        os._exit(3)
    if how == "raise":
        raise KeyError("x")
    if how == "refuse":
        raise ObjectError(f"{folder.name}: no")
    return how


def outcomes(folder: Path, *ways: str, cpu_limit: float | None = None, jobs: int = 2) -> dict[str, Outcome]:
    tasks = [(folder / how, how) for how in ways]
    return {task[1]: out for task, out in run_tasks(_misbehave, tasks, jobs, label="Testing", cpu_limit=cpu_limit)}


def test_processes_that_hang_compute_die_or_raise_cost_only_their_own_task(tmp_path, monkeypatch):
    monkeypatch.setattr(worker_pool, "MIN_WALL", 20.0)
    ways = ("hang", "compute", "die", "raise", "refuse", "work", "work2")
    found = outcomes(tmp_path, *ways, cpu_limit=1)
    assert found["hang"].error == "no result after 20 s; raise --time-limit"
    assert found["compute"].error == "took longer than 1 s of processor time; raise --time-limit"
    assert found["die"].error == "the process died (exit code 3)"
    assert str(found["raise"].error).startswith("KeyError: 'x' (test_worker_pool.py:")
    assert found["refuse"].error == "refuse: no"
    assert [found[way].value for way in ("work", "work2")] == ["work", "work2"]
    assert {way for way in ways if found[way].transient} == {"hang", "compute", "die", "raise"}


def test_waiting_for_the_machine_is_not_processor_time(tmp_path):
    """As on a machine so loaded that a task of little work takes longer than the limit."""
    assert outcomes(tmp_path, "sleep", cpu_limit=1)["sleep"].value == "sleep"


def test_a_caller_that_stops_early_leaves_no_process(tmp_path):
    tasks = [(tmp_path / how, how) for how in ("work", "hang", "hang")]
    running = run_tasks(_misbehave, tasks, 2, label="Testing", cpu_limit=100)
    assert next(running)[1].value == "work"
    running.close()
    assert not worker_pool.multiprocessing.active_children()


@pytest.mark.parametrize("jobs", [1, 2])
def test_without_a_limit_tasks_run_to_their_end(tmp_path, jobs):
    found = outcomes(tmp_path, "raise", "work", jobs=jobs)
    assert found["work"].value == "work" and found["raise"].transient
