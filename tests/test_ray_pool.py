"""The Ray pool without Ray: what it sends, what comes back, what becomes of the dead; the options that ask for it."""

from __future__ import annotations

import argparse
import os
import re
import socket
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks import job_options, ray_pool, shipping
from benchmarks.executors import ATTEMPTS, run_jobs
from benchmarks.jobs import Job
from benchmarks.ray_pool import RayPool
from benchmarks.run import main
from benchmarks.tune.__main__ import main as tune
from rise_agents import AGENTS, plugins
from rise_agents.files import TEMPORARY


class RayError(Exception):
    pass


class RayTaskError(RayError):
    pass


class OutOfMemoryError(RayError):
    pass


class FakeRay:
    """Does tasks when they are waited for, in this process; ``fates`` are what becomes of the first ones."""

    def __init__(self, *fates: Any, far: bool = False) -> None:
        self.fates, self.far = list(fates), far
        self.options: list[dict] = []
        self.stored: list[Any] = []
        self.cancelled: list[Any] = []
        self.exceptions = SimpleNamespace(
            RayError=RayError,
            RayTaskError=RayTaskError,
            RuntimeEnvSetupError=RayTaskError,
            OutOfMemoryError=OutOfMemoryError,
        )
        strategies = SimpleNamespace(NodeAffinitySchedulingStrategy=lambda node, soft: node)
        self.util = SimpleNamespace(scheduling_strategies=strategies)

    def get_runtime_context(self):
        return SimpleNamespace(get_node_id=lambda: "here")

    def cluster_resources(self):
        return {"CPU": 2.0}

    def remote(self, **options):
        self.options.append(options)

        def bound(thing):
            if not isinstance(thing, type):
                return SimpleNamespace(remote=lambda *arguments: Task(partial(thing, *arguments)))
            actor = thing()
            call = lambda name: lambda *arguments: Box(getattr(actor, name)(*arguments))  # noqa: E731
            methods = {name: SimpleNamespace(remote=call(name)) for name in ("tell", "take")}
            return SimpleNamespace(remote=lambda: SimpleNamespace(**methods))

        return bound

    def put(self, value):
        self.stored.append(value)
        return Box(value)

    def get(self, what, timeout=None):
        if isinstance(what, Box):
            return what.value
        if isinstance(what.outcome, Exception):
            raise what.outcome
        return what.outcome

    def _outcome(self, task):
        fate = self.fates.pop(0) if self.fates else None
        if fate is not None:
            return fate(task) if callable(fate) else fate
        return far(task) if self.far else task.work()

    def wait(self, tasks, num_returns, timeout):
        for task in tasks:
            if task.outcome is None:
                task.outcome = self._outcome(task)
        return tasks[:num_returns], tasks[num_returns:]

    def cancel(self, task, force):
        self.cancelled.append(task)

    def kill(self, actor):
        pass


class Task:
    def __init__(self, work):
        self.work, self.outcome = work, None


def far(task: Task) -> dict:
    """The task on a machine that sees nothing of this one."""
    key, order, files, mailbox = task.work.args
    return task.work.func(key, replace(order, markers=(Path("/nowhere"),)), files, mailbox)


class Box:
    def __init__(self, value):
        self.value = value


@pytest.fixture
def ran(tmp_path, monkeypatch):
    """Runs jobs on a fake cluster, in a folder; returns what failed, what was said and what was seen."""

    def run(ray: FakeRay, *jobs: Job) -> tuple[dict[str, str], list[str], list[tuple]]:
        monkeypatch.setitem(sys.modules, "ray", ray)
        said: list[str] = []
        seen: list[tuple] = []
        watch = lambda job, share, figures: seen.append((job.name, share))  # noqa: E731
        failures = run_jobs(jobs, None, watch, said.append, pool=partial(RayPool, ray, [tmp_path]))
        assert not list(tmp_path.rglob(f"{TEMPORARY}*"))
        return {failure.job.name: failure.reason for failure in failures}, said, seen

    return run


def _write(output, progress, **arguments):
    progress(0.5, {"x": 1.0})
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(f"done by {output}")


def _fail(output, progress):
    raise KeyError("nothing here")


