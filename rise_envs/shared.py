"""Rows of a batch shared among threads: for compiled code that needs no lock of the interpreter."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import TypeVar

T = TypeVar("T")


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "rise-envs")


if hasattr(os, "register_at_fork"):  # a child process has none of its parent's threads
    os.register_at_fork(after_in_child=_pool.cache_clear)


def run(work: Callable[[int, int], T], rows: int, threads: int, piece: int) -> list[T]:
    """Call ``work(first, last)`` so that all ``rows`` are covered, on several threads if there are several pieces.

    Args:
        work: releases the interpreter's lock; writes to its own rows only.
        rows: how many there are.
        threads: at most; this one is among them. Each takes the next piece when it is done with one, so that
            none waits for another that the system has slowed down.
        piece: rows of one call, worth the waking of a thread.

    Returns:
        What the pieces gave, in no order.
    """
    begins = iter(range(0, rows, piece))  # its next() is one step of the interpreter: no piece is taken twice

    def share() -> list[T]:
        return [work(first, min(first + piece, rows)) for first in begins]

    helpers = min(threads, -(-rows // piece)) - 1
    if not helpers:  # to wait for nobody takes time, too
        return share()
    others = [_pool(threads).submit(share) for _ in range(helpers)]
    try:
        own = share()
    finally:
        wait(others)  # nobody writes any more when this returns, whatever happened
    return sum((other.result() for other in others), own)
