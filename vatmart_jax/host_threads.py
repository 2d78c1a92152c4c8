"""Callbacks from JAX to the host, without waiting for themselves."""

from __future__ import annotations

import os

import jax


def allow_callbacks() -> None:
    """Keep threads free for what callbacks need. To be called before JAX is first used.

    XLA copies a callback's arguments on the pool of threads of which the callback occupies one, and the program that
    called back another; with few CPUs nothing is left, and the callback waits for ever. So programs run on the thread
    that starts them, and where there is a single CPU the pool has a second thread. NPROC is read when JAX's CPU backend
    starts; a value that is set is left alone.
    """
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    cpus = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    if cpus == 1:
        os.environ.setdefault("NPROC", "2")
