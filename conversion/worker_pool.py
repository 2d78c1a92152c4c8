"""Many independent tasks in processes of their own: one that hangs, dies or raises costs only itself."""

from __future__ import annotations

import multiprocessing
import os
import signal
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import TimeoutError as FutureTimeoutError
from concurrent.futures import as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pebble import ProcessExpired, ProcessPool
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from vatmart_jax.errors import UserError
from vatmart_jax.registry import load_plugins

# A task that waits for something and does not compute is stopped after so many times its processor time, in seconds.
WALL_PER_CPU, MIN_WALL = 10, 60.0
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of one task."""

    value: Any = None
    error: str | None = None
    transient: bool = False  # out of time, a crash or a bug: another attempt may end otherwise


def run_tasks(
    function: Callable[..., Any], tasks: Sequence[tuple], jobs: int, *, label: str, cpu_limit: float | None = None
) -> Iterator[tuple[tuple, Outcome]]:
    """Run function(*task) for every task on `jobs` processes; yields each task with its outcome as it ends.

    cpu_limit: seconds of processor time per task, so that a loaded machine refuses nothing. A UserError is an error of
    the task; everything else that a task raises, and the death of its process, is transient. With one job and no limit
    tasks run in this process.
    """
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        bar = progress.add_task(label, total=len(tasks))
        outcomes = _inline(function, tasks) if jobs == 1 and cpu_limit is None else None
        for task, outcome in outcomes or _in_processes(function, tasks, jobs, cpu_limit):
            progress.advance(bar)
            yield task, outcome


def _inline(function: Callable[..., Any], tasks: Sequence[tuple]) -> Iterator[tuple[tuple, Outcome]]:
    for task in tasks:
        yield task, _call(function, task, None)


def _in_processes(
    function: Callable[..., Any], tasks: Sequence[tuple], jobs: int, cpu_limit: float | None
) -> Iterator[tuple[tuple, Outcome]]:
    # Forking a process that may run JAX's threads is not safe.
    context = multiprocessing.get_context("spawn")
    wall = None if cpu_limit is None else _wall_limit(cpu_limit)
    with _single_threaded(), ProcessPool(max(1, min(jobs, len(tasks))), context=context) as pool:
        try:
            futures: dict[Any, tuple] = {
                pool.schedule(_call, (function, task, cpu_limit), timeout=wall): task for task in tasks
            }
            for future in as_completed(futures):
                yield futures[future], _outcome_of(future, cpu_limit)
        except BaseException:  # the caller stops early
            pool.stop()
            raise


def _wall_limit(cpu_limit: float) -> float:
    return max(WALL_PER_CPU * cpu_limit, MIN_WALL)


def _outcome_of(future: Any, cpu_limit: float | None) -> Outcome:
    try:
        return future.result()
    except FutureTimeoutError:
        return Outcome(error=f"no result after {_wall_limit(cpu_limit or 0):g} s; raise --time-limit", transient=True)
    except ProcessExpired as e:
        if cpu_limit is not None and e.exitcode == -signal.SIGPROF:
            error = f"took longer than {cpu_limit:g} s of processor time; raise --time-limit"
        else:
            error = f"the process died (exit code {e.exitcode})"
        return Outcome(error=error, transient=True)


def _call(function: Callable[..., Any], task: tuple, cpu_limit: float | None) -> Outcome:
    if cpu_limit is not None:
        # The default action ends the process, also within a library that never returns to Python.
        signal.signal(signal.SIGPROF, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_PROF, cpu_limit)
    try:
        load_plugins()
        return Outcome(value=function(*task))
    except UserError as e:
        return Outcome(error=str(e))
    except Exception as e:  # whatever one task does, the others go on
        where = traceback.extract_tb(e.__traceback__)[-1]
        error = f"{type(e).__name__}: {e} ({Path(where.filename).name}:{where.lineno})"
        return Outcome(error=error, transient=True)
    finally:
        if cpu_limit is not None:
            signal.setitimer(signal.ITIMER_PROF, 0)


@contextmanager
def _single_threaded() -> Iterator[None]:
    """Processes started within have one thread each: they are the parallelism."""
    saved = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in saved.items():
            os.environ.pop(name, None) if value is None else os.environ.update({name: value})
