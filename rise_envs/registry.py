"""How names get into registries: one way for environments, agents, experts, filters and noise models.

An entry is a class, or ``"module:Class"``, and is kept as that text: worker processes find the class by it. What cannot
be used is refused when it is registered, not in the middle of a run.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterable
from typing import Any

Entry = str | type

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


def find_class(entry: str) -> Any:
    """The class that ``"module:Class"`` names."""
    module, _, name = entry.partition(":")
    return getattr(importlib.import_module(module), name)


def checked_name(kind: str, name: Any, reserved: Iterable[str] = ()) -> str:
    """``name`` itself.

    Raises:
        ValueError: it is no text of letters, digits, ``.``, ``_``, ``-`` (it becomes part of the names of files, and of
            what is written on command lines), or its first word is ``reserved``.
    """
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ValueError(f"{kind} needs a name of letters, digits, '.', '_', '-', got {name!r}")
    if re.split("[-.]", name)[0] in reserved:
        raise ValueError(f"{kind} {name!r}: {', '.join(sorted(reserved))} mean something else already")
    return name


def checked_entry(kind: str, entry: Any, needs: Iterable[str] = ()) -> tuple[Any, str]:
    """The class of an entry, and ``"module:Class"``.

    Args:
        kind: what it is, for messages.
        entry: a class, or that text.
        needs: attributes that the class must have.

    Raises:
        ValueError: no class, one that other processes could not find, or one that lacks an attribute (all are named).
    """
    if isinstance(entry, type):
        text = f"{entry.__module__}:{entry.__qualname__}"
    elif isinstance(entry, str) and re.fullmatch(r"[\w.]+:\w+", entry):
        text = entry
    else:
        raise ValueError(f"{kind}: give a class or 'module:Class', got {entry!r}")
    try:
        found = find_class(text)
    except (ImportError, AttributeError) as error:
        why = "a class must stand at the top level of a module" if isinstance(entry, type) else error
        raise ValueError(f"{kind}: cannot find {text!r}: {why}") from None
    if not isinstance(found, type):
        raise ValueError(f"{kind}: {text!r} is no class")
    # An abstract method is there, and is not.
    abstract: frozenset[str] = getattr(found, "__abstractmethods__", frozenset())
    # Looked up in the class and its bases: every class can itself be called, whatever its instances can.
    there = {name for base in found.__mro__ for name in vars(base)} - abstract
    missing = [name for name in needs if name not in there]
    missing += sorted(abstract - set(missing))
    if missing:
        raise ValueError(f"{kind}: {text!r} lacks {', '.join(missing)}")
    return found, text


def check_new(kind: str, known: str | None, text: str) -> None:
    """Raise ``ValueError`` if a name is taken: ``known`` is its entry so far, ``text`` the new one.

    The same entry again is welcome: a module that is imported once more, a cell of a notebook that is run again.
    """
    if known not in (None, text):
        raise ValueError(f"{kind} is registered already, as {known!r}: choose another name")
