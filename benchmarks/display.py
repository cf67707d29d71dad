"""Progress that people watch: live bars on a terminal, plain lines everywhere else."""

from __future__ import annotations

import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from benchmarks.jobs import Job
from benchmarks.labels import count
from rise_agents.agent import Progress as Tell

_PLAIN_EVERY = 30.0  # s between two lines of the same job where there is no terminal


def _plain(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1_000 else f"{value:.3g}"


class Display:
    """Shows the steps of a run. A context manager; safe to call from several threads."""

    def __init__(self) -> None:
        self.live = sys.stderr.isatty()
        self.console = Console(stderr=True)
        self.bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f} %"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[figures]}"),
            console=self.console,
            disable=not self.live,
        )
        self._lock = threading.Lock()
        self._tasks: dict[str, TaskID] = {}
        self._told: dict[str, float] = {}
        self._total: TaskID | None = None
        self._jobs, self._finished, self._started = 0, set[str](), time.monotonic()
        self._left = Counter[str]()

    def __enter__(self) -> Display:
        self.bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.bars.stop()

    @contextmanager
    def step(self, name: str) -> Iterator[Tell]:
        """A step of this process; yields what to tell its progress."""
        started, seen = time.monotonic(), False

        def tell(share: float, figures: dict[str, float]) -> None:
            nonlocal seen
            seen = True
            self._show(name, share, figures)

        yield tell
        if seen:
            self._end(name, f"{name}: done in {time.monotonic() - started:.0f} s")
        else:
            self.say(f"{name}: there already")

    def plan(self, jobs: Sequence[Job], title: str = "") -> None:
        """Say how many jobs there will be, and of which kinds: their names begin with them."""
        self._jobs = len(jobs)
        there = sum(job.output.exists() for job in jobs)
        self._left = Counter(job.name for job in jobs)
        kinds = ", ".join(dict.fromkeys(job.name.partition(" ")[0] for job in jobs))
        self.say(
            f"{title}{count([len(jobs)], 'job')}: {kinds or 'none'}"
            + (f"; {there} done already" if there else "")
        )
        if self.live:
            self._total = self.bars.add_task("[bold]all jobs", total=len(jobs), figures="")

    def watch(self, job: Job, share: float, figures: dict[str, float]) -> None:
        """Progress of a job; share 1 means that it has ended."""
        key = str(job.output)
        if share < 1:
            if key not in self._finished:
                self._show(job.name, share, figures)
            return
        with self._lock:
            self._finished.add(key)
            self._left[job.name] -= 1
            last = not self._left[job.name]  # of the portions that a large job was cut into
        if self._total is not None:
            self.bars.update(self._total, completed=len(self._finished))
        heard = job.name in self._tasks or job.name in self._told
        words = f"[{len(self._finished)}/{self._jobs}] {job.name}" if heard and last else ""
        self._end(job.name, words)

    def _show(self, name: str, share: float, figures: dict[str, float]) -> None:
        words = "  ".join(f"{key} {_plain(value)}" for key, value in list(figures.items())[:4])
        with self._lock:
            if self.live:
                if name not in self._tasks:
                    self._tasks[name] = self.bars.add_task(name, total=1.0, figures=words)
                self.bars.update(self._tasks[name], completed=share, figures=words)
                return
            now = time.monotonic()
            last = self._told.setdefault(name, now)
            if now - last >= _PLAIN_EVERY:
                self._told[name] = now
                self.say(f"{name}: {100 * share:.0f} %  {words}")

    def _end(self, name: str, line: str) -> None:
        with self._lock:
            if name in self._tasks:
                self.bars.remove_task(self._tasks.pop(name))
        if line:
            self.say(line)

    def say(self, text: str) -> None:
        """Tell something, with the time since the start."""
        seconds = time.monotonic() - self._started
        self.console.print(f"{seconds:6.0f} s  {text}", highlight=False, markup=False, soft_wrap=True)
