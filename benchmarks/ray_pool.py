"""Jobs on the machines of a Ray cluster: a pool with the face of :class:`rise_agents.pool.Pool`.

A node that sees the run folder works in it. To any other the files of a job are sent, and what it makes comes back.
Ray itself tries nothing again: what becomes of a job whose worker or node has died says the one schedule in
:mod:`benchmarks.executors`.
"""

from __future__ import annotations

import hashlib
import importlib
import platform
import tempfile
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import shipping
from benchmarks.jobs import Job
from benchmarks.shipping import Content, Scratch
from rise_agents import __version__, checkpoint
from rise_agents.files import replace_file, temporary_name
from rise_agents.plugins import import_modules, imported
from rise_agents.pool import Ended, Listener
from rise_agents.workers import limit_threads

MEMORY = 3 << 29  # bytes that a job declares; those of the paper preset take up to about 1.2 GB
_PACKAGES = ("rise_envs", "rise_agents", "benchmarks")
_SOURCES = (".py", ".toml", ".rise")
_WAIT = 1.0  # s between two looks at progress and at the clock
_MESSAGES = 500  # of progress per second that all jobs together may send


@dataclass(frozen=True)
class Order:
    """What a worker is given to do.

    Attributes:
        function: called with what hears of progress, and ``job``.
        job: its paths are those of the machine that sends it.
        inputs: the files that it may read, with their sizes.
        markers: files that a node sees if it sees the folders of the run.
        suite: what the node must have installed, see :func:`suite`.
        modules: of users, by name, or by path with what the file holds.
        every: seconds between two messages of progress.
    """

    function: Callable[..., Any]
    job: Job
    inputs: Mapping[Path, int]
    markers: tuple[Path, ...]
    suite: Mapping[str, str]
    modules: tuple[tuple[str, bytes | None], ...]
    every: float


class Mailbox:
    """The latest progress of every job, until it is asked for; an actor beside the one who asks."""

    def __init__(self) -> None:
        self._told: dict[Any, tuple[tuple, dict[Path, Content]]] = {}

    def tell(self, key: Any, content: tuple, files: dict[Path, Content]) -> None:
        """What a job has to tell, and files of it that it would go on from."""
        earlier = self._told[key][1] if key in self._told else {}
        self._told[key] = content, {**earlier, **files}

    def take(self) -> dict[Any, tuple[tuple, dict[Path, Content]]]:
        """What has come since this was last asked."""
        told, self._told = self._told, {}
        return told


# --- on a node --------------------------------------------------------------------------------------------------


def serve(
    order: Order, files: Mapping[Path, Any] | None, tell: Callable[[tuple, dict], None]
) -> dict[str, Any]:
    """Do what is ordered.

    Args:
        order: see there.
        files: what gives the content of each of its inputs; None: they were not sent.
        tell: takes progress and files.

    Returns:
        Of ``result``, ``error`` and ``trace`` those of :class:`Ended`; ``files`` and ``gone`` of a job that did not
        work in the run folder; or ``unseen``: the node does not see that, and lacks the inputs; or ``strange``: what
        is installed otherwise than it must be.
    """
    limit_threads()
    strange = differing(order.suite)
    if strange:
        return {"strange": f"node {platform.node()} has {strange}"}
    if shipping.all_here({**dict.fromkeys(order.markers, 0), **order.inputs}):
        return _done(order, shipping.rewritten(order.job, shipping.full), _Sender(order.every, tell))
    if files is None:
        return {"unseen": True}
    try:
        with Scratch({path: content() for path, content in files.items()}) as scratch:
            job = shipping.rewritten(order.job, scratch.place)
            answer = _done(order, job, _Sender(order.every, tell, scratch.news))
            return {**answer, "files": scratch.news(), "gone": scratch.gone()}
    except OSError as error:  # the node's disk is full
        return _failed(error)


def _done(order: Order, job: Job, tell: Callable[..., None]) -> dict[str, Any]:
    try:
        _import_modules(order.modules)
        return {"result": order.function(tell, job)}
    except Exception as error:  # whatever it is, the worker lives on
        return _failed(error)


def _failed(error: Exception) -> dict[str, Any]:
    return {"error": f"{type(error).__name__}: {error}", "trace": traceback.format_exc()}


