"""Progress and messages of long jobs: a protocol, bars in a terminal or now and then a line in a log, and silence."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn


class Reporter(Protocol):
    """Where a job reports to."""

    def progress(self, stage: str, done: int, total: int, metrics: Mapping[str, float] | None = None) -> None:
        """`done` of `total` units of a stage; `metrics`: the few that are worth showing."""
        ...

    def info(self, text: str) -> None:
        """One line for whoever watches."""
        ...


class NullReporter:
    """Reports nothing."""

    def progress(self, stage: str, done: int, total: int, metrics: Mapping[str, float] | None = None) -> None:
        pass

    def info(self, text: str) -> None:
        pass


class ConsoleReporter:
    """One bar per stage on standard error; in a log a line every few seconds. Use as a context manager."""

    _SECONDS_BETWEEN_LINES = 10.0

    def __init__(self) -> None:
        console = Console(stderr=True)
        self._terminal = console.is_terminal
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        self._progress = Progress(*columns, TextColumn("{task.fields[note]}"), console=console)
        self._tasks: dict[str, TaskID] = {}
        self._console, self._printed = console, 0.0

    def __enter__(self) -> ConsoleReporter:
        if self._terminal:
            self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._terminal:
            self._progress.stop()

    def progress(self, stage: str, done: int, total: int, metrics: Mapping[str, float] | None = None) -> None:
        note = "  ".join(f"{name} {value:.3g}" for name, value in (metrics or {}).items())
        if self._terminal:
            if stage not in self._tasks:
                self._tasks[stage] = self._progress.add_task(stage, total=total, note="")
            self._progress.update(self._tasks[stage], completed=done, total=total, note=note)
        elif done == total or time.monotonic() - self._printed > self._SECONDS_BETWEEN_LINES:
            self._printed = time.monotonic()
            self._console.print(f"{stage} {done}/{total}  {note}", highlight=False, soft_wrap=True)

    def info(self, text: str) -> None:
        """One line above the bars."""
        self._console.print(text, highlight=False, soft_wrap=True)
