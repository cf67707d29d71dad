"""Compiling what is written with :mod:`rise_envs.arithmetic`, with numba.

The functions that branch on arrays there get their meaning for single numbers here; those built on them are
compiled as they stand. Nothing here lets the compiler reassociate or fuse operations: compiled and array results
have the same bits. Loops over a fixed number of lanes become vector instructions, for which every function must
be part of the loop's body (``forceinline``).
"""

from __future__ import annotations

import hashlib
import inspect
import math
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
from numba import njit
from numba.extending import overload, register_jitable

from rise_envs import arithmetic, obstacles, vehicle_dynamics

_SOURCES = (arithmetic, obstacles, vehicle_dynamics)
_ERRORS = {"error_model": "numpy"}  # a division by zero is infinite, not an exception
_OPTIONS = {**_ERRORS, "forceinline": True}


@overload(arithmetic.where, jit_options=_OPTIONS)
def _where(condition, yes, no):  # type: ignore[no-untyped-def]
    return lambda condition, yes, no: yes if condition else no


@overload(arithmetic.sqrt, jit_options=_OPTIONS)
def _sqrt(x):  # type: ignore[no-untyped-def]
    return lambda x: math.sqrt(x)


@overload(arithmetic.floor, jit_options=_OPTIONS)
def _floor(x):  # type: ignore[no-untyped-def]
    return lambda x: np.floor(x)


@overload(arithmetic.to_float, jit_options=_OPTIONS)
def _to_float(whole):  # type: ignore[no-untyped-def]
    return lambda whole: whole * 1.0  # float() takes no bool here


def _register(module: ModuleType) -> None:
    """Let compiled code call the functions of ``module``."""
    primitive = {"where", "sqrt", "floor", "to_float"} if module is arithmetic else set()
    for name, function in inspect.getmembers(module, inspect.isfunction):
        if function.__module__ == module.__name__ and name not in primitive:
            register_jitable(**_OPTIONS)(function)


for _module in _SOURCES:
    _register(_module)
_DIGEST = hashlib.sha256("".join(map(inspect.getsource, _SOURCES)).encode()).hexdigest()[:12]


def compiled(function: Callable) -> Any:
    """``function``, compiled on its first call and kept on disk."""
    # numba's cache watches the function's own file only; its name makes it watch what it is built on too.
    function.__qualname__ += f"_{_DIGEST}"
    return njit(cache=True, **_ERRORS)(function)