class _Sender:
    """Sends progress, but not too often: the latest counts."""

    def __init__(
        self, every: float, tell: Callable[[tuple, dict], None], news: Callable[[], dict] = dict
    ) -> None:
        self._every, self._tell, self._news = every, tell, news
        self._next = 0.0

    def __call__(self, *content: Any) -> None:
        if time.monotonic() >= self._next:
            self._tell(content, self._news())
            self._next = time.monotonic() + self._every


@cache
def suite() -> dict[str, str]:
    """What results depend on, by name: the version of Python and of libraries, and the code of this suite."""
    digest = hashlib.sha256()
    for package in _PACKAGES:
        folder = Path(str(importlib.import_module(package).__file__)).parent
        for path in sorted(path for path in folder.rglob("*") if path.suffix in _SOURCES):
            digest.update(f"{package}/{path.relative_to(folder).as_posix()}\0".encode())
            digest.update(hashlib.sha256(path.read_bytes()).digest())
    own = f"{__version__} (code {digest.hexdigest()[:8]})"
    return {**checkpoint.versions(), "rise-suite": own, "Python": platform.python_version()}


def differing(theirs: Mapping[str, str]) -> str:
    """What is installed here otherwise than there, in words; empty if nothing is."""
    own = suite()
    words = [
        f"{name} {own.get(name)} instead of {value}"
        for name, value in theirs.items()
        if own.get(name) != value
    ]
    return ", ".join(words)


@cache
def _import_modules(modules: tuple[tuple[str, bytes | None], ...]) -> None:
    """Users' modules; a file that is not the same here is taken from what was sent."""
    names = []
    for name, source in modules:
        if source is not None and not (Path(name).is_file() and Path(name).read_bytes() == source):
            folder = _IMPORTED.setdefault(name, tempfile.TemporaryDirectory(prefix="rise-import-"))
            name = str(replace_file(Path(folder.name) / Path(name).name, source))
        names.append(name)
    import_modules(names)


_IMPORTED: dict[str, tempfile.TemporaryDirectory[str]] = {}


# --- on the machine that sends ----------------------------------------------------------------------------------


