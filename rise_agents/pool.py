"""Worker processes that may die: each runs one task at a time, and one that dies takes only its own task with it.

Every worker has a pipe of its own (a queue that all share could be left locked by the one that is killed), ends
with its parent however that ends, and leaves Ctrl-C to it.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Any

from rise_agents.plugins import import_modules, imported
from rise_agents.workers import available_cores, limit_threads

# Told the key of a task and whatever it had to tell.
Listener = Callable[..., None]
_HUSH = "ignore:resource_tracker"
_ALIVE_EVERY = 1.0  # s between two looks at who is still alive


class TaskError(RuntimeError):
    """A task that could not be done, and why."""


@dataclass(frozen=True)
class Ended:
    """A task that is over.

    Attributes:
        key: of the task.
        result: what its function returned.
        error: what it raised instead, in words.
        trace: where.
        died: how its process ended instead: the name of the signal, or the exit code.
    """

    key: Any
    result: Any = None
    error: str = ""
    trace: str = ""
    died: str = ""


class Pool:
    """At most ``workers`` freshly started processes (a fork would copy the parent's threads and engines).

    None: as many as there are cores.

    A context manager; leaving it ends all workers at once. ``listener`` hears what tasks tell, in :meth:`wait`.
    """

    def __init__(self, workers: int | None, listener: Listener = lambda key, *told: None) -> None:
        self.workers, self.listener = workers or available_cores(), listener
        self._crew: list[_Worker] = []

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *exception: object) -> None:
        try:
            for worker in self._crew:
                worker.connection.close()  # which sends the idle home
                if worker.task is not None:
                    worker.process.terminate()
            for worker in self._crew:
                worker.process.join(5)
        finally:  # also if the user loses patience
            for worker in self._crew:
                worker.process.kill()

    @property
    def busy(self) -> int:
        """How many tasks are running."""
        return sum(worker.task is not None for worker in self._crew)

    @property
    def free(self) -> int:
        """How many more tasks may be started."""
        return self.workers - self.busy

    def start(self, key: Any, function: Callable[..., Any], *arguments: Any) -> None:
        """Run ``function(tell, *arguments)`` in a free worker; a module-level function."""
        self._crew = [w for w in self._crew if w.task is not None or w.process.is_alive()]
        idle = [worker for worker in self._crew if worker.task is None]
        if not idle:
            idle = [_Worker()]
            self._crew += idle
        idle[0].give(key, function, arguments)

    def wait(self) -> list[Ended]:
        """Wait until something ends, or a second; meanwhile the listener hears what is told."""
        busy = [worker for worker in self._crew if worker.task is not None]
        wait([w.connection for w in busy] + [w.process.sentinel for w in busy], _ALIVE_EVERY)
        return [ended for worker in busy if (ended := worker.news(self.listener)) is not None]


class _Worker:
    """The parent's side of a worker process."""

    def __init__(self) -> None:
        limit_threads()
        _hush_tracker()
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        # Not daemonic: some tasks start processes themselves.
        self.process = context.Process(target=_serve, args=(theirs, imported()), daemon=False)
        self.task: Any = None
        resource_tracker.ensure_running()  # which would lift the block
        with _interrupts_blocked():
            self.process.start()
        theirs.close()

    def give(self, key: Any, function: Callable[..., Any], arguments: tuple) -> None:
        self.task = (key,)
        try:
            self.connection.send((function, arguments))
        except OSError:
            pass  # it has died: told by news()

    def news(self, listener: Listener) -> Ended | None:
        """Hear what there is to hear; the end of the task, if it is over."""
        key = self.task[0]
        alive = self.process.is_alive()  # asked first: what the dead have sent is all there
        try:
            while self.connection.poll():
                kind, content = self.connection.recv()
                if kind == "told":
                    listener(key, *content)
                    continue
                self.task = None
                return Ended(key, **content)
        except (EOFError, OSError):
            self.process.join(_ALIVE_EVERY)
            alive = self.process.is_alive()
        if alive:
            return None
        self.task = None
        return Ended(key, died=_how(self.process.exitcode or 0))


def _how(exitcode: int) -> str:
    if exitcode >= 0:
        return f"exit code {exitcode}"
    try:
        return signal.Signals(-exitcode).name
    except ValueError:  # real-time signals have no names
        return f"signal {-exitcode}"


def _hush_tracker() -> None:
    """Python's resource tracker cleans up after killed processes, and is proud of it on stderr; it need not be."""
    known = os.environ.get("PYTHONWARNINGS", "")
    if _HUSH not in known:
        os.environ["PYTHONWARNINGS"] = f"{known},{_HUSH}".strip(",")


@contextmanager
def _interrupts_blocked() -> Any:
    """Processes started in this block never see a Ctrl-C, which the terminal sends to all: their parent ends them."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(connection: Connection, modules: tuple[str, ...]) -> None:
    """A worker: does what it is given until nothing more comes; users' ``modules`` are imported before."""
    end_with_parent()

    def tell(*content: Any) -> None:
        connection.send(("told", content))

    while True:
        try:
            function, arguments = connection.recv()
        except (EOFError, OSError):
            return
        try:
            import_modules(modules)
            answer = {"result": function(tell, *arguments)}
        except Exception as error:  # whatever it is, the worker lives on
            answer = {"error": f"{type(error).__name__}: {error}", "trace": traceback.format_exc()}
        connection.send(("ended", answer))


_watching = False


def end_with_parent() -> None:
    """End this process as soon as the one that started it is gone, however that ended."""
    global _watching
    parent = multiprocessing.parent_process()
    if parent is None or _watching:
        return
    _watching = True

    def watch() -> None:
        parent.join()
        os._exit(1)  # there is nobody left to work for

    threading.Thread(target=watch, daemon=True).start()
