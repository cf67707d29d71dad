"""Files that appear whole or not at all, and stay.

Whoever is killed while writing leaves the old file and, beside it, a temporary one that :func:`sweep` removes. A
temporary file is locked by its writer, and the system drops a lock with the process that held it: a sweep
never takes away what another process is still writing.
"""

from __future__ import annotations

import glob
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from filelock import FileLock, Timeout

try:
    import fcntl
except ImportError:  # no POSIX system: temporary files are neither locked nor swept
    fcntl = None  # type: ignore[assignment]

StrPath = str | os.PathLike[str]
_MARK = ".partial-"


@contextmanager
def replacing(path: StrPath) -> Iterator[Path]:
    """A temporary path to write to, which becomes ``path`` at the end of the block, durably.

    Readers find the old file or the new one, never a part, whatever happens to this process or the machine.
    The temporary name ends like ``path``, for writers that choose a format by it.

    Raises:
        OSError: the file cannot be written (no space, no permission); an earlier one is intact.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = _open_locked(path)
    temporary = Path(lock.name)
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
        _sync_folder(path.parent)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno:  # of the name that the caller knows
            raise OSError(error.errno, os.strerror(error.errno), str(path)) from None
        raise
    finally:
        lock.close()


def replace_file(path: StrPath, content: bytes) -> None:
    """Write ``content`` to ``path``, see :func:`replacing`."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def sweep(folder: StrPath, name: str | None = None) -> None:
    """Remove what writers that were killed left in ``folder`` (of the file ``name``; by default of all)."""
    if fcntl is None:
        return
    for stray in Path(folder).glob(f"{_MARK}*" if name is None else f"{_MARK}*-{glob.escape(name)}"):
        try:
            with stray.open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                stray.unlink(missing_ok=True)
        except OSError:  # its writer is at work, or has just finished
            continue


@contextmanager
def sole_user(folder: StrPath) -> Iterator[None]:
    """Hold ``folder`` for this process alone; the hold ends with the block or with the process.

    Raises:
        ValueError: another process holds it.
    """
    lock = FileLock(Path(folder) / ".lock")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise ValueError(
            f"{folder} is in use by another process: wait for it, or name another folder"
        ) from None
    try:
        yield
    finally:
        lock.release()


def _open_locked(path: Path) -> IO[bytes]:
    # Not tempfile: its files are private to the user, and results are there to be shared.
    while True:
        file = path.with_name(f"{_MARK}{secrets.token_hex(8)}-{path.name}").open("xb")
        if fcntl is None:
            return file
        fcntl.flock(file, fcntl.LOCK_EX)
        if Path(file.name).exists():
            return file
        file.close()  # a sweep took it for a stray between these lines


def _sync_folder(folder: Path) -> None:
    """Make the new name durable too."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:  # where folders cannot be opened, names are kept without asking
        return
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
