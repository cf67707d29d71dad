"""How jobs run: in an order that respects what needs what, reported on, and again if a worker dies.

Who does the work is a pool: the processes of this machine, or a Ray cluster (:mod:`benchmarks.ray_pool`).
"""

from __future__ import annotations

import heapq
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from benchmarks.jobs import Job
from rise_agents.pool import Ended, Listener, Pool

# Told the job, the share that is done in [0, 1] and its figures of the moment; share 1 means that it has ended: if it
# ended well, its figures are the "seconds" and "core_seconds" that it took.
Watcher = Callable[[Job, float, dict[str, float]], None]
ATTEMPTS = 3  # that a job gets if its worker process dies, which may be no fault of the job


@dataclass(frozen=True)
class Failure:
    """A job that did not end well, and why; ``trace`` says where, for who looks for a defect."""

    job: Job
    reason: str
    trace: str = ""


class Crew(Protocol):
    """What works; :class:`rise_agents.pool.Pool` says more."""

    def __enter__(self) -> Crew: ...
    def __exit__(self, *exception: object) -> None: ...
    @property
    def busy(self) -> int:
        """How many jobs are running."""

    @property
    def free(self) -> int:
        """How many more may be started."""

    def start(self, key: Any, function: Callable[..., Any], job: Job, /) -> None:
        """Call ``function`` with who hears of progress, and the job."""

    def wait(self) -> list[Ended]:
        """What has ended, after a second at most."""


MakeCrew = Callable[
    [int | None, Listener], Crew
]  # of a number of workers (None: all there are) and who listens


def _work(tell: Callable[..., None], job: Job) -> dict[str, float]:
    """Do a job; returns how long it took."""
    started, used = time.perf_counter(), time.process_time()
    job.run(job.output, tell, **job.arguments)
    return {"seconds": time.perf_counter() - started, "core_seconds": time.process_time() - used}


def never() -> bool:
    """No time limit."""
    return False


def run_jobs(
    jobs: Sequence[Job],
    workers: int | None,
    watch: Watcher,
    say: Callable[[str], None] = lambda line: None,
    time_is_up: Callable[[], bool] = never,
    longest_first: bool = True,
    pool: MakeCrew = Pool,
    exists: Callable[[Path], bool] = Path.exists,
) -> list[Failure]:
    """Run all jobs whose output is missing; those that need a failed job's output are not run.

    Args:
        jobs: in any order.
        workers: jobs at once, at most; None: one per core.
        watch: told of progress.
        say: told, in one line, when a worker process has died or a job has failed.
        time_is_up: asked about once a second; when it is, what runs is interrupted and nothing more is started.
        longest_first: start the longest job first of those that can start, else the first in ``jobs``.
        pool: makes what works.
        exists: whether a file is there.

    Returns:
        What failed. A failure stops nothing but the jobs that depend on it. Jobs whose output is missing, but which
        did not fail, were left when time was up.
    """
    for job in jobs:
        if exists(job.output):
            watch(job, 1.0, {})
    pending = [job for job in jobs if not exists(job.output)]
    if longest_first:
        pending.sort(key=lambda job: -job.weight)
    if not pending:
        return []

    def listen(number: int, share: float, figures: dict[str, float]) -> None:
        watch(pending[number], min(share, 0.999), figures)  # only its end makes it whole

    with pool(workers, listen) as crew:
        return _Schedule(crew, pending, watch, say, exists).run(time_is_up)


class _Schedule:
    """Which of the ``pending`` jobs wait, and what became of the others."""

    def __init__(
        self,
        pool: Crew,
        pending: list[Job],
        watch: Watcher,
        say: Callable[[str], None],
        exists: Callable[[Path], bool],
    ) -> None:
        self.pool, self.pending, self.watch, self.say, self.exists = pool, pending, watch, say, exists
        self.deaths = Counter[int]()
        self.failures: list[Failure] = []
        self.lacking: dict[int, set[Path]] = {}  # of jobs that cannot start yet, what they need
        self.waited_for = defaultdict[Path, list[int]](list)
        for number, job in enumerate(pending):
            for path in dict.fromkeys(job.needs):
                if not exists(path):
                    self.lacking.setdefault(number, set()).add(path)
                    self.waited_for[path].append(number)
        self.ready = [number for number in range(len(pending)) if number not in self.lacking]  # a heap

    def run(self, time_is_up: Callable[[], bool]) -> list[Failure]:
        while (self.ready or self.lacking or self.pool.busy) and not time_is_up():
            for _ in range(min(self.pool.free, len(self.ready))):
                number = heapq.heappop(self.ready)
                self.pool.start(number, _work, self.pending[number])
            if not self.pool.busy:  # what is left needs something that failed
                left = (self.pending[number] for number in self.lacking)
                return self.failures + [Failure(job, "a job that it needs failed") for job in left]
            for ended in self.pool.wait():
                self.note(ended)
        return self.failures

    def made(self, path: Path) -> None:
        for number in self.waited_for.pop(path, ()):
            self.lacking[number].remove(path)
            if not self.lacking[number]:
                del self.lacking[number]
                heapq.heappush(self.ready, number)

    def note(self, ended: Ended) -> None:
        job, reason = self.pending[ended.key], ended.error
        done = self.exists(job.output)  # whatever became of its process
        if done:
            self.made(job.output)
        if ended.died and not done:
            self.deaths[ended.key] += 1
            died = f"its worker process ended with {ended.died}"
            if self.deaths[ended.key] < ATTEMPTS:
                attempt = f"attempt {self.deaths[ended.key] + 1} of {ATTEMPTS}"
                self.say(f"{job.name}: {died}; {attempt} goes on from what is stored")
                heapq.heappush(self.ready, ended.key)
                return
            memory = " (out of memory?)" if ended.died == "SIGKILL" else ""
            reason = f"{died}{memory}, {ATTEMPTS} times"
        elif not reason and not done:
            reason = f"it ended without writing {job.output}"
        if reason:
            self.failures.append(Failure(job, reason, ended.trace))
            self.say(f"failed: {job.name}: {reason}")
        self.watch(job, 1.0, ended.result or {})
