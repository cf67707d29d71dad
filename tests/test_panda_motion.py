"""The arm's motion without the engine against the engine, and its linear algebra against NumPy."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from rise_envs import panda_lanes as lanes
from rise_envs.panda_kinematics import NEUTRAL, hand_position
from rise_envs.panda_motion import Arms
from rise_envs.panda_sim import PandaSim

AWAY = ((0.9, 0.9, 0.9), (0.0, 0.0, 0.0), 0.05)  # a sphere out of the way: place, velocity, radius
FAR = (10.0, -2)  # its clearance


@pytest.fixture(scope="module")
def sim() -> Iterator[PandaSim]:
    made = PandaSim()
    yield made
    made.close()


def poses(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return NEUTRAL + rng.uniform(-1, 1, (count, 7)) * np.array([0.7, 0.6, 0.4, 0.7, 0.4, 0.5, 0.4])


def positive(size: int, rng: np.random.Generator) -> np.ndarray:
    """Positive definite matrices (L, size, size)."""
    half = rng.normal(size=(lanes.LANES, size, size))
    return half @ half.transpose(0, 2, 1) + 0.1 * np.eye(size)


def last(array: np.ndarray) -> np.ndarray:
    """The arms' axis moved from the front to the end."""
    return np.ascontiguousarray(np.moveaxis(array, 0, -1))


def test_six_unknowns_are_solved_and_seven_inverted_as_by_numpy() -> None:
    rng = np.random.default_rng(1)
    matrix, side = positive(6, rng), rng.normal(size=(lanes.LANES, 6))
    expected = np.linalg.solve(matrix, side[..., None])[..., 0]
    result = last(side)
    lanes.solve(last(np.tril(matrix)), result)
    np.testing.assert_allclose(result, last(expected), atol=1e-8)

    matrix = positive(7, rng)
    inverse = last(np.tril(matrix))
    lanes.invert(inverse, np.empty((7, lanes.LANES)))
    np.testing.assert_allclose(inverse, last(np.linalg.inv(matrix)), atol=1e-8)


def test_turning_cosines_and_sines_needs_no_sine() -> None:
    rng = np.random.default_rng(2)
    angle, change = rng.uniform(-3, 3, (2, 7, lanes.LANES))
    change *= 0.6 / 3
    cos, sin = np.cos(angle), np.sin(angle)
    lanes.turn(cos, sin, change)
    np.testing.assert_allclose(cos, np.cos(angle + change), atol=1e-12)
    np.testing.assert_allclose(sin, np.sin(angle + change), atol=1e-12)


def test_mass_matrix_and_gravity_are_the_engines(sim: PandaSim) -> None:
    q = poses(lanes.LANES)
    axes, origin = np.zeros((8, 3, 3, lanes.LANES)), np.zeros((8, 3, lanes.LANES))
    axes[0] = np.eye(3)[..., None]
    origin[0, 0] = -0.6
    lanes.write_frames(last(np.cos(q)), last(np.sin(q)), axes, origin)
    scratch, body, twist = (
        np.empty((12, lanes.LANES)),
        np.empty((7, 15, lanes.LANES)),
        np.empty((7, 6, lanes.LANES)),
    )
    matrix, torque = np.zeros((7, 7, lanes.LANES)), np.empty((7, lanes.LANES))
    lanes.write_bodies(axes, origin, np.zeros((7, lanes.LANES)), scratch, body, twist)
    lanes.write_dynamics(twist, body, scratch, matrix, torque)
    for m in range(lanes.LANES):
        full, rest = [*q[m], 0.0, 0.0], [0.0] * 9  # the fingers are joints of their own there
        engine = sim._bullet.calculateMassMatrix(sim._arm, full, physicsClientId=sim._client)
        np.testing.assert_allclose(matrix[..., m], np.tril(np.array(engine)[:7, :7]), atol=1e-6)
        holding = sim._bullet.calculateInverseDynamics(
            sim._arm, full, rest, rest, physicsClientId=sim._client
        )
        np.testing.assert_allclose(-torque[:, m], holding[:7], atol=1e-4)


def test_the_hand_moves_as_in_the_engine(sim: PandaSim) -> None:
    """Mean deviation over 40 steps of random actions, away from the table."""
    rng = np.random.default_rng(3)
    count, steps = 6, 40
    actions = rng.uniform(-1, 1, (steps, count, 3)).astype(np.float32)
    arms, hands, speeds = Arms.at_rest(count), np.empty((steps, count, 3)), np.empty((steps, count, 3))
    engine = np.empty((steps, count, 13))
    for arm in range(count):
        sim.reset()
        for step in range(steps):
            # Push up where the hand is low, so that the table is never touched.
            actions[step, arm, 2] += 1.5 * (sim.state()[2] < 0.2)
            np.clip(actions, -1, 1, out=actions)
            sim.step(actions[step, arm], *AWAY, FAR)
            engine[step, arm] = sim.state()
    assert engine[..., 2].min() > 0.08
    for step in range(steps):
        arms.step(actions[step])
        hands[step], speeds[step] = arms.hand, arms.velocity
    error = np.linalg.norm(hands - engine[..., :3], axis=-1)
    assert error[0].mean() < 0.0005
    assert error.mean() < 0.002
    assert error.max() < 0.01
    assert np.abs(arms.q - engine[-1, :, 6:]).max() < 0.05
    assert np.linalg.norm(speeds - engine[..., 3:6], axis=-1).mean() < 0.03


def test_arms_do_not_depend_on_their_company() -> None:
    rng = np.random.default_rng(4)
    count = lanes.LANES + 3
    actions = rng.uniform(-1.5, 1.5, (5, count, 3))  # some beyond the bounds
    together, alone, clipped = Arms.at_rest(count), Arms.at_rest(1), Arms.at_rest(count)
    for action in actions:
        together.step(action)
        alone.step(action[-1:])
        clipped.step(np.clip(action, -1, 1))
    for name in ("q", "speed", "hand", "velocity"):
        np.testing.assert_array_equal(getattr(together, name)[-1:], getattr(alone, name))
        np.testing.assert_array_equal(getattr(together, name), getattr(clipped, name))


def test_an_arm_at_rest_is_where_the_kinematics_puts_it() -> None:
    arms = Arms.at_rest(2)
    np.testing.assert_array_equal(arms.hand, hand_position(arms.q))
    assert not arms.speed.any() and not arms.velocity.any()
