"""Rows of a batch shared among threads: for compiled code that needs no lock of the interpreter."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

_LEAST = 4_096  # rows that are worth a thread: waking one takes as long as some hundred vehicles


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "rise-envs")


if hasattr(os, "register_at_fork"):  # a child process has none of its parent's threads
    os.register_at_fork(after_in_child=_pool.cache_clear)


def run(work: Callable[[int, int], None], rows: int, block: int, threads: int) -> None:
    """Call ``work(first, last)`` so that all ``rows`` are covered, by several threads where it pays.

    Args:
        work: releases the interpreter's lock; writes to its own rows only.
        rows: how many there are.
        block: pieces begin at multiples of it.
        threads: at most; this one is among them.
    """
    pieces = max(1, min(threads, rows // _LEAST))
    size = -(-rows // (pieces * block)) * block
    begins = range(0, rows, size)
    others = [_pool(threads).submit(work, at, min(at + size, rows)) for at in begins[1:]]
    work(0, min(size, rows))
    for other in others:
        other.result()
