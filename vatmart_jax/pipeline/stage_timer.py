"""Wall time of a run's stages, what XLA's compiler takes told apart."""

from __future__ import annotations

import time
from functools import cache
from typing import NamedTuple

import jax.monitoring

_COMPILE_EVENT = "/jax/core/compile/backend_compile_duration"  # reading a program from the compilation cache included


@cache
def _compilations() -> list[float]:
    """Seconds of each of this process's compilations from the first call on; JAX tells them to listeners alone."""
    seconds: list[float] = []

    def heard(event: str, duration_secs: float, **_: str | int) -> None:
        if event == _COMPILE_EVENT:
            seconds.append(duration_secs)

    jax.monitoring.register_event_duration_secs_listener(heard)
    return seconds


class Lap(NamedTuple):
    """Seconds."""

    working: float
    compiling: float


class Clock:
    """Runs from its making on."""

    def __init__(self) -> None:
        self._begun, self._compiled = time.monotonic(), len(_compilations())

    def lap(self) -> Lap:
        """The time since the last lap."""
        now, compilations = time.monotonic(), _compilations()
        wall, compiling = now - self._begun, sum(compilations[self._compiled :])
        self._begun, self._compiled = now, len(compilations)
        return Lap(max(0.0, wall - compiling), compiling)
