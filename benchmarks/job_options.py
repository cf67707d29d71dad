"""How jobs run: the options of command lines that start some, and the pool that they stand for."""

from __future__ import annotations

import argparse
import importlib.util
import logging
import os
import socket
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from rise_agents.cli import prepare_folder
from rise_agents.workers import THREADS, limit_threads

EXECUTORS = ("local", "ray")
_PATIENCE = 10.0  # s for the head of a cluster to answer


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options that say how and where jobs run."""
    parser.add_argument(
        "--workers",
        type=int,
        metavar="N",
        help="jobs at once (default: one per core); results do not depend on it",
    )
    parser.add_argument(
        "--executor",
        default="local",
        metavar="NAME",
        help="where jobs run: local (processes of this machine, the default) or ray (a Ray cluster, docs/cluster.md)",
    )
    parser.add_argument(
        "--ray-address",
        metavar="HOST:PORT",
        help="head of the Ray cluster (default: what RAY_ADDRESS says, else the cluster that this machine is part of,"
        " else Ray is started here)",
    )
    parser.add_argument(
        "--checkpoint-every",
        type=float,
        default=15.0,
        metavar="S",
        help="seconds between two checkpoints of a training, from which it goes on if interrupted (default: 15)",
    )
    parser.add_argument(
        "--tensorboard",
        type=Path,
        metavar="DIR",
        help="write the figures of every training there as event files, which TensorBoard draws",
    )


def check(arguments: argparse.Namespace) -> None:
    """Raise ``ValueError`` for values out of range, options that do not go together, or a package that lacks."""
    if arguments.workers is not None and arguments.workers < 1:
        raise ValueError(f"--workers must be at least 1, got {arguments.workers}")
    if not arguments.checkpoint_every >= 0:
        raise ValueError(f"--checkpoint-every must not be negative, got {arguments.checkpoint_every}")
    if arguments.tensorboard is not None:
        from rise_agents.figures import check_installed

        check_installed()
        prepare_folder(arguments.tensorboard)
    _check_executor(arguments)


def _check_executor(arguments: argparse.Namespace) -> None:
    from rise_agents.agent import nearest

    if arguments.executor not in EXECUTORS:
        raise ValueError(f"unknown executor {arguments.executor!r}: {nearest(arguments.executor, EXECUTORS)}")
    if arguments.executor == "local":
        if arguments.ray_address is not None:
            raise ValueError("--ray-address is for --executor ray: add that, or leave the address out")
        return
    if getattr(arguments, "device", "cpu") != "cpu":
        raise ValueError("--executor ray gives each job a CPU: leave out --device")
    if importlib.util.find_spec("ray") is None:
        raise ValueError("--executor ray needs one more package: pip install 'rise-suite[ray]'")
    arguments.ray_address = _checked(arguments.ray_address)


def _checked(address: str | None) -> str:
    """An address at which a cluster answers, or ``local``: one is started. Ray itself would try for minutes.

    Raises:
        ValueError: nobody answers where a cluster is said to be.
    """
    source = "--ray-address"
    if address in (None, "auto") and os.environ.get("RAY_ADDRESS"):
        source, address = "RAY_ADDRESS", os.environ["RAY_ADDRESS"]
    if address == "local":
        return address
    if address not in (None, "auto"):
        _check_answers(source, address)
        return address
    started = Path(os.environ.get("RAY_TMPDIR") or tempfile.gettempdir(), "ray", "ray_current_cluster")
    try:
        _check_answers(str(started), started.read_text().strip())
    except (OSError, ValueError):  # none was started on this machine, or it has ended
        if address == "auto":
            raise ValueError(f"{source} auto: this machine is part of no Ray cluster") from None
        return "local"
    return "auto"


def _check_answers(source: str, address: str) -> None:
    """Raise ``ValueError`` unless somebody listens at an address; ``source`` is who gave it."""
    host, _, port = address.rpartition(":")
    if not (host and "/" not in host and port.isascii() and port.isdecimal() and int(port) < 1 << 16):
        raise ValueError(f"{source} takes HOST:PORT, auto or local, got {address[:80]!r}")
    try:
        socket.create_connection((host.strip("[]"), int(port)), _PATIENCE).close()
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ValueError(f"{source} {address}: no answer from there: {reason}") from None


@contextmanager
def pool_of(arguments: argparse.Namespace, out: Path) -> Iterator[Callable[..., Any]]:
    """What makes the pool that was asked for, of a number of workers and a listener; ``out`` is the run folder.

    Raises:
        ValueError: the cluster cannot be used.
    """
    if arguments.executor == "local":
        from rise_agents.pool import Pool

        yield Pool
        return
    ray = _connected(arguments.ray_address)
    try:
        from benchmarks.ray_pool import RayPool

        nodes = sum(node["Alive"] for node in ray.nodes())
        cpus = ray.cluster_resources().get("CPU", 0)
        print(f"Ray: {nodes} node{'s' if nodes > 1 else ''}, {cpus:g} CPUs", file=sys.stderr)
        folders = [folder for folder in (out, arguments.tensorboard) if folder is not None]
        yield partial(RayPool, ray, folders)
    finally:
        ray.shutdown()


def _connected(address: str) -> Any:
    """The module ``ray``, connected; its messages are for who looks for its defects."""
    limit_threads()
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # a run tells nobody of itself
    import ray
    import ray.util.scheduling_strategies  # which its users find there

    try:
        ray.init(
            address=address,
            include_dashboard=False,
            logging_level=logging.ERROR,
            log_to_driver=False,
            runtime_env={"env_vars": {name: os.environ[name] for name in THREADS}},
        )
    except (OSError, RuntimeError, ValueError, AssertionError) as error:
        lines = (str(error).strip() or type(error).__name__).splitlines()
        hint = "" if "RAY_AUTH_MODE" in os.environ else "; if it asks for a token, set RAY_AUTH_MODE=token"
        raise ValueError(f"--executor ray: cannot use the cluster at {address}: {lines[0]}{hint}") from None
    return ray
