"""Files that appear whole or not at all, and stay.

Whoever is killed while writing leaves the old file and, beside it, a temporary one that :func:`sweep` removes. A
temporary file is locked by its writer, and the system drops a lock with the process that held it: a sweep
never takes away what another process is still writing.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from filelock import FileLock, Timeout

try:
    import fcntl
except ImportError:  # no POSIX system: temporary files are neither locked nor swept
    fcntl = None  # type: ignore[assignment]

StrPath = str | os.PathLike[str]
TEMPORARY = ".partial-"  # what the names of temporary files begin with
_NAMES = re.compile(re.escape(TEMPORARY) + r"[0-9a-f]{16}-([0-9a-f]{8}.*)")


@contextmanager
def replacing(path: StrPath) -> Iterator[Path]:
    """A temporary path to write to, which becomes ``path`` at the end of the block, durably.

    Readers find the old file or the new one, never a part, whatever happens to this process or the machine.
    The temporary name ends like ``path``, for writers that choose a format by it.

    Raises:
        OSError: the file cannot be written (no space, no permission); an earlier one is intact.
    """
    path = Path(os.path.realpath(path))  # what a link leads to, not the link
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _open_locked(path) as lock:
            temporary = Path(lock.name)
            try:
                yield temporary
                with temporary.open("rb+") as file:
                    os.fsync(file.fileno())
                temporary.replace(path)
            except BaseException:
                temporary.unlink(missing_ok=True)
                raise
        _sync_folder(path.parent)
    except OSError as error:  # of the name that the caller knows
        raise OSError(error.errno, error.strerror or str(error), str(path)) from None


def replace_file(path: StrPath, content: bytes) -> Path:
    """Write ``content`` to ``path``, see :func:`replacing`; returns the path."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)
    return Path(path)


def temporary_name(path: Path) -> Path:
    """A new name beside ``path`` for what :func:`sweep` may remove unless it is locked."""
    return path.with_name(f"{TEMPORARY}{secrets.token_hex(8)}-{_ending(path.name)}")


def sweep(folder: StrPath, name: str | None = None) -> None:
    """Remove what writers that were killed left in ``folder`` (of the file ``name``; by default of all)."""
    if fcntl is None:
        return
    own = None if name is None else _ending(name)
    for stray in Path(folder).glob(f"{TEMPORARY}*"):
        match = _NAMES.fullmatch(stray.name)
        if match is None or own not in (None, match[1]):
            continue
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
        file = temporary_name(path).open("xb")
        if fcntl is None:
            return file
        with suppress(OSError):  # where files cannot be locked, nothing is swept either
            fcntl.flock(file, fcntl.LOCK_EX)
        if Path(file.name).exists():
            return file
        file.close()  # a sweep took it for a stray between these lines


def _ending(name: str) -> str:
    """What the temporary files of ``name`` end with: short, and of the same kind."""
    return hashlib.sha256(name.encode(errors="surrogateescape")).hexdigest()[:8] + Path(name).suffix


def _sync_folder(folder: Path) -> None:
    """Make the new name durable too, where the system lets us."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
