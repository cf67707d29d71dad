"""Kinematics and linear algebra of many Panda arms at once, one per vector lane, compiled with numba.

Arrays have L = ``LANES`` arms in their last axis and every innermost loop runs over it, so that the compiler can
step several arms with one instruction. It does so only if it knows the distance between two rows: `fixed` tells
it the shapes. Numbers are ``REAL``, single precision: twice as many fit into one instruction, and the arm's motion
is not known to a ten-thousandth of a millimetre anyway. Constants in compiled code must be of that type, too, or
numba goes on in double precision. All functions work in place. SI units, world frame; base, joints and frames as
in :mod:`rise_envs.panda_kinematics`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numba import carray, config, from_dtype, njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from rise_envs import panda_kinematics as panda

REAL = np.float32
Lanes = NDArray[np.float32]

LANES = 32
N = 7  # joints
ZERO, ONE, TWO = REAL(0.0), REAL(1.0), REAL(2.0)
HAND_POINT = REAL(0.107 + 0.105)  # m along z of frame 7
_ORIGIN, _TWIST = panda.ORIGIN.astype(REAL), panda.TWIST.astype(REAL)
_HALVINGS = 3
# Factors of the power series of cosine and sine.
_COS = np.array([1 / 2, 1 / 12, 1 / 30, 1 / 56], REAL)
_SIN = np.array([1 / 6, 1 / 20, 1 / 42, 1 / 72], REAL)


# Whoever adds a file of lanes adds it here: all are compiled anew when one of them changes.
_FILES = ("kinematics", "lanes", "ik", "dynamics", "bounds", "motors", "block", "clearance", "motion")
_SOURCES = "".join(Path(__file__).with_name(f"panda_{name}.py").read_text() for name in _FILES)
_DIGEST = hashlib.sha256(_SOURCES.encode()).hexdigest()[:12]


def lane(function: Callable) -> Any:
    """``function``, compiled where a compiled function calls it.

    It is not kept on disk by itself: what comes from there cannot be optimised together with its caller, and what is
    computed would depend, in the last bits, on what had been compiled before.
    """
    return njit(fastmath=True, forceinline=True)(function)


def entrance(function: Callable) -> Any:
    """``function``, compiled on its first call and kept on disk, together with all the lanes that it is built on."""
    # numba's cache watches the function's own file only; its name makes it watch the others, too.
    function.__qualname__ += f"_{_DIGEST}"
    try:
        return njit(cache=True, nogil=True, fastmath=True)(function)
    except RuntimeError:  # no folder to keep it in can be written to
        return njit(nogil=True, fastmath=True)(function)


@intrinsic
def _pointer(context: Any, address: Any) -> Any:
    """A number as the address of numbers."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

    return types.CPointer(from_dtype(np.dtype(REAL)))(types.intp), generate


@njit(inline="always")
def _fixed(array: Lanes, shape: tuple[int, ...]) -> Lanes:
    """The same contiguous array with a shape that the compiler knows; it must be the array's own."""
    return carray(_pointer(array.ctypes.data), shape)  # type: ignore[call-arg]


def _as_it_is(array: Lanes, shape: tuple[int, ...]) -> Lanes:
    """The same array."""
    return array


# Pointers are for compiled code only.
fixed = _as_it_is if config.DISABLE_JIT else _fixed  # type: ignore[attr-defined]


@lane
def copy(source: Lanes, target: Lanes) -> None:
    """Copy (7, L)."""
    source, target = fixed(source, (N, LANES)), fixed(target, (N, LANES))
    for i in range(N):
        for m in range(LANES):
            target[i, m] = source[i, m]


@lane
def clear(x: Lanes) -> None:
    """Make (7, L) zero."""
    x = fixed(x, (N, LANES))
    for i in range(N):
        for m in range(LANES):
            x[i, m] = ZERO


