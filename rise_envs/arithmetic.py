"""Arithmetic that rounds the same everywhere: the ground that the environments' dynamics are written on.

Dynamics are written once, one number at a time, and run in three ways: on NumPy arrays, on torch tensors (on any
device), and compiled. IEEE 754 fixes every bit of + − × ÷ √, floor and comparison, but not of sin or log, which
differ between libraries and even between vector lanes. So the dynamics use these operations only, and the sine
comes from here: then all three ways agree to the last bit of float64.

Two traps: a power is not a product (write ``x * x``), and CUDA divides by a constant through its reciprocal
(multiply by one that was computed beforehand).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from array_api_compat import array_namespace, is_torch_array

Number = Any  # a number, or an array of them from NumPy or torch

TWO_PI = 6.283185307179586
_TWO_OVER_PI = 0.6366197723675814
_INVERSE_TWO_PI = 0.15915494309189535
# π/2 in three parts; the first two have 33 bits, so their products with small whole numbers are exact
# (Cody and Waite, "Software Manual for the Elementary Functions", 1980).
_HALF_PI = (1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21)


def where(condition: Number, yes: Number, no: Number) -> Number:
    """``yes`` where the condition holds, ``no`` elsewhere; at least one of both is an array."""
    return array_namespace(condition).where(condition, yes, no)


def sqrt(x: Number) -> Number:
    """Square root, correctly rounded."""
    xp = array_namespace(x)
    if is_torch_array(x) and x.device.type == "cpu" and not xp.compiler.is_compiling():
        # There torch takes MKL's root, whose last bit is wrong for one number in a hundred; NumPy's is right.
        return xp.from_numpy(np.sqrt(x.numpy()))
    return xp.sqrt(x)


def floor(x: Number) -> Number:
    """The greatest whole number that is not above ``x``, as a float."""
    return array_namespace(x).floor(x)


def to_float(whole: Number) -> Number:
    """Whole numbers of at most 53 bits as float64."""
    xp = array_namespace(whole)
    return xp.astype(whole, xp.float64)


def sincos(angle: Number) -> tuple[Number, Number]:
    """Sine and cosine of an angle (rad) of at most 10⁵, within two units in the last place."""
    turns = floor(angle * _TWO_OVER_PI + 0.5)
    r = ((angle - turns * _HALF_PI[0]) - turns * _HALF_PI[1]) - turns * _HALF_PI[2]
    t = r * r
    # Least-maximum polynomials on [−π/4, π/4], errors 2e-17 and 1e-18.
    sin = -2.505113165023518e-08 + t * 1.5918115263265974e-10
    sin = -1.984126983675677e-04 + t * (2.7557316101617874e-06 + t * sin)
    sin = r + r * (t * (-0.16666666666666666 + t * (8.333333333330948e-03 + t * sin)))
    cos = 2.087614614655861e-09 + t * -1.1382623647474604e-11
    cos = 2.480158729876456e-05 + t * (-2.7557317271145144e-07 + t * cos)
    cos = 1.0 - 0.5 * t + (t * t) * (0.041666666666666664 + t * (-1.3888888888887398e-03 + t * cos))
    quarter = turns - 4.0 * floor(turns * 0.25)
    odd = (quarter == 1.0) | (quarter == 3.0)
    sine, cosine = where(odd, cos, sin), where(odd, sin, cos)
    return (
        where(quarter >= 2.0, -sine, sine),
        where((quarter == 1.0) | (quarter == 2.0), -cosine, cosine),
    )


def wrap_angle(angle: Number) -> Number:
    """Angles (rad) brought into [−π, π]; π itself only by rounding."""
    return angle - TWO_PI * floor((angle + 0.5 * TWO_PI) * _INVERSE_TWO_PI)


def arc(turn: Number) -> tuple[Number, Number]:
    """How far a drive of unit length that turns by ``turn`` (|turn| ≤ 1 rad) gets, ahead and to the left.

    sin(α)/α and (1 − cos α)/α, by their power series, so that driving straight is no special case.
    """
    t = turn * turn
    ahead = -1.0 / 1307674368000.0 + t * (1.0 / 355687428096000.0)
    ahead = -1.0 / 39916800.0 + t * (1.0 / 6227020800.0 + t * ahead)
    ahead = -1.0 / 5040.0 + t * (1.0 / 362880.0 + t * ahead)
    ahead = 1.0 + t * (-1.0 / 6.0 + t * (1.0 / 120.0 + t * ahead))
    aside = -1.0 / 20922789888000.0 + t * (1.0 / 6402373705728000.0)
    aside = -1.0 / 479001600.0 + t * (1.0 / 87178291200.0 + t * aside)
    aside = -1.0 / 40320.0 + t * (1.0 / 3628800.0 + t * aside)
    aside = turn * (0.5 + t * (-1.0 / 24.0 + t * (1.0 / 720.0 + t * aside)))
    return ahead, aside


def mix(key: Number, counter: Number) -> Number:
    """:func:`rise_envs.streams.bits` on signed 64-bit integers, the only ones that every library multiplies.

    They wrap around alike; the masks make the arithmetic shifts logical ones.
    """
    counter = (key & 0) + counter  # a plain number would not wrap around
    x = key + (counter + 1) * -7046029254386353131
    x = (x ^ ((x >> 30) & 0x3FFFFFFFF)) * -4658895280553007687
    x = (x ^ ((x >> 27) & 0x1FFFFFFFFF)) * -7723592293110705685
    return x ^ ((x >> 31) & 0x1FFFFFFFF)


def uniform(key: Number, counter: Number) -> Number:
    """:func:`rise_envs.streams.uniform` on signed 64-bit integers: draws from U[0, 1), float64."""
    return to_float((mix(key, counter) >> 11) & 0x1FFFFFFFFFFFFF) * 1.1102230246251565e-16


def split(key: Number, tag: int) -> Number:
    """:func:`rise_envs.streams.split` on signed 64-bit integers: an independent key for a purpose."""
    return mix(mix(key, tag), 0x5EED)
