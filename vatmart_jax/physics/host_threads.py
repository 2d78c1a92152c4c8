"""Callbacks from JAX to the host on machines with a single CPU."""

from __future__ import annotations

import os


def allow_callbacks() -> None:
    """Give XLA's pool a second thread where there is a single CPU. To be called before JAX is first used.

    XLA copies a callback's arguments on the pool of threads of which the callback occupies one: with one thread it
    would wait for itself for ever. NPROC is read when JAX's CPU backend starts; a value that is set is left alone.
    """
    cpus = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    if cpus == 1:
        os.environ.setdefault("NPROC", "2")