@lane
def turn(cos: Lanes, sin: Lanes, angle: Lanes) -> None:
    """Turn cosines and sines (7, L) by ``angle`` (7, L), at most 1 rad, in place: no call to a sine."""
    cos, sin, angle = fixed(cos, (N, LANES)), fixed(sin, (N, LANES)), fixed(angle, (N, LANES))
    for i in range(N):
        for m in range(LANES):
            d = angle[i, m]
            s = d * d
            c = ONE - s * _COS[0] * (ONE - s * _COS[1] * (ONE - s * _COS[2] * (ONE - s * _COS[3])))
            t = d * (ONE - s * _SIN[0] * (ONE - s * _SIN[1] * (ONE - s * _SIN[2] * (ONE - s * _SIN[3]))))
            x = cos[i, m]
            cos[i, m] = x * c - sin[i, m] * t
            sin[i, m] = sin[i, m] * c + x * t


@lane
def write_turns(angle: Lanes, cos: Lanes, sin: Lanes, part: Lanes) -> None:
    """Cosines and sines (7, L) of ``angle`` (7, L), at most 8 rad; ``part`` (7, L) is scratch."""
    cos, sin, angle = fixed(cos, (N, LANES)), fixed(sin, (N, LANES)), fixed(angle, (N, LANES))
    share = ONE / REAL(2**_HALVINGS)
    for i in range(N):
        for m in range(LANES):
            part[i, m] = angle[i, m] * share
            cos[i, m], sin[i, m] = ONE, ZERO
    turn(cos, sin, part)
    for _ in range(_HALVINGS):
        for i in range(N):
            for m in range(LANES):
                c, s = cos[i, m], sin[i, m]
                cos[i, m], sin[i, m] = ONE - TWO * s * s, TWO * s * c


@lane
def write_frames(cos: Lanes, sin: Lanes, axes: Lanes, origin: Lanes) -> None:
    """Frames 0 to 7: axes as columns (8, 3, 3, L) and origins (8, 3, L), of which frame 0 is given."""
    cos, sin = fixed(cos, (N, LANES)), fixed(sin, (N, LANES))
    axes, origin = fixed(axes, (N + 1, 3, 3, LANES)), fixed(origin, (N + 1, 3, LANES))
    for i in range(N):
        ox, oy, oz, twist = _ORIGIN[i, 0], _ORIGIN[i, 1], _ORIGIN[i, 2], _TWIST[i]
        straight, turned = ONE - twist * twist, twist
        for m in range(LANES):
            c, s = cos[i, m], sin[i, m]
            for r in range(3):
                x, y, z = axes[i, r, 0, m], axes[i, r, 1, m], axes[i, r, 2, m]
                origin[i + 1, r, m] = origin[i, r, m] + x * ox + y * oy + z * oz
                b = straight * y + turned * z
                axes[i + 1, r, 0, m] = x * c + b * s
                axes[i + 1, r, 1, m] = b * c - x * s
                axes[i + 1, r, 2, m] = straight * z - turned * y


@lane
def write_hand(axes: Lanes, origin: Lanes, hand: Lanes) -> None:
    """The hand point (3, L)."""
    axes, origin = fixed(axes, (N + 1, 3, 3, LANES)), fixed(origin, (N + 1, 3, LANES))
    hand = fixed(hand, (3, LANES))
    for r in range(3):
        for m in range(LANES):
            hand[r, m] = origin[N, r, m] + HAND_POINT * axes[N, r, 2, m]


@lane
def write_jacobian(axes: Lanes, origin: Lanes, hand: Lanes, jacobian: Lanes) -> None:
    """Geometric Jacobian of the hand point, (6, 7, L)."""
    axes, origin = fixed(axes, (N + 1, 3, 3, LANES)), fixed(origin, (N + 1, 3, LANES))
    hand, jacobian = fixed(hand, (3, LANES)), fixed(jacobian, (6, N, LANES))
    for i in range(N):
        for m in range(LANES):
            ax, ay, az = axes[i + 1, 0, 2, m], axes[i + 1, 1, 2, m], axes[i + 1, 2, 2, m]
            dx, dy = hand[0, m] - origin[i + 1, 0, m], hand[1, m] - origin[i + 1, 1, m]
            dz = hand[2, m] - origin[i + 1, 2, m]
            jacobian[0, i, m] = ay * dz - az * dy
            jacobian[1, i, m] = az * dx - ax * dz
            jacobian[2, i, m] = ax * dy - ay * dx
            jacobian[3, i, m], jacobian[4, i, m], jacobian[5, i, m] = ax, ay, az


