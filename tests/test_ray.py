"""A Ray cluster of two nodes makes the tables of the local pool: if both see the run folder, or one; if one is lost."""

from __future__ import annotations

import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO

import pytest

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        shutil.which("ray", path=str(Path(sys.executable).parent)) is None, reason="needs Ray"
    ),
]
ROOT = Path(__file__).parents[1]
RAY = str(Path(sys.executable).parent / "ray")
SMOKE = ["--preset", "smoke", "--agents", "rise", "pcbc", "cppo", "--envs", "RISE-GroundVehicle-v0"]
# Long enough to be missed when their node is gone.
SMOKE += ["--set", "rise.updates=8000", "pcbc.updates=8000"]
# Tests in the background inherit that Ctrl-C is ignored.
COMMAND = """
import runpy, signal
signal.signal(signal.SIGINT, signal.default_int_handler)
runpy.run_module("benchmarks.run", run_name="__main__")
"""
ENVIRONMENT = {
    **os.environ,
    "PYTHONPATH": str(ROOT),
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_AUTH_MODE": "token",
    "RAY_AUTH_TOKEN": secrets.token_hex(32),
    "RAY_worker_niceness": "0",  # else a busy machine leaves them nothing
}
ALL_HERE = """
import sys, time, ray
ray.init(sys.argv[1], logging_level="ERROR")
while sum(node["Alive"] for node in ray.nodes()) < 2:
    time.sleep(0.1)
"""
FAR = 'mount -t tmpfs none "$1" && shift && exec "$@"'  # in a view of the file system of its own
UNSHARE = shutil.which("unshare") or "unshare"


def blinded(command: list[str], folder: Path) -> list[str]:
    """``command`` such that it sees nothing of a folder."""
    return [UNSHARE, "-rm", "sh", "-c", FAR, "sh", str(folder), *command]


def can_be_blinded() -> bool:
    with suppress(OSError):
        return not subprocess.run(blinded(["true"], ROOT), check=False, capture_output=True).returncode
    return False


@contextmanager
def process(command: list[str], **options) -> Iterator[subprocess.Popen]:
    """A process and all that it starts, for the time of the block."""
    with subprocess.Popen(command, env=ENVIRONMENT, start_new_session=True, **options) as started:
        try:
            yield started
        finally:
            if started.poll() is None:
                started.terminate()  # Ray ends what it has started
                with suppress(subprocess.TimeoutExpired):
                    started.wait(30)
            kill(started)


def kill(started: subprocess.Popen) -> None:
    with suppress(ProcessLookupError):
        os.killpg(started.pid, signal.SIGKILL)


@contextmanager
def node(*options: str, blind: Path | None = None) -> Iterator[subprocess.Popen]:
    """A node of a cluster; it sees nothing of the folder ``blind``."""
    command = [RAY, "start", "--block", "--disable-usage-stats", *options]
    seeing = command if blind is None else blinded(command, blind)
    with process(seeing, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as started:
        yield started


@contextmanager
def cluster(head: int, second: int, blind: Path | None = None) -> Iterator[tuple[str, subprocess.Popen]]:
    """The address of a cluster whose two nodes have so many CPUs, and the second one."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"127.0.0.1:{port}"
    local = "--node-ip-address=127.0.0.1"
    with ExitStack() as stack:
        options = [f"--port={port}", "--include-dashboard=false", f"--num-cpus={head}", local]
        stack.enter_context(node("--head", *options))
        wait_for(lambda: listens(port))
        other = stack.enter_context(node(f"--address={address}", f"--num-cpus={second}", local, blind=blind))
        # A run starts with the nodes that are there, and on a fast machine is over before the second one comes.
        subprocess.run([sys.executable, "-c", ALL_HERE, address], env=ENVIRONMENT, check=True, timeout=1200)
        yield address, other


def listens(port: int) -> bool:
    with suppress(OSError):
        socket.create_connection(("127.0.0.1", port), 1).close()
        return True
    return False


def wait_for(true) -> None:
    until = time.monotonic() + 1200
    while not true():
        assert time.monotonic() < until, "in vain"
        time.sleep(0.1)


def run(out: Path, *options: str, log: IO[str] | int = subprocess.PIPE) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-c", COMMAND, *SMOKE, "--checkpoint-every", "0", *options, "--out", str(out)],
        env=ENVIRONMENT,
        start_new_session=True,
        stdout=subprocess.DEVNULL,
        stderr=log,
        text=True,
    )


def on(address: str) -> tuple[str, ...]:
    return "--executor", "ray", "--ray-address", address, "--workers", "2"


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """What the local pool makes."""
    out = tmp_path_factory.mktemp("local") / "run"
    started = run(out)
    _, error = started.communicate(timeout=1200)
    assert started.returncode == 0, error
    return out


def check_same(out: Path, made: Path) -> None:
    """All files are there, those of results byte for byte."""
    files = [{str(p.relative_to(each)) for p in each.rglob("*") if p.is_file()} for each in (made, out)]
    assert files[0] == files[1]
    for name in files[0]:
        if name.endswith((".parquet", ".csv", ".rise")) and name != "job_times.csv":
            assert (out / name).read_bytes() == (made / name).read_bytes(), name


def test_nodes_that_see_the_run_folder(made, tmp_path):
    with cluster(1, 1) as (address, _):
        started = run(tmp_path / "run", *on(address))
        _, error = started.communicate(timeout=1200)
    assert started.returncode == 0, error
    check_same(tmp_path / "run", made)


@pytest.mark.skipif(not can_be_blinded(), reason="needs user namespaces")
def test_a_node_that_does_not_see_the_run_folder(made, tmp_path):
    """The head has no CPU: everything runs on the other one."""
    with cluster(0, 2, blind=tmp_path) as (address, _):
        started = run(tmp_path / "run", *on(address))
        _, error = started.communicate(timeout=1200)
    assert started.returncode == 0, error
    check_same(tmp_path / "run", made)


def test_a_node_that_is_lost_and_a_run_that_is_interrupted(made, tmp_path):
    """Its job goes on on the other node; after Ctrl-C the local pool does the rest."""
    out, said = tmp_path / "run", tmp_path / "said"
    with cluster(1, 1) as (address, second), said.open("w") as log:
        started = run(out, *on(address), log=log)
        wait_for(lambda: all(list(out.glob(f"agents/*/{who}-*.training")) for who in ("rise", "pcbc")))
        kill(second)
        # Each node had one of them. Until Ray misses the lost one, the other does all that does not wait for it.
        wait_for(lambda: "attempt 2 of 3" in said.read_text() or started.poll() is not None)
        assert started.poll() is None, said.read_text()
        os.killpg(started.pid, signal.SIGINT)
        started.wait(120)
    error = said.read_text()
    assert started.returncode == 130, error
    assert "attempt 2 of 3" in error and "Traceback" not in error
    assert "interrupted; what is finished is kept" in error
    assert not (out / "episodes.parquet").exists()
    # A training that is killed while it writes leaves a piece; the next run removes that. The run itself leaves none.
    assert {piece.suffix for piece in out.rglob(".partial-*")} <= {".training"}
    started = run(out)
    _, error = started.communicate(timeout=1200)
    assert started.returncode == 0, error
    check_same(out, made)
