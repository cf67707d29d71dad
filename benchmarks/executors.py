"""How jobs run: a local pool of processes that respects what needs what, reports progress and outlives its workers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from benchmarks.jobs import Job
from rise_agents.pool import Ended, Pool

# Told the job, the share that is done in [0, 1] and its figures of the moment; share 1 means that it has ended.
Watcher = Callable[[Job, float, dict[str, float]], None]
ATTEMPTS = 3  # that a job gets if its worker process dies, which may be no fault of the job


@dataclass(frozen=True)
class Failure:
    """A job that did not end well, and why; ``trace`` says where, for who looks for a defect."""

    job: Job
    reason: str
    trace: str = ""


def _work(tell: Callable[..., None], job: Job) -> None:
    job.run(job.output, tell, **job.arguments)


def never() -> bool:
    """No time limit."""
    return False


def run_jobs(
    jobs: Sequence[Job],
    workers: int,
    watch: Watcher,
    say: Callable[[str], None] = lambda line: None,
    time_is_up: Callable[[], bool] = never,
    longest_first: bool = True,
) -> list[Failure]:
    """Run all jobs whose output is missing; those that need a failed job's output are not run.

    Args:
        jobs: in any order.
        workers: processes.
        watch: told of progress.
        say: told, in one line, when a worker process has died or a job has failed.
        time_is_up: asked about once a second; when it is, what runs is interrupted and nothing more is started.
        longest_first: start the longest job first of those that can start, else the first in ``jobs``.

    Returns:
        What failed. A failure stops nothing but the jobs that depend on it. Jobs whose output is missing, but which
        did not fail, were left when time was up.
    """
    for job in jobs:
        if job.output.exists():
            watch(job, 1.0, {})
    pending = [job for job in jobs if not job.output.exists()]
    if longest_first:
        pending.sort(key=lambda job: -job.weight)
    if not pending:
        return []

    def listen(number: int, share: float, figures: dict[str, float]) -> None:
        watch(pending[number], min(share, 0.999), figures)  # only its end makes it whole

    with Pool(min(workers, len(pending)), listen) as pool:
        return _Schedule(pool, pending, watch, say).run(time_is_up)


class _Schedule:
    """Which of the ``pending`` jobs wait, and what became of the others."""

    def __init__(self, pool: Pool, pending: list[Job], watch: Watcher, say: Callable[[str], None]) -> None:
        self.pool, self.pending, self.watch, self.say = pool, pending, watch, say
        self.waiting = dict(enumerate(pending))
        self.deaths = Counter[int]()
        self.failures: list[Failure] = []

    def run(self, time_is_up: Callable[[], bool]) -> list[Failure]:
        while (self.waiting or self.pool.busy) and not time_is_up():
            ready = [n for n, job in self.waiting.items() if all(path.exists() for path in job.needs)]
            for number in ready[: self.pool.free]:
                self.pool.start(number, _work, self.waiting.pop(number))
            if not self.pool.busy:  # what is left needs something that failed
                left = self.waiting.values()
                return self.failures + [Failure(job, "a job that it needs failed") for job in left]
            for ended in self.pool.wait():
                self.note(ended)
        return self.failures

    def note(self, ended: Ended) -> None:
        job, reason = self.pending[ended.key], ended.error
        if ended.died and not job.output.exists():  # a job is done when its output is there
            self.deaths[ended.key] += 1
            died = f"its worker process ended with {ended.died}"
            if self.deaths[ended.key] < ATTEMPTS:
                attempt = f"attempt {self.deaths[ended.key] + 1} of {ATTEMPTS}"
                self.say(f"{job.name}: {died}; {attempt} goes on from what is stored")
                self.waiting[ended.key] = job
                return
            memory = " (out of memory?)" if ended.died == "SIGKILL" else ""
            reason = f"{died}{memory}, {ATTEMPTS} times"
        elif not reason and not job.output.exists():
            reason = f"it ended without writing {job.output}"
        if reason:
            self.failures.append(Failure(job, reason, ended.trace))
            self.say(f"failed: {job.name}: {reason}")
        self.watch(job, 1.0, {})
