"""What the command lines share."""

from __future__ import annotations

import argparse
import secrets
from pathlib import Path
from typing import Any, NoReturn

from rise_agents.agent import nearest
from rise_agents.files import replace_file
from rise_agents.plugins import import_modules


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
