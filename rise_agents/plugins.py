"""Modules of users that register environments, agents, experts, filters and noise models: ``--import``.

What is imported here is imported in the worker processes, too, before they do anything (:mod:`rise_agents.pool`).
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
import traceback
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType

_IMPORTED: dict[str, ModuleType] = {}


def imported() -> tuple[str, ...]:
    """What :func:`import_modules` was given in this process, files by their full paths."""
    return tuple(_IMPORTED)


def import_modules(names: Iterable[str]) -> None:
    """Import modules here, and in all worker processes that are started from here on.

    Args:
        names: of modules, or paths of Python files, whose folders become places to import from.

    Raises:
        ValueError: there is no such module or file, or it fails; the message says where.
    """
    for name in names:
        key = _full_path(name) if name.endswith(".py") else name
        if key not in _IMPORTED:
            _IMPORTED[key] = _of_file(Path(key)) if name.endswith(".py") else _of_name(name)


def _full_path(name: str) -> str:
    try:
        path = Path(name).resolve()
        there = path.is_file()
    except (OSError, ValueError):  # of a path that no system takes
        there = False
    if not there:
        raise ValueError(f"--import: there is no file {name!r}")
    return str(path)


def _of_file(path: Path) -> ModuleType:
    """The module that a file is, called by its name: so that other processes, and ``"module:Class"``, find it."""
    name = path.stem
    if not name.isidentifier():
        raise ValueError(
            f"--import {path}: a module's name has letters, digits and '_' only: rename the file"
        )
    _add_folder(path.parent)
    known = sys.modules.get(name)
    spec = known.__spec__ if known is not None else importlib.util.find_spec(name)
    found = None if spec is None or spec.origin is None else Path(spec.origin).resolve()
    if found != path:
        raise ValueError(f"--import {path}: {name!r} is another module already ({found}): rename the file")
    return _import(name, str(path))


def _of_name(name: str) -> ModuleType:
    if not all(part.isidentifier() for part in name.split(".")):
        raise ValueError(f"--import takes names of modules and paths of .py files, got {name[:200]!r}")
    _add_folder(Path.cwd())
    module = _import(name, name)
    if getattr(module, "__file__", None) is None and hasattr(module, "__path__"):
        raise ValueError(
            f"--import {name}: {next(iter(module.__path__))} is a folder without __init__.py: name a module in it"
        )
    return module


def _add_folder(folder: Path) -> None:
    """Last, so that what is installed goes before."""
    if str(folder) not in sys.path:
        sys.path.append(str(folder))


def _import(name: str, told: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except (Exception, SystemExit) as error:
        if isinstance(error, ModuleNotFoundError) and error.name == name.partition(".")[0]:
            raise ValueError(
                f"--import {told[:200]}: there is no such module here; a file needs its .py"
            ) from None
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        steps = [
            step for step in traceback.extract_tb(error.__traceback__) if "importlib" not in step.filename
        ]
        own = [step for step in steps if step.filename != __file__]
        place = f" ({own[0].filename}, line {own[0].lineno})" if own else ""
        raise ValueError(f"--import {told}: {type(error).__name__}: {reason}{place}") from None
