"""Processes that are started to be killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

PATIENCE = 5.0  # s after which a process that should have gone is an orphan


def start(command: Sequence[str], log: Path | None = None) -> subprocess.Popen[bytes]:
    """Start a Python command line in a session of its own."""
    if log is None:
        return subprocess.Popen(  # noqa: S603
            [sys.executable, *command],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
    with log.open("ab") as sink:
        return subprocess.Popen(  # noqa: S603
            [sys.executable, *command], stdout=sink, stderr=sink, start_new_session=True
        )


def members(session: int) -> list[int]:
    """The living processes of a session, in the order of their numbers."""
    found = []
    for place in Path("/proc").iterdir():
        if not place.name.isdigit():
            continue
        try:
            state, _, _, own = (place / "stat").read_text().rpartition(")")[2].split()[:4]
        except OSError:  # it has just ended
            continue
        if int(own) == session and state not in "ZX":
            found.append(int(place.name))
    return sorted(found)


def children(parent: int) -> list[int]:
    """The living processes that ``parent`` has started itself."""
    found = []
    for place in Path(f"/proc/{parent}/task").glob("*/children"):
        try:
            found += [int(number) for number in place.read_text().split()]
        except OSError:
            continue
    return sorted(found)


def kill(pid: int) -> bool:
    """SIGKILL one process; whether it was there."""
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return False
    return True


def orphans(session: int, patience: float = PATIENCE) -> list[int]:
    """Who is left of a session whose leader is gone, after some patience."""
    until = time.monotonic() + patience
    while (left := members(session)) and time.monotonic() < until:
        time.sleep(0.05)
    return left


def end(session: int) -> None:
    """SIGKILL whatever is left of a session."""
    for pid in members(session):
        kill(pid)
