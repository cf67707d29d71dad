"""How jobs run: a local pool of processes that respects what needs what and reports progress."""

from __future__ import annotations

import multiprocessing
import queue
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any

from benchmarks.jobs import Job
from rise_agents.workers import limit_threads, stop

# Told the job, the share that is done in [0, 1] and its figures of the moment.
Watcher = Callable[[Job, float, dict[str, float]], None]

_messages: Any = None  # in a worker: the queue that leads back to the parent


@dataclass(frozen=True)
class Failure:
    """A job that did not end well, and why."""

    job: Job
    reason: str


def _start_worker(messages: Any) -> None:
    global _messages
    _messages = messages


def _work(number: int, job: Job) -> None:
    def progress(share: float, figures: dict[str, float]) -> None:
        _messages.put((number, share, figures))

    job.run(job.output, progress, **job.arguments)


def run_jobs(jobs: Sequence[Job], workers: int, watch: Watcher) -> list[Failure]:
    """Run all jobs whose output is missing; those that need a failed job's output are not run.

    Args:
        jobs: in any order.
        workers: processes.
        watch: told of progress, in this process, from another thread; share 1 means done.

    Returns:
        What failed. A failure stops nothing but the jobs that depend on it.
    """
    pending = sorted((job for job in jobs if not job.output.exists()), key=lambda job: -job.weight)
    for job in jobs:
        if job.output.exists():
            watch(job, 1.0, {})
    if not pending:
        return []
    limit_threads()
    context = multiprocessing.get_context("spawn")
    messages = context.Queue()
    relay = threading.Thread(target=_relay, args=(messages, pending, watch), daemon=True)
    relay.start()
    try:
        with ProcessPoolExecutor(
            min(workers, len(pending)), context, initializer=_start_worker, initargs=(messages,)
        ) as pool:
            try:
                return _schedule(pool, pending, workers, watch)
            except BaseException:
                stop(pool)
                raise
    finally:
        messages.put(None)
        relay.join(timeout=5)


def _schedule(pool: ProcessPoolExecutor, pending: list[Job], workers: int, watch: Watcher) -> list[Failure]:
    failures: list[Failure] = []
    running: dict[Future[None], int] = {}
    waiting = dict(enumerate(pending))
    while waiting or running:
        ready = [n for n, job in waiting.items() if all(path.exists() for path in job.needs)]
        for number in ready[: workers - len(running)]:
            running[pool.submit(_work, number, waiting.pop(number))] = number
        if not running:  # what is left needs something that failed
            failures += [Failure(job, "a job that it needs failed") for job in waiting.values()]
            return failures
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            job = pending[running.pop(future)]
            error = future.exception()
            if isinstance(error, BrokenProcessPool):
                lost = [pending[n] for n in running.values()]
                reason = "its worker process died (killed, or out of memory); run the command again to resume"
                return [*failures, *(Failure(each, reason) for each in [job, *lost, *waiting.values()])]
            if error is not None:
                failures.append(Failure(job, f"{type(error).__name__}: {error}"))
            watch(job, 1.0, {})
    return failures


def _relay(messages: Any, pending: list[Job], watch: Watcher) -> None:
    """Hand the workers' messages to the watcher until a None comes."""
    while True:
        try:
            message = messages.get(timeout=1)
        except queue.Empty:
            continue
        except (EOFError, OSError):
            return
        if message is None:
            return
        number, share, figures = message
        if share < 1:  # the end of a job is told by its future
            watch(pending[number], share, figures)
