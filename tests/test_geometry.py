"""Arcs and clearances against numerical integration and dense sampling."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from rise_envs import geometry

angles = st.floats(-20, 20)
coordinates = st.floats(-50, 50)
poses = st.tuples(coordinates, coordinates, angles)


@pytest.mark.parametrize(
    "action", [(2.5, 1.5), (2.5, -1.5), (1.0, 0.0), (0.0, 1.5), (2.0, 1e-9), (-1.0, 0.7)]
)
@pytest.mark.parametrize("duration", [0.0, 0.1, 3.0])
def test_unicycle_solves_its_differential_equation(action: tuple[float, float], duration: float) -> None:
    v, omega = action
    start = np.array([1.0, -2.0, 2.0])
    path = solve_ivp(
        lambda _, s: [v * np.cos(s[2]), v * np.sin(s[2]), omega], (0, duration), start, rtol=1e-12, atol=1e-12
    )
    x, y, theta = path.y[:, -1]
    reached = geometry.unicycle(start, np.array(action), duration)
    np.testing.assert_allclose(reached[:2], [x, y], atol=1e-9)
    assert np.cos(reached[2] - theta) == pytest.approx(1, abs=1e-12)


@given(st.floats(-1e-4, 1e-4), st.floats(0.01, 5))
def test_unicycle_is_smooth_through_straight_driving(omega: float, duration: float) -> None:
    """Around ω = 0 the arc's third-order series is the truth: no jump where the code changes branch."""
    x, y, _ = geometry.unicycle(np.zeros(3), np.array([1.0, omega]), duration)
    turn = omega * duration
    assert x == pytest.approx(duration * (1 - turn**2 / 6), abs=1e-12)
    assert y == pytest.approx(duration * (turn / 2 - turn**3 / 24), abs=1e-12)


@given(poses, st.floats(0, 2.5), st.floats(-1.5, 1.5), poses)
def test_unicycle_moves_with_the_frame(
    state: tuple[float, ...], v: float, omega: float, frame: tuple[float, ...]
) -> None:
    """Driving, then moving the world rigidly, is moving the world, then driving."""
    dx, dy, turn = frame
    cos, sin = np.cos(turn), np.sin(turn)

    def moved(s: np.ndarray) -> np.ndarray:
        return np.array([cos * s[0] - sin * s[1] + dx, sin * s[0] + cos * s[1] + dy, s[2] + turn])

    action = np.array([v, omega])
    a = moved(geometry.unicycle(np.array(state), action, 0.5))
    b = geometry.unicycle(moved(np.array(state)), action, 0.5)
    np.testing.assert_allclose(a[:2], b[:2], atol=1e-11)
    assert np.cos(a[2] - b[2]) == pytest.approx(1)


@given(st.floats(-1e3, 1e3))
def test_wrap_angle_keeps_the_direction(angle: float) -> None:
    wrapped = geometry.wrap_angle(np.array(angle))
    assert -np.pi <= wrapped <= np.pi
    assert np.cos(wrapped - angle) == pytest.approx(1)


def test_segment_distance_against_dense_sampling() -> None:
    rng = np.random.default_rng(0)
    for dim in (2, 3):
        start, end = rng.normal(size=(2, 300, dim))
        end[:20] = start[:20]  # segments of length zero
        share = np.linspace(0, 1, 5001)[:, None, None]
        sampled = np.linalg.norm(start + share * (end - start), axis=-1).min(0)
        np.testing.assert_allclose(geometry.segment_distance(start, end), sampled, atol=2e-3)
        assert (geometry.segment_distance(start, end) <= sampled + 1e-12).all()


def crossings(rng: np.random.Generator, n: int) -> tuple[np.ndarray, ...]:
    """Vehicles at the origin, half of them at full speed and turn, with three discs each, overlapping to near."""
    state = np.zeros((n, 3))
    state[:, 2] = rng.uniform(-np.pi, np.pi, n)
    action = rng.uniform([0, -1.5], [2.5, 1.5], (n, 2))
    action[: n // 2] = [2.5, 1.5]
    radius = rng.uniform(0.75, 2.0, (n, 3))
    away, course = rng.uniform(-np.pi, np.pi, (2, n, 3))
    distance = (radius + 0.5) * rng.uniform(0, 1.5, (n, 3))
    position = distance[..., None] * np.stack((np.cos(away), np.sin(away)), -1)
    speed = rng.uniform(0, 1, (n, 3))
    return state, action, position, speed[..., None] * np.stack((np.cos(course), np.sin(course)), -1), radius


def test_swept_clearance_against_dense_sampling() -> None:
    state, action, position, velocity, radius = crossings(np.random.default_rng(1), 1500)
    sampled = np.full(radius.shape, np.inf)
    for t in np.linspace(0, 0.1, 5000):
        vehicle = geometry.unicycle(state, action, t)[:, None, :2]
        sampled = np.minimum(sampled, np.linalg.norm(vehicle - position - t * velocity, axis=-1))
    sampled = sampled - radius - 0.5

    clearance = geometry.swept_clearance(state, action, position, velocity, radius, 0.1, 0.5)
    error = clearance - sampled
    assert error.min() > -1e-6  # never below the truth, but for the samples' spacing
    assert error.max() < 1e-3
    touching = np.abs(sampled) < 0.2
    assert touching.sum() > 500
    assert error[touching].max() < 1e-5


def test_swept_clearance_sees_what_both_ends_of_the_step_miss() -> None:
    """A fast small disc shoots past: 1.9 m away before and after, overlapping in between."""
    state, action = np.zeros((1, 3)), np.zeros((1, 2))
    position, velocity = np.array([[[-2.0, 0.3]]]), np.array([[[40.0, 0.0]]])
    clearance = geometry.swept_clearance(state, action, position, velocity, np.array([[0.1]]), 0.1, 0.5)
    assert clearance.item() == pytest.approx(0.3 - 0.6)


def test_swept_clearance_of_nothing_that_moves() -> None:
    clearance = geometry.swept_clearance(
        np.zeros((1, 3)),
        np.zeros((1, 2)),
        np.array([[[3.0, 4.0]]]),
        np.zeros((1, 1, 2)),
        np.ones((1, 1)),
        0.1,
        0.5,
    )
    assert clearance.item() == pytest.approx(3.5)
