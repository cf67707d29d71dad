"""Worker processes that start clean and use one thread each."""

from __future__ import annotations

import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def make_pool(workers: int) -> ProcessPoolExecutor:
    """A pool of freshly started processes (a fork would copy the parent's threads and engines).

    Several single-threaded workers beat one worker with several threads on networks of this size, so the
    numeric libraries of the workers are told to keep to one thread.
    """
    for name in _THREADS:
        os.environ.setdefault(name, "1")
    return ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))
