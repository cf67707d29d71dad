"""What the command lines share."""

from __future__ import annotations

import argparse
import errno
import os
import secrets
import select
import stat
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Any, NoReturn

from rise_agents.agent import nearest
from rise_agents.files import replace_file
from rise_agents.plugins import import_modules

try:
    import resource
except ImportError:  # no POSIX system
    resource = None  # type: ignore[assignment]


class Parser(argparse.ArgumentParser):
    """An argument parser that raises ``ValueError`` with one line instead of printing usage and exiting.

    Its ``epilog`` (the examples) keeps its line breaks, and options must be spelled out.

    Args:
        plugins: whether there is an option ``--import``, whose modules are imported as soon as arguments are parsed:
            everything that looks names up afterwards knows what they register.
        **kwargs: as in argparse.
    """

    def __init__(self, plugins: bool = False, **kwargs: Any) -> None:
        kwargs = {"formatter_class": argparse.RawDescriptionHelpFormatter, "allow_abbrev": False, **kwargs}
        super().__init__(**kwargs)
        if plugins:
            self.add_argument(
                "--import",
                nargs="+",
                action="extend",
                default=[],
                metavar="MODULE",
                dest="modules",
                help="modules or .py files of your own, which register environments, agents, experts, filters or"
                " noise models",
            )

    def parse_args(self, *args: Any, **kwargs: Any) -> Any:
        """As in argparse, but an unknown option is answered with the nearest known one; imports what is to be."""
        namespace, unknown = self.parse_known_args(*args, **kwargs)
        if unknown:
            options = [option for action in self._actions for option in action.option_strings]
            raise ValueError(f"unknown argument {unknown[0]!r}: {nearest(unknown[0], options)}")
        import_modules(getattr(namespace, "modules", ()))
        return namespace

    def error(self, message: str) -> NoReturn:
        """Raise ``ValueError``."""
        raise ValueError(message)


def prepare_folder(out: Path) -> None:
    """Make a folder; raises ``ValueError`` if nothing can be written there."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        replace_file(out / f"writable-{secrets.token_hex(4)}", b"").unlink()
    except OSError as error:
        raise ValueError(f"cannot write to the folder {str(out)!r}: {error.strerror}") from None


def prepare_file(path: Path) -> None:
    """Make the folder of a file that is to be written; raises ``ValueError`` if it could not be written."""
    prepare_folder(path.parent)
    try:
        folder = stat.S_ISDIR(path.stat().st_mode)
    except FileNotFoundError:
        return
    except (OSError, ValueError) as error:  # a name that no file can have
        raise ValueError(f"cannot write {str(path)[:200]!r}: {getattr(error, 'strerror', error)}") from None
    if folder:
        raise ValueError(f"cannot write {str(path)!r}: it is a folder")


def one_line(error: Exception) -> str:
    """What an error says, its line breaks shown as a string shows them: names of files may have some.

    Of too many open files also how many are allowed.
    """
    line = "\\n".join(str(error).splitlines())
    if resource is not None and isinstance(error, OSError) and error.errno == errno.EMFILE:
        most = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        line += f"; a process may have {most} here: allow more (ulimit -n 4096), or use fewer workers"
    return line


def nobody_listens() -> bool:
    """Whether who reads the output has gone (``… | head``); the rest then goes nowhere, without a word."""
    output = sys.stdout.fileno()
    pipe = select.poll()
    pipe.register(output, 0)  # for what is told unasked: that the other end is closed
    gone = bool(pipe.poll(0))
    if gone:
        os.dup2(os.open(os.devnull, os.O_WRONLY), output)
    return gone


KEPT = "what is finished is kept, run the command again to go on"
INTERRUPTED = f"interrupted; {KEPT}"

Main = Callable[[Sequence[str] | None], int]
Errors = tuple[type[Exception], ...]


class WorkFailed(Exception):
    """The arguments were good, and the work failed all the same."""


@contextmanager
def at_work(*errors: type[Exception]) -> Iterator[None]:
    """From here on it is not the arguments that are wrong: ``ValueError`` and ``errors`` become :class:`WorkFailed`."""
    kinds: Errors = (ValueError, *errors)
    try:
        yield
    except kinds as error:
        raise WorkFailed(str(error)) from error


def command(
    name: str, bad_input: Errors = (), failed: Errors = (), interrupted: str = "interrupted"
) -> Callable[[Main], Callable[..., int]]:
    """A decorator of ``main``: what a user can cause ends in one line that begins with ``name``, and an exit code.

    Args:
        name: of the command.
        bad_input: what else than ``ValueError`` is answered with 2.
        failed: what else than ``OSError`` and :class:`WorkFailed` is answered with 1.
        interrupted: what an interruption is answered with, beside 130.
    """
    broken: Errors = (OSError, WorkFailed, *failed)
    bad: Errors = (ValueError, *bad_input)
    codes: dict[type, int] = {**dict.fromkeys(broken, 1), **dict.fromkeys(bad, 2)}
    kinds = (*bad, *broken)

    def decorate(main: Main) -> Callable[..., int]:
        @wraps(main)
        def ending(argv: Sequence[str] | None = None) -> int:
            try:
                code = main(argv)
                sys.stdout.flush()
                return code
            except KeyboardInterrupt:
                print(f"\n{name}: {interrupted}", file=sys.stderr)
                return 130
            except kinds as error:
                if isinstance(error, BrokenPipeError) and nobody_listens():
                    return 1
                print(f"{name}: {one_line(error)}", file=sys.stderr)
                if isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG:
                    return 2  # such a name can only have been given
                return next(codes[kind] for kind in type(error).__mro__ if kind in codes)

        return ending

    return decorate