@lane
def write_gram(jacobian: Lanes, damping: float, gram: Lanes) -> None:
    """The lower triangle of JJᵀ + damping·I, (6, 6, L)."""
    jacobian, gram = fixed(jacobian, (6, N, LANES)), fixed(gram, (6, 6, LANES))
    for i in range(6):
        for j in range(i + 1):
            start = REAL(damping) if i == j else ZERO
            for m in range(LANES):
                total = start
                for k in range(N):
                    total += jacobian[i, k, m] * jacobian[j, k, m]
                gram[i, j, m] = total


@lane
def factor(matrix: Lanes) -> None:
    """Cholesky factors of positive definite matrices (6, 6, L), lower triangles, their diagonals inverted."""
    matrix = fixed(matrix, (6, 6, LANES))
    for m in range(LANES):
        for j in range(6):
            matrix[j, j, m] = ONE / np.sqrt(matrix[j, j, m])
            for i in range(j + 1, 6):
                matrix[i, j, m] *= matrix[j, j, m]
                for k in range(j + 1, i + 1):
                    matrix[i, k, m] -= matrix[i, j, m] * matrix[k, j, m]


@lane
def solve(matrix: Lanes, x: Lanes) -> None:
    """Solve for six unknowns: ``x`` (6, L) becomes the solution, ``matrix`` (6, 6, L) is that of `factor`."""
    matrix, x = fixed(matrix, (6, 6, LANES)), fixed(x, (6, LANES))
    for m in range(LANES):
        for j in range(6):
            total = x[j, m]
            for i in range(j):
                total -= matrix[j, i, m] * x[i, m]
            x[j, m] = total * matrix[j, j, m]
        for j in range(5, -1, -1):
            total = x[j, m]
            for i in range(j + 1, 6):
                total -= matrix[i, j, m] * x[i, m]
            x[j, m] = total * matrix[j, j, m]


@lane
def _sweep(p: int, matrix: Lanes, row: Lanes) -> None:
    """Sweep pivot ``p`` out of the lower triangles of symmetric matrices (7, 7, L); ``row`` (7, L) is scratch."""
    lanes = row.shape[-1]
    matrix, row = fixed(matrix, (N, N, LANES)), fixed(row, (N, LANES))
    for i in range(N):
        a, b = max(i, p), min(i, p)
        for m in range(lanes):
            row[i, m] = matrix[a, b, m]
    for m in range(lanes):
        row[p, m] = ONE / row[p, m]
    for i in range(N):
        for j in range(i + 1):
            if i != p and j != p:
                for m in range(lanes):
                    matrix[i, j, m] -= row[i, m] * row[j, m] * row[p, m]
    for i in range(N):
        a, b = max(i, p), min(i, p)
        for m in range(lanes):
            matrix[a, b, m] = -row[p, m] if i == p else row[i, m] * row[p, m]


@lane
def invert(matrix: Lanes, row: Lanes) -> None:
    """The inverse of positive definite matrices (7, 7, L) given by their lower triangles.

    The sweep operator (Goodnight, "A tutorial on the SWEEP operator", The American Statistician 1979) keeps
    symmetric matrices symmetric and ends with the negative inverse. ``row`` (7, L) is scratch.
    """
    for p in range(len(row)):  # N, but if the compiler knew, it would write the sweep out seven times
        _sweep(p, matrix, row)
    lanes = row.shape[-1]
    matrix = fixed(matrix, (N, N, LANES))
    for i in range(N):
        for j in range(i + 1):
            for m in range(lanes):
                matrix[i, j, m] = -matrix[i, j, m]
                matrix[j, i, m] = matrix[i, j, m]