class RayPool:
    """At most ``workers`` jobs at once, each on a CPU of the cluster; None: as many as it has CPUs.

    A context manager; leaving it cancels what is running. ``listener`` hears what jobs tell, in :meth:`wait`.

    Args:
        ray: the module, connected.
        folders: that jobs work in, where a node sees them.
        workers: see above.
        listener: told the key of a job and what it tells.
    """

    def __init__(self, ray: Any, folders: Sequence[Path], workers: int | None, listener: Listener) -> None:
        self._ray, self._folders, self._workers, self._listener = ray, folders, workers, listener
        self._markers: tuple[Path, ...] = ()
        self._modules = tuple(
            (name, Path(name).read_bytes() if name.endswith(".py") else None) for name in imported()
        )
        self._running: dict[Any, tuple[Any, Order]] = {}
        self._sent: dict[
            tuple[Path, int], Any
        ] = {}  # file and time of its change -> its content, stored with Ray
        self._send = False  # whether a node is known that does not see all files
        self._serve = ray.remote(num_cpus=1, memory=MEMORY, max_retries=0)(_remote)
        self._mailbox: Any = None
        self._cpus = 1

    def __enter__(self) -> RayPool:
        self._markers = tuple(temporary_name(shipping.full(folder) / "seen") for folder in self._folders)
        for marker in self._markers:
            marker.touch()
        self._mailbox = self._beside(Mailbox)
        self._count()
        return self

    def __exit__(self, *exception: object) -> None:
        for task in self._running:
            self._ray.cancel(task, force=True)
        if self._running:
            self._ray.wait(list(self._running), num_returns=len(self._running), timeout=5)
        self._ray.kill(self._mailbox)
        for marker in self._markers:
            marker.unlink(missing_ok=True)

    @property
    def busy(self) -> int:
        """How many jobs are running, or wait for a CPU that others have."""
        return len(self._running)

    @property
    def free(self) -> int:
        """How many more jobs may be started."""
        return (self._workers or max(1, self._cpus)) - self.busy

    def _count(self) -> None:
        """See how large the cluster is."""
        self._cpus = int(self._ray.cluster_resources().get("CPU", 0))

    def _beside(self, kind: type) -> Any:
        """An actor on this machine, which so ends with it only."""
        strategies = self._ray.util.scheduling_strategies
        node = self._ray.get_runtime_context().get_node_id()
        here = strategies.NodeAffinitySchedulingStrategy(node, soft=False)
        return self._ray.remote(num_cpus=0, scheduling_strategy=here)(kind).remote()

    def start(self, key: Any, function: Callable[..., Any], job: Job) -> None:
        """Run ``function(tell, job)`` somewhere; a module-level function."""
        every = max(1.0, self._cpus / _MESSAGES)
        inputs = shipping.inputs(job)
        self._start(key, Order(function, job, inputs, self._markers, suite(), self._modules, every))

    def _start(self, key: Any, order: Order) -> None:
        files = {path: self._stored(path) for path in order.inputs} if self._send else None
        self._running[self._serve.remote(key, order, files, self._mailbox)] = key, order

    def _stored(self, path: Path) -> Any:
        """The content of a file, stored with Ray once."""
        version = path, path.stat().st_mtime_ns
        if version not in self._sent:
            self._sent[version] = self._ray.put(np.fromfile(path, np.uint8))
        return self._sent[version]

    def wait(self) -> list[Ended]:
        """Wait until something ends, or a second; meanwhile the listener hears what is told."""
        running = list(self._running)
        self._ray.wait(running, num_returns=1, timeout=_WAIT)
        self._hear()
        self._count()
        over, _ = self._ray.wait(running, num_returns=len(running), timeout=0)
        return [ended for task in over if (ended := self._end(task)) is not None]

    def _hear(self) -> None:
        told = {}
        with suppress(self._ray.exceptions.RayError):  # progress is not worth a failure
            told = self._ray.get(self._mailbox.take.remote(), timeout=10)
        keys = {key for key, _ in self._running.values()}
        for key, (content, files) in told.items():
            if key in keys:  # else it is late
                with suppress(OSError):
                    self._store(files)
                self._listener(key, *content)

    def _end(self, task: Any) -> Ended | None:
        """What became of a job; None if it has been started again, with its files."""
        key, order = self._running.pop(task)
        errors = self._ray.exceptions
        try:
            answer = self._ray.get(task)
        except (errors.RayTaskError, errors.RuntimeEnvSetupError) as error:  # before any code of this file
            raise ValueError(f"a node cannot run rise-suite: {_last_line(error)}") from None
        except errors.OutOfMemoryError:
            return Ended(key, died="SIGKILL")
        except errors.RayError:
            return Ended(key, died="a crash or with its node")
        if "strange" in answer:
            raise ValueError(f"{answer['strange']}: install the same on all nodes")
        if "unseen" in answer:
            self._send = True
            self._start(key, order)
            return None
        return self._kept(key, order.job, **answer)

    def _kept(
        self,
        key: Any,
        job: Job,
        files: dict[Path, Content] | None = None,
        gone: Sequence[Path] = (),
        **answer: Any,
    ) -> Ended:
        """The end of a job, what it made being stored; its output last, which says that it is done."""
        output = shipping.full(job.output)
        try:
            self._store(files or {}, output)
            for path in gone:
                path.unlink(missing_ok=True)
                with suppress(OSError):
                    path.parent.rmdir()  # if it was the last
        except OSError as error:
            return Ended(key, error=f"{type(error).__name__}: {error}")
        shipping.all_here({output: 0})
        return Ended(key, **answer)

    def _store(self, files: dict[Path, Content], last: Path | None = None) -> None:
        for path in sorted(files, key=lambda path: path == last):
            replace_file(path, files[path].tobytes())


def _remote(key: Any, order: Order, files: Mapping[Path, Any] | None, mailbox: Any) -> dict[str, Any]:
    import ray

    def fetcher(reference: Any) -> Callable[[], Content]:
        return lambda: ray.get(reference)

    wanted = None if files is None else {path: fetcher(reference) for path, reference in files.items()}
    return serve(order, wanted, lambda content, made: mailbox.tell.remote(key, content, made))


def _last_line(error: BaseException) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[-1]
