"""The arithmetic that rounds the same everywhere: right, and equal in NumPy, torch and compiled code."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import torch
from numba import njit

from rise_envs import arithmetic, compiled, streams
from rise_envs.vehicle_dynamics import packed, unpacked
from rise_envs.vehicle_world import Params

RNG = np.random.default_rng(0)
ANGLES = np.concatenate(
    (RNG.uniform(-10, 10, 20_000), RNG.uniform(-1e5, 1e5, 20_000), np.arange(-8, 9) * np.pi / 4)
)
TURNS = np.concatenate((RNG.uniform(-1, 1, 20_000), 10.0 ** RNG.uniform(-300, 0, 1_000), [0.0, 1.0, -1.0]))
KEYS = RNG.integers(-(2**63), 2**63, 20_000)


def in_ulps(value: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The error in units in the last place; near a zero, in those of 1e-3."""
    return np.abs(value - truth) / np.spacing(np.maximum(np.abs(truth), 1e-3))


def test_sine_and_cosine_are_numpys_within_two_units() -> None:
    sin, cos = arithmetic.sincos(ANGLES)
    assert in_ulps(sin, np.sin(ANGLES)).max() <= 2
    assert in_ulps(cos, np.cos(ANGLES)).max() <= 2


def test_arcs_are_the_closed_form() -> None:
    """sin(α)/α and (1 − cos α)/α, the latter as 2 sin²(α/2)/α, which loses no digits."""
    ahead, aside = arithmetic.arc(TURNS)
    tiny = np.abs(TURNS) < 1e-9
    turn = np.where(tiny, 1.0, TURNS)
    assert in_ulps(ahead, np.where(tiny, 1.0, np.sin(turn) / turn)).max() <= 2
    truth = np.where(tiny, TURNS / 2, 2 * np.sin(turn / 2) ** 2 / turn)
    np.testing.assert_allclose(aside, truth, rtol=1e-15)


def test_angles_are_wrapped() -> None:
    wrapped = arithmetic.wrap_angle(ANGLES)
    assert np.abs(wrapped).max() <= np.pi
    turns = (ANGLES - wrapped) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.rint(turns), rtol=0, atol=1e-10)
    inside = np.linspace(-3.14, 3.14, 101)
    np.testing.assert_array_equal(arithmetic.wrap_angle(inside), inside)


def test_signed_draws_are_the_unsigned_ones() -> None:
    unsigned, counter = KEYS.view(np.uint64), np.arange(len(KEYS))
    np.testing.assert_array_equal(
        arithmetic.mix(KEYS, counter).view(np.uint64), streams.bits(unsigned, counter)
    )
    np.testing.assert_array_equal(arithmetic.split(KEYS, 7).view(np.uint64), streams.split(unsigned, 7))
    np.testing.assert_array_equal(arithmetic.uniform(KEYS, counter), streams.uniform(unsigned, counter))


def test_square_roots_are_correctly_rounded() -> None:
    """Against whole numbers: the square of the next half unit lies on the other side."""
    x = torch.from_numpy(RNG.uniform(0, 100, 3_000))
    for value, root in zip(x.tolist(), arithmetic.sqrt(x).tolist(), strict=True):
        half = Fraction(float(np.spacing(root))) / 2
        assert (Fraction(root) - half) ** 2 <= Fraction(value) <= (Fraction(root) + half) ** 2


CASES: dict[str, tuple[Callable[..., Any], tuple[np.ndarray, ...]]] = {
    "sincos": (arithmetic.sincos, (ANGLES,)),
    "wrap_angle": (arithmetic.wrap_angle, (ANGLES,)),
    "arc": (arithmetic.arc, (TURNS,)),
    "sqrt": (arithmetic.sqrt, (np.abs(ANGLES),)),
    "uniform": (arithmetic.uniform, (KEYS, np.arange(len(KEYS)))),
}


@pytest.mark.parametrize("name", CASES)
def test_numpy_torch_and_compiled_code_agree_to_the_last_bit(name: str) -> None:
    function, arguments = CASES[name]
    expected = np.array(function(*arguments))
    tensors = function(*map(torch.from_numpy, arguments))
    tensors = tensors if isinstance(tensors, tuple) else (tensors,)
    np.testing.assert_array_equal(np.array([t.numpy() for t in tensors]).squeeze(), expected)

    call = njit(**compiled._ERRORS)(lambda *numbers: function(*numbers))
    alone = [call(*numbers) for numbers in zip(*arguments, strict=True)]
    np.testing.assert_array_equal(np.array(alone).T, expected)


def test_constants_survive_packing() -> None:
    for sparse in (False, True):
        constants = Params(v_min=-0.5).constants(sparse)
        assert unpacked(packed(constants)) == constants
