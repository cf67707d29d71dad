"""Workers that die take only their own task with them; jobs are tried again, up to a limit."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from benchmarks.executors import ATTEMPTS, run_jobs
from benchmarks.jobs import Job
from rise_agents.pool import Pool


def _square(tell, x):
    tell("half", x)
    return x * x


def _fail(tell):
    raise KeyError("nothing here")


def _die(tell, how):
    os.kill(os.getpid(), how)
    time.sleep(60)


def _sleep(tell, path):
    Path(path).write_text(str(os.getpid()))
    time.sleep(60)


def _threads(tell):
    import numba
    import torch

    return torch.get_num_threads(), numba.get_num_threads()


def everything(pool: Pool, count: int) -> dict:
    ended = {}
    while len(ended) < count:
        ended |= {each.key: each for each in pool.wait()}
    return ended


def test_results_errors_deaths_and_what_tasks_tell():
    told = []
    with Pool(2, lambda key, *content: told.append((key, content))) as pool:
        pool.start("a", _square, 3)
        pool.start("b", _die, signal.SIGKILL)
        assert (pool.busy, pool.free) == (2, 0)
        ended = everything(pool, 2)
        pool.start("c", _fail)
        pool.start("d", _square, 4)
        ended |= everything(pool, 2)
    assert (ended["a"].result, ended["d"].result) == (9, 16)
    assert ended["b"].died == "SIGKILL"
    assert ended["c"].error == "KeyError: 'nothing here'" and "_fail" in ended["c"].trace
    assert told == [("a", ("half", 3)), ("d", ("half", 4))]


def test_a_worker_keeps_to_one_thread(monkeypatch):
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    with Pool(1) as pool:
        pool.start("a", _threads)
        ended = everything(pool, 1)["a"]
    assert ended.result == (1, 1)


def test_a_signal_without_a_name_is_numbered():
    with Pool(1) as pool:
        pool.start(0, _die, 40)
        assert everything(pool, 1)[0].died == "signal 40"


def test_a_worker_is_used_again():
    with Pool(1) as pool:
        for x in range(3):
            pool.start(x, _square, x)
            everything(pool, 1)
        assert len(pool._crew) == 1


def test_leaving_the_pool_ends_what_is_running(tmp_path):
    with Pool(1) as pool:
        pool.start(0, _sleep, tmp_path / "pid")
        while not (tmp_path / "pid").exists() or not (tmp_path / "pid").read_text():
            time.sleep(0.01)
    assert _gone(int((tmp_path / "pid").read_text()))


def _gone(pid: int) -> bool:
    for _ in range(1000):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.01)
    return False


def _parent(path):
    with Pool(1) as pool:
        pool.start(0, _sleep, path)
        while True:
            pool.wait()


def test_workers_end_with_their_parent_even_if_it_is_killed(tmp_path):
    parent = multiprocessing.get_context("spawn").Process(target=_parent, args=(tmp_path / "pid",))
    parent.start()
    while not (tmp_path / "pid").exists() or not (tmp_path / "pid").read_text():
        time.sleep(0.01)
    parent.kill()
    parent.join()
    assert _gone(int((tmp_path / "pid").read_text()))


def _write_at_the_third_attempt(output, progress, tally):
    with tally.open("a") as file:
        file.write("x")
    if len(tally.read_text()) < 3:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(60)
    output.write_text("done")


def _always_die(output, progress):
    os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(60)


def _write(output, progress):
    progress(0.5, {"x": 1.0})
    output.write_text("done")


def _write_and_die(output, progress):
    with output.open("a") as file:
        file.write("once")
    os.kill(os.getpid(), 40)  # a real-time signal, which has no name
    time.sleep(60)


def _write_nothing(output, progress):
    pass


def test_a_killed_worker_is_named_and_its_job_tried_again_up_to_a_limit(tmp_path):
    said, seen = [], []
    jobs = [
        Job("third time", _write_at_the_third_attempt, {"tally": tmp_path / "tally"}, tmp_path / "a"),
        Job("never", _always_die, {}, tmp_path / "b"),
        Job("after never", _write, {}, tmp_path / "c", needs=(tmp_path / "b",)),
        Job("fine", _write, {}, tmp_path / "d"),
        Job("empty", _write_nothing, {}, tmp_path / "e"),
        Job("done before it died", _write_and_die, {}, tmp_path / "f"),
    ]
    failures = run_jobs(jobs, 2, lambda job, share, figures: seen.append((job.name, share)), said.append)
    assert {failure.job.name: failure.reason for failure in failures} == {
        "never": f"its worker process ended with SIGKILL (out of memory?), {ATTEMPTS} times",
        "after never": "a job that it needs failed",
        "empty": f"it ended without writing {tmp_path / 'e'}",
    }
    assert (tmp_path / "f").read_text() == "once"
    assert (tmp_path / "a").read_text() == (tmp_path / "d").read_text() == "done"
    assert sum("third time" in line and "SIGTERM" in line for line in said) == 2
    assert (
        sum("never: its" in line and "SIGKILL" in line and "attempt" in line for line in said) == ATTEMPTS - 1
    )
    assert ("fine", 0.5) in seen and ("fine", 1.0) in seen


@pytest.mark.parametrize("workers", [1, 3])
def test_jobs_wait_for_what_they_need(tmp_path, workers):
    order = []
    jobs = [
        Job("second", _write, {}, tmp_path / "b", needs=(tmp_path / "a",), weight=9),
        Job("first", _write, {}, tmp_path / "a"),
    ]
    done = lambda job, share, figures: order.append(job.name) if share == 1 else None  # noqa: E731
    assert not run_jobs(jobs, workers, done)
    assert order == ["first", "second"]


_INTERRUPTED = """
import signal
import sys
from pathlib import Path
signal.signal(signal.SIGINT, signal.default_int_handler)  # tests in the background inherit that it is ignored
sys.path.insert(0, {tests!r})
from test_pool import _sleep
from rise_agents.pool import Pool

if __name__ == "__main__":
    try:
        with Pool(2) as pool:
            for n in range(2):
                pool.start(n, _sleep, f"pid{{n}}")
            while True:
                pool.wait()
    except KeyboardInterrupt:
        print("interrupted")
"""


def _blocked(tell):
    return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])


def test_every_worker_is_born_deaf_to_ctrl_c():
    """The first one too: what starts beside it lifts the block."""
    with Pool(2) as pool:
        for n in range(2):
            pool.start(n, _blocked)
        assert [ended.result for ended in everything(pool, 2).values()] == [True, True]


def test_ctrl_c_reaches_the_parent_only(tmp_path):
    """A terminal sends it to the whole group; the workers say nothing and are gone."""
    script = tmp_path / "script.py"
    script.write_text(_INTERRUPTED.format(tests=str(Path(__file__).parent)))
    process = subprocess.Popen(
        [sys.executable, str(script)],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])},
    )
    paths = [tmp_path / f"pid{n}" for n in range(2)]
    while not all(path.exists() and path.read_text() for path in paths):
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGINT)
    out, error = process.communicate(timeout=60)
    assert (out, error) == ("interrupted\n", "")
    assert all(_gone(int(path.read_text())) for path in paths)