def test_jobs_work_in_a_folder_that_all_see(ran, tmp_path):
    ray = FakeRay()
    first, second = tmp_path / "first", tmp_path / "sub" / "second"
    jobs = Job("second", _write, {}, second, needs=(first,)), Job("first", _write, {}, first)
    failures, said, seen = ran(ray, *jobs)
    assert (failures, said) == ({}, [])
    assert [name for name, share in seen if share == 1] == ["first", "second"] and ("first", 0.5) in seen
    assert second.read_text() == f"done by {second}"
    assert ray.stored == []  # nothing was sent
    assert ray.options[0] == {"num_cpus": 1, "memory": ray_pool.MEMORY, "max_retries": 0}


def test_a_path_of_the_working_folder_holds_elsewhere_too(ran, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ran(FakeRay(), Job("one", _write, {}, Path("one")))
    assert (tmp_path / "one").read_text() == f"done by {tmp_path / 'one'}"


def test_the_dead_are_tried_again_and_failures_are_not(ran, tmp_path):
    fates = [RayError("worker crashed"), OutOfMemoryError("too much")]
    failures, said, _ = ran(FakeRay(*fates), Job("third time", _write, {}, tmp_path / "a"))
    assert failures == {} and (tmp_path / "a").exists()
    assert said == [
        f"third time: its worker process ended with {how} of 3 goes on from what is stored"
        for how in ("a crash or with its node; attempt 2", "SIGKILL; attempt 3")
    ]
    failures, said, _ = ran(
        FakeRay(*[RayError()] * 9),
        Job("never", _write, {}, tmp_path / "b"),
        Job("after", _write, {}, tmp_path / "c", needs=(tmp_path / "b",)),
    )
    reason = f"its worker process ended with a crash or with its node, {ATTEMPTS} times"
    assert failures == {"never": reason, "after": "a job that it needs failed"}
    failures, said, _ = ran(FakeRay(), Job("wrong", _fail, {}, tmp_path / "d"))
    assert failures == {"wrong": "KeyError: 'nothing here'"}
    assert said == ["failed: wrong: KeyError: 'nothing here'"]


def _learn(output, progress, data, others):
    """A training as trainings are: a state that is stored, files beside the output, inputs of all kinds."""
    assert output.is_relative_to(Path(output.anchor)) and "rise-job-" in str(output)
    state = output.with_suffix(".training")
    steps = len(state.read_text()) if state.exists() else 0
    text = (
        (data / "set").read_text()
        + others[0]["one"].read_text()
        + others[0]["one"].with_suffix(".json").read_text()
    )
    state.parent.mkdir(parents=True, exist_ok=True)
    state.write_text("x" * (steps + 1))
    progress(0.5, {})
    if steps < 1 and output.stem == "0":
        raise SystemExit("killed")
    (output.parent / "events").mkdir(exist_ok=True)
    (output.parent / "events" / "one").write_text("event")
    output.with_suffix(".json").write_text("record")
    output.write_text(f"{text} in {steps + 1} steps")
    state.unlink()


def _killed(task):
    """The node does the work and is lost before the end."""
    with pytest.raises(SystemExit):
        far(task)
    return RayError("node died")


def test_files_go_to_a_node_that_sees_none_and_come_back(ran, tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "set").write_text("set, ")
    (tmp_path / "one.rise").write_text("agent, ")
    (tmp_path / "one.json").write_text("its record")
    arguments = {"data": tmp_path / "data", "others": [{"one": tmp_path / "one.rise"}]}
    jobs = [Job(f"learn {n}", _learn, arguments, tmp_path / "agents" / f"{n}.rise") for n in range(2)]
    # The first answers only say that the node sees nothing.
    ray = FakeRay(None, _killed, far=True)
    failures, said, _ = ran(ray, jobs[0])
    assert failures == {} and len(said) == 1 and "attempt 2 of 3" in said[0]
    made = {
        path.relative_to(tmp_path / "agents").as_posix(): path.read_text()
        for path in jobs[0].output.parent.rglob("*")
        if path.is_file()
    }
    assert made == {"0.rise": "set, agent, its record in 2 steps", "0.json": "record", "events/one": "event"}
    assert len(ray.stored) == 4  # three inputs once each, and the state
    assert ran(FakeRay(far=True), jobs[1])[0] == {}
    assert jobs[1].output.exists() and not jobs[1].output.with_suffix(".training").exists()


def _collect(output, progress, parts):
    output.write_text("".join(path.read_text() for path in parts))
    for path in parts:
        path.unlink()
    parts[0].parent.rmdir()


def test_what_a_job_removes_is_removed_here(ran, tmp_path):
    parts = [tmp_path / "parts" / str(n) for n in range(3)]
    parts[0].parent.mkdir()
    for path in parts:
        path.write_text(path.name)
    job = Job("collect", _collect, {"parts": parts}, tmp_path / "all", needs=tuple(parts))
    assert ran(FakeRay(far=True), job)[0] == {}
    assert (tmp_path / "all").read_text() == "012" and not parts[0].parent.exists()


def test_inputs_that_only_this_machine_has_are_sent_though_the_folder_is_seen(ran, tmp_path, monkeypatch):
    """A data set outside of the run folder, for instance."""
    (tmp_path / "data").write_text("here")
    ray = FakeRay()
    here = shipping.all_here
    monkeypatch.setattr(shipping, "all_here", lambda files: here(files) and not any(files.values()))
    assert ran(ray, Job("copy", _copy, {"source": tmp_path / "data"}, tmp_path / "copy"))[0] == {}
    assert (tmp_path / "copy").read_text() == "here" and len(ray.stored) == 1


def _copy(output, progress, source):
    output.write_text(source.read_text())


def test_a_full_disk_of_a_node_is_a_failure_of_the_job(ran, tmp_path, monkeypatch):
    (tmp_path / "data").write_text("here")

    def full(files):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(ray_pool, "Scratch", full)
    job = Job("copy", _copy, {"source": tmp_path / "data"}, tmp_path / "copy")
    assert ran(FakeRay(far=True), job)[0] == {"copy": "OSError: [Errno 28] No space left on device"}


def test_folders_of_the_killed_are_swept(tmp_path, monkeypatch):
    monkeypatch.setattr(shipping.tempfile, "gettempdir", lambda: str(tmp_path))
    gone = os.fork()
    if not gone:
        os._exit(0)
    os.waitpid(gone, 0)
    for number in (gone, os.getpid()):
        (tmp_path / f"rise-job-{number}-x").mkdir()
    (tmp_path / "rise-job-of another kind").mkdir()
    with shipping.Scratch({Path("/a/b"): np.frombuffer(b"text", np.uint8)}) as scratch:
        assert scratch.place(Path("/a/b")).read_bytes() == b"text" and not scratch.news()
    assert not scratch.root.exists()
    assert {path.name for path in tmp_path.glob("rise-job-*")} == {
        f"rise-job-{os.getpid()}-x",
        "rise-job-of another kind",
    }


def test_leaving_the_pool_cancels_what_is_running(tmp_path):
    ray = FakeRay()
    with RayPool(ray, [tmp_path], 3, print) as pool:
        assert len(list(tmp_path.iterdir())) == 1  # what says that a node sees the folder
        pool.start(0, _write, Job("one", _write, {}, tmp_path / "one"))
        assert (pool.busy, pool.free) == (1, 2)
    assert len(ray.cancelled) == 1 and not list(tmp_path.iterdir())


def test_a_node_with_other_code_or_libraries_ends_the_run(ran, tmp_path, monkeypatch):
    monkeypatch.setattr(ray_pool, "suite", dict)  # of the one who sends: nothing is demanded
    assert ray_pool.differing({"torch": "2.0"}) == "torch None instead of 2.0"
    theirs = iter([{"torch": "2.0"}, {"torch": "2.1"}])
    monkeypatch.setattr(ray_pool, "suite", lambda: next(theirs))
    with pytest.raises(
        ValueError, match=r"^node .* has torch 2.1 instead of 2.0: install the same on all nodes$"
    ):
        ran(FakeRay(), Job("one", _write, {}, tmp_path / "one"))


def test_the_suite_is_known_by_its_code():
    assert set(ray_pool.suite()) > {"rise-suite", "Python", "numpy", "torch"}
    assert ray_pool.differing(ray_pool.suite()) == ""
    version, code = re.fullmatch(r"(\S+) \(code (\w{8})\)", ray_pool.suite()["rise-suite"]).groups()
    other = {"rise-suite": f"{version} (code {'0' * 8})"}
    assert ray_pool.differing(other) == f"rise-suite {version} (code {code}) instead of {other['rise-suite']}"


def test_a_node_that_lacks_the_suite_ends_the_run(ran, tmp_path):
    fate = RayTaskError("lines\nModuleNotFoundError: No module named 'benchmarks'")
    with pytest.raises(ValueError, match="a node cannot run rise-suite: ModuleNotFoundError: No module"):
        ran(FakeRay(fate), Job("one", _write, {}, tmp_path / "one"))


def test_a_file_of_users_goes_along(tmp_path, own_names):
    source = tmp_path / "not_there.py"
    text = b"from rise_agents import AGENTS\nAGENTS['sent'] = 'nowhere:Sent'\n"
    ray_pool._import_modules(((str(source), text),))
    assert "sent" in AGENTS and "not_there" in sys.modules
    assert str(source) not in plugins._IMPORTED


def test_progress_is_sent_at_a_limited_rate(monkeypatch):
    now, sent = [0.0], []
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    tell = ray_pool._Sender(2.0, lambda content, files: sent.append(content))
    for step in range(100):
        now[0] = 0.1 * step
        tell(step)
    assert [step for (step,) in sent] == [0, 20, 40, 60, 80]


def test_the_mailbox_keeps_the_latest_of_each():
    box = ray_pool.Mailbox()
    box.tell("a", (0.1,), {Path("x"): np.zeros(1, np.uint8)})
    box.tell("a", (0.2,), {Path("y"): np.zeros(2, np.uint8)})
    box.tell("b", (0.3,), {})
    told = box.take()
    assert {key: content for key, (content, _) in told.items()} == {"a": (0.2,), "b": (0.3,)}
    assert set(told["a"][1]) == {Path("x"), Path("y")}
    assert box.take() == {}


@pytest.mark.parametrize("command", [main, tune])
@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--executor", "rya"], "unknown executor 'rya': did you mean 'ray'"),
        (["--ray-address", "x:1"], "--ray-address is for --executor ray"),
        (["--executor", "ray", "--ray-address", "nonsense"], "--ray-address takes HOST:PORT"),
        (["--executor", "ray", "--ray-address", "ray://host:1"], "--ray-address takes HOST:PORT"),
    ],
)
def test_bad_options_get_one_line(command, options, reason, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(job_options.importlib.util, "find_spec", lambda name: name)
    assert command(options) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and reason in error
    assert not list(tmp_path.iterdir())


def test_an_address_that_does_not_answer_is_named(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(job_options.importlib.util, "find_spec", lambda name: name)
    with socket.socket() as closed:  # bound, but nobody listens
        closed.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{closed.getsockname()[1]}"
        assert main(["--executor", "ray", "--ray-address", address, "--out", str(tmp_path / "x")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and f"--ray-address {address}: no answer from there" in error


def test_where_a_cluster_is_looked_for(tmp_path, monkeypatch):
    """Where it answers; one that has ended leaves the file in which Ray would find it, and would wait for it."""
    monkeypatch.setenv("RAY_TMPDIR", str(tmp_path))
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    assert [job_options._checked(given) for given in (None, "local")] == ["local", "local"]
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen()
        address = f"127.0.0.1:{listening.getsockname()[1]}"
        (tmp_path / "ray").mkdir()
        (tmp_path / "ray" / "ray_current_cluster").write_text(address)
        assert [job_options._checked(given) for given in (None, "auto", address)] == [
            "auto",
            "auto",
            address,
        ]
        monkeypatch.setenv("RAY_ADDRESS", address)
        assert job_options._checked(None) == address
    with pytest.raises(ValueError, match=f"^RAY_ADDRESS {address}: no answer"):
        job_options._checked(None)
    monkeypatch.delenv("RAY_ADDRESS")
    assert job_options._checked(None) == "local"
    with pytest.raises(ValueError, match=r"^--ray-address auto: this machine is part of no Ray cluster$"):
        job_options._checked("auto")


def _arguments(**others):
    parser = argparse.ArgumentParser()
    job_options.add_options(parser)
    return argparse.Namespace(**{**vars(parser.parse_args([])), "executor": "ray", "device": "cpu", **others})


def test_without_ray_the_extra_is_named(monkeypatch):
    monkeypatch.setattr(job_options.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pip install 'rise-suite\[ray\]'"):
        job_options.check(_arguments())
    job_options.check(_arguments(executor="local"))


def test_a_device_is_refused():
    with pytest.raises(ValueError, match="--executor ray gives each job a CPU"):
        job_options.check(_arguments(device="cuda"))
