"""Cores, threads and memory of this process and of those that it starts."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def limit_threads() -> None:
    """Tell the numeric libraries of processes started from here on to keep to one thread each.

    Several single-threaded workers beat one worker with several threads on networks of this size.
    """
    for name in THREADS:
        os.environ.setdefault(name, "1")


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch with one thread, and then with as many as before.

    Networks of this size lose time to a second one, and one thread sums in one order.
    """
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def keep_freed_memory() -> None:
    """Let the C library keep up to 256 MiB that this process frees, where it is glibc.

    It hands the activations of a batch back to the system after every update, which clears and maps them anew for
    the next one: of a RISE update that was a third of the time.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt:
        trim_threshold, mmap_threshold = -1, -3  # as malloc.h numbers them
        mallopt(trim_threshold, 256 << 20)
        mallopt(mmap_threshold, 32 << 20)  # the largest that it accepts
