"""Progress on standard error: bars in a terminal, now and then a line in a log."""

from __future__ import annotations

import time

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn


class Bars:
    """One bar per stage; call it with (stage, done, total, metrics). Use as a context manager."""

    _SECONDS_BETWEEN_LINES = 10.0

    def __init__(self) -> None:
        console = Console(stderr=True)
        self._terminal = console.is_terminal
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        self._progress = Progress(*columns, TextColumn("{task.fields[note]}"), console=console)
        self._tasks: dict[str, TaskID] = {}
        self._console, self._printed = console, 0.0

    def __enter__(self) -> Bars:
        if self._terminal:
            self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._terminal:
            self._progress.stop()

    def __call__(self, stage: str, done: int, total: int, metrics: dict[str, float]) -> None:
        shown = ("success", "reward", "loss", "score_loss", "kl_loss", "actionability_loss", "valid")
        note = "  ".join(f"{name} {metrics[name]:.3g}" for name in shown if name in metrics)
        if self._terminal:
            if stage not in self._tasks:
                self._tasks[stage] = self._progress.add_task(stage, total=total, note="")
            self._progress.update(self._tasks[stage], completed=done, total=total, note=note)
        elif done == total or time.monotonic() - self._printed > self._SECONDS_BETWEEN_LINES:
            self._printed = time.monotonic()
            self._console.print(f"{stage} {done}/{total}  {note}", highlight=False, soft_wrap=True)

    def say(self, text: str) -> None:
        """One line above the bars."""
        self._console.print(text, highlight=False, soft_wrap=True)
