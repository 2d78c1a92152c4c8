"""Wall time of a run's stages, what XLA's compiler takes told apart."""

from __future__ import annotations

import time
from typing import NamedTuple

import jax.monitoring

_COMPILE_EVENT = "/jax/core/compile/backend_compile_duration"  # reading a program from the compilation cache included
_compiling = 0.0  # seconds in this process


def _heard(event: str, duration_secs: float, **_: str | int) -> None:
    global _compiling
    if event == _COMPILE_EVENT:
        _compiling += duration_secs


jax.monitoring.register_event_duration_secs_listener(_heard)


class Lap(NamedTuple):
    """Seconds."""

    working: float
    compiling: float


class Clock:
    """Runs from its making on."""

    def __init__(self) -> None:
        self._begun, self._compiling = time.monotonic(), _compiling

    def lap(self) -> Lap:
        """The time since the last lap."""
        begun, compiled = self._begun, self._compiling
        self._begun, self._compiling = time.monotonic(), _compiling
        compiling = _compiling - compiled
        return Lap(max(0.0, self._begun - begun - compiling), compiling)
