"""What the command lines share."""

from __future__ import annotations

import argparse
from typing import Any, NoReturn


class Parser(argparse.ArgumentParser):
    """An argument parser that raises ``ValueError`` with one line instead of printing usage and exiting.

    Its ``epilog`` (the examples) keeps its line breaks, and options must be spelled out.
    """

    def __init__(self, **kwargs: Any) -> None:
        kwargs = {"formatter_class": argparse.RawDescriptionHelpFormatter, "allow_abbrev": False, **kwargs}
        super().__init__(**kwargs)

    def error(self, message: str) -> NoReturn:
        """Raise ``ValueError``."""
        raise ValueError(message)
