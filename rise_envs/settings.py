"""Checks of what somebody else chose: settings, numbers, names. Each says in one line what must be changed."""

from __future__ import annotations

import difflib
import functools
import math
import operator
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np

T = TypeVar("T")

MAX_WHOLE = 2**63 - 1  # what arrays can count


def nearest(name: str, known: Iterable[str]) -> str:
    """A hint for an error line: the closest known name, and all of them."""
    known = sorted(known)
    close = difflib.get_close_matches(str(name), known, n=1, cutoff=0.4)
    hint = f"did you mean {close[0]!r}? " if close else ""
    return f"{hint}known: {', '.join(known)}"


def whole(name: str, value: Any, low: int = -MAX_WHOLE, high: float = MAX_WHOLE) -> int:
    """``value`` as a plain int.

    Raises:
        ValueError: it is no whole number (a bool is none) in [low, high].
    """
    try:
        number = operator.index(value)
    except TypeError:
        number = None
    # What has dimensions is no number: torch counts a tensor of one element as one.
    if number is None or isinstance(value, bool | np.bool_) or np.ndim(value) or not low <= number <= high:
        bounds = f"≥ {low}" if high >= MAX_WHOLE and low > -MAX_WHOLE else f"in [{low}, {high}]"
        raise ValueError(f"{name} must be a whole number {bounds}, got {value!r}")
    return number


def finite(name: str, value: Any, low: float = -math.inf, high: float = math.inf) -> float:
    """``value`` as a plain float.

    Raises:
        ValueError: it is no finite number (a bool is none) in [low, high].
    """
    known = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    try:
        number = float(value) if known else math.nan
    except OverflowError:  # a whole number beyond the greatest float
        number = math.nan
    # A comparison with NaN is false, so that NaN is refused as well.
    if not low <= number <= high or math.isinf(number):
        bounds = f" in [{low:g}, {high:g}]" if high < math.inf else f" ≥ {low:g}" if low > -math.inf else ""
        raise ValueError(f"{name} must be a finite number{bounds}, got {value!r}")
    return number


def flag(name: str, value: Any) -> bool:
    """``value`` as a plain bool; raises ``ValueError`` if it is anything else: the text 'False' is true."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} must be True or False, got {value!r}")
    return bool(value)


def check_fields(kind: type, values: Mapping[str, Any]) -> dict[str, Any]:
    """Check settings against the annotations of their class: whole and finite numbers, texts, tuples of them.

    Args:
        kind: a dataclass or named tuple.
        values: by the names of its fields, all or some.

    Returns:
        The same settings, numbers as they are declared: 1 is 1.0 where a float is meant.

    Raises:
        ValueError: a field that does not exist (the nearest one is named), or a value of another kind.
    """
    known, where = _annotations(kind), f"{kind.__module__.rpartition('.')[2]}.{kind.__name__}"
    for name in values:
        if name not in known:
            raise ValueError(f"unknown setting {name!r} of {where}: {nearest(name, known)}")
    return {name: _checked(f"{where}.{name}", known[name], value) for name, value in values.items()}


@functools.cache
def _annotations(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _checked(name: str, kind: Any, value: Any) -> Any:
    if get_origin(kind) is tuple:
        return _checked_tuple(name, get_args(kind), value)
    if kind in _CHECKS:
        return _CHECKS[kind](name, value)
    if isinstance(kind, type) and not isinstance(value, kind):
        raise ValueError(f"{name} must be a {kind.__name__}, got {value!r}")
    return value


def _checked_tuple(name: str, kinds: tuple[Any, ...], value: Any) -> tuple[Any, ...]:
    if not isinstance(value, tuple):
        raise ValueError(f"{name} must be a tuple, got {value!r}")
    if kinds[-1] is Ellipsis:
        kinds = (kinds[0],) * len(value)
    if len(value) != len(kinds):
        raise ValueError(f"{name} must have {len(kinds)} entries, got {value!r}")
    return tuple(
        _checked(f"{name}[{i}]", kind, entry)
        for i, (kind, entry) in enumerate(zip(kinds, value, strict=True))
    )


_CHECKS: dict[Any, Any] = {int: whole, float: finite, bool: flag}


def as_settings(kind: type[T], given: T | Mapping[str, Any], name: str = "params") -> T:
    """``given`` itself, or a ``kind`` made of a mapping from names of fields to values (lists count as tuples).

    Raises:
        ValueError: neither of both, an unknown field (the nearest one is named), or a value that does not fit.
    """
    if isinstance(given, kind):
        return given
    if not isinstance(given, Mapping):
        raise ValueError(f"{name} must be a {kind.__name__} or a dict of its fields, got {given!r}")
    return kind(**check_fields(kind, plain(given)))


def plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """Settings without lists (tuples instead) and without NumPy's numbers, which JSON does not know."""

    def one(value: Any) -> Any:
        if isinstance(value, list | tuple):
            return type(value)(*map(one, value)) if hasattr(value, "_fields") else tuple(map(one, value))
        return value.item() if isinstance(value, np.generic) else value

    return {name: one(value) for name, value in values.items()}
