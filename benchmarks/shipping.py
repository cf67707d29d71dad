"""A job on a machine that does not see the run folder: its files go there, and what it makes comes back.

Every path of such a job leads into a folder of its own there, so that its code knows nothing of all this.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from glob import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.jobs import Job
from rise_agents.files import TEMPORARY

Content = NDArray[np.uint8]  # of a file
Stamp = tuple[int, int, int]
_FOLDER = "rise-job-"  # then the number of its process


def full(path: Path) -> Path:
    """A path from the root on; a link at its end stays one."""
    return path.resolve() if path.name in ("", "..") else path.parent.resolve() / path.name


def _rewritten(value: Any, how: Callable[[Path], Path]) -> Any:
    """``value`` with every path in it replaced."""
    if isinstance(value, Path):
        return how(value)
    if isinstance(value, dict):
        return {key: _rewritten(each, how) for key, each in value.items()}
    return type(value)(_rewritten(each, how) for each in value) if type(value) in (list, tuple) else value


def rewritten(job: Job, how: Callable[[Path], Path]) -> Job:
    """A job with every path of it replaced."""
    output, needs, arguments = _rewritten((job.output, job.needs, job.arguments), how)
    return replace(job, output=output, needs=needs, arguments=arguments)


def inputs(job: Job) -> dict[Path, int]:
    """Files that a job may read, with their sizes in bytes.

    They are those that it names, all in the folders that it names, and those beside them that differ in the
    extension only: the record of a training, the state of one that was interrupted.
    """
    named: dict[Path, None] = {}

    def note(path: Path) -> Path:
        named[full(path)] = None
        return path

    rewritten(job, note)
    found = {}
    for path in named:
        for file in path.iterdir() if path.is_dir() else path.parent.glob(f"{escape(path.stem)}*"):
            if (
                (file.stem == path.stem or path.is_dir())
                and file.is_file()
                and not file.name.startswith(TEMPORARY)
            ):
                found[file] = file.stat().st_size
    return found


def all_here(files: Mapping[Path, int]) -> bool:
    """Whether this machine sees these files, of these sizes."""
    for folder in {path.parent for path in files}:
        with suppress(OSError):
            next(folder.iterdir(), None)  # network file systems look anew
    try:
        return all(path.stat().st_size == size for path, size in files.items())
    except OSError:
        return False


class Scratch:
    """A folder for one job, in which everything lies as it does on the machine that sent it. A context manager."""

    def __init__(self, files: Mapping[Path, Content]) -> None:
        _sweep()
        self.root = Path(tempfile.mkdtemp(prefix=f"{_FOLDER}{os.getpid()}-"))
        self._there = set(files)  # what the other machine has
        for path, content in files.items():
            self.place(path).parent.mkdir(parents=True, exist_ok=True)
            content.tofile(self.place(path))
        self._sent = self._stamps()

    def __enter__(self) -> Scratch:
        return self

    def __exit__(self, *exception: object) -> None:
        shutil.rmtree(self.root, ignore_errors=True)

    def place(self, path: Path) -> Path:
        """Where the file or folder ``path`` lies here."""
        path = full(path)
        return self.root / path.relative_to(path.anchor)

    def news(self) -> dict[Path, Content]:
        """Files that are new, or have changed since they were last asked for, by their paths there."""
        now = self._stamps()
        changed = [path for path, stamp in now.items() if self._sent.get(path) != stamp]
        self._sent = now
        self._there.update(changed)
        return {path: np.fromfile(self.place(path), np.uint8) for path in changed}

    def gone(self) -> list[Path]:
        """Files that came from there or were sent there, and that the job has removed since."""
        return sorted(path for path in self._there if not self.place(path).exists())

    def _stamps(self) -> dict[Path, Stamp]:
        found = {}
        for file in self.root.rglob("*"):
            if file.is_file() and not file.name.startswith(TEMPORARY):
                stat = file.stat()
                found[Path("/") / file.relative_to(self.root)] = stat.st_ino, stat.st_mtime_ns, stat.st_size
        return found


def _sweep() -> None:
    """Remove the folders of processes that were killed."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_FOLDER}*"):
        number = folder.name.removeprefix(_FOLDER).partition("-")[0]
        try:
            os.kill(int(number), 0)
        except ProcessLookupError:
            shutil.rmtree(folder, ignore_errors=True)
        except (OSError, ValueError):  # it is another user's
            continue
