"""Files of settings: TOML with a table for each ``agent@environment``, and comments that say where they come from."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

_HEADER = re.compile(r"^\[", re.MULTILINE)


def table(name: str, settings: Mapping[str, Any], comments: Sequence[str]) -> str:
    """One table as text, its comments before it."""
    lines = [f"# {line}" for line in comments] + [f"[{json.dumps(name)}]"]
    return "\n".join(lines + [f"{field} = {_value(value)}" for field, value in settings.items()]) + "\n"


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    return repr(value)


def read(path: Path) -> dict[str, dict[str, Any]]:
    """The tables of a file; none if there is no file.

    Raises:
        ValueError: it cannot be read as TOML tables.
    """
    try:
        found = tomllib.loads(path.read_text()) if path.exists() else {}
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be read as TOML: {error}") from None
    for name, value in found.items():
        if not isinstance(value, dict):
            raise ValueError(f"{path}: {name!r} stands outside of a table")
    return found


def merged(text: str, tables: Mapping[str, str]) -> str:
    """``text`` with ``tables`` (by name) in it: in place of those of the same name, or at the end.

    The other tables keep their place, their words and their comments.

    Raises:
        ValueError: the text is written in a way that this cannot keep.
    """
    expected = {**tomllib.loads(text), **{name: tomllib.loads(own)[name] for name, own in tables.items()}}
    parts = _parts(text)
    try:
        names = [next(iter(tomllib.loads(part)), "") for part in parts]
        kept = [tables.get(name, part) for name, part in zip(names, parts, strict=True)]
        kept += [own for name, own in tables.items() if name not in names]
        result = "\n".join(part.strip("\n") + "\n" for part in kept if part.strip())
        fits = tomllib.loads(result) == expected
    except tomllib.TOMLDecodeError:
        fits = False
    if not fits:
        raise ValueError("its tables cannot be told apart: write it plainly, one [table] after the other")
    return result


def _parts(text: str) -> list[str]:
    """The text cut before each table, or before the comments that lead to it."""
    lines = text.splitlines(keepends=True)
    cuts = [0]
    for number, line in enumerate(lines):
        if _HEADER.match(line):
            start = number
            while start > 0 and lines[start - 1].startswith("#"):
                start -= 1
            cuts.append(start)
    cuts = sorted({*cuts, len(lines)})
    return ["".join(lines[start:stop]) for start, stop in pairwise(cuts)]
