"""Frames: exact changes of coordinates, and units of the reading noise."""

from __future__ import annotations

import numpy as np
import pytest

import rise_envs
from rise_agents import readings
from rise_envs.task import task_of

VEHICLE, PANDA = "RISE-GroundVehicle-v0", "RISE-SafePanda-v0"


def sample(env_id, rows=200, seed=0, **kwargs):
    rng, task = np.random.default_rng(seed), task_of(env_id, **kwargs)
    state = rng.normal(size=(rows, 3 if task.dim == 2 else 13)) * 3
    goal = rng.normal(size=(rows, task.dim)) * 5
    return task, {
        "observation": state,
        "achieved_goal": state[:, : task.dim],
        "desired_goal": goal,
        "obstacle": rng.normal(size=(rows, len(task.noise_scale))),
    }


def test_vehicle_body_frame_by_hand():
    """Looking north from (1, 2): what lies two metres north is ahead, what lies west is to the left."""
    task = task_of(VEHICLE)
    state, goal = np.array([[1.0, 2.0, np.pi / 2]]), np.array([[1.0, 5.0]])
    reading = np.array([[-3.0, 2.0, 0.0, -1.0, 0.7]])
    goal, position, velocity, radius = readings.to_body(task, state, goal, reading)
    np.testing.assert_allclose(goal, [[3.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(position, [[[0.0, 4.0]]], atol=1e-12)
    np.testing.assert_allclose(velocity, [[[-1.0, 0.0]]], atol=1e-12)
    assert radius == 0.7


def test_body_frame_equals_complex_arithmetic():
    task, o = sample(VEHICLE)
    turn = np.exp(-1j * o["observation"][:, 2])
    place = o["observation"][:, 0] + 1j * o["observation"][:, 1]
    expected = (o["obstacle"][:, 0] + 1j * o["obstacle"][:, 1] - place) * turn
    _, position, _, _ = readings.to_body(task, o["observation"], o["desired_goal"], o["obstacle"])
    np.testing.assert_allclose(position[:, 0, 0] + 1j * position[:, 0, 1], expected, atol=1e-12)


@pytest.mark.parametrize(("env_id", "kwargs"), [(VEHICLE, {}), (VEHICLE, {"n_obstacles": 3}), (PANDA, {})])
def test_world_to_body_and_back_is_exact(env_id, kwargs):
    task, o = sample(env_id, **kwargs)
    _, position, velocity, radius = readings.to_body(task, o["observation"], o["desired_goal"], o["obstacle"])
    back = readings.to_world(task, o["observation"], position, velocity, radius)
    np.testing.assert_allclose(back, o["obstacle"], rtol=0, atol=1e-13)


def test_body_frame_and_features_ignore_where_the_world_s_origin_is():
    """A rigid motion of vehicle, goal and obstacle together changes nothing."""
    task, o = sample(VEHICLE)
    angle, shift = 0.7, np.array([3.0, -8.0])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    place = o["observation"][:, :2] @ turn.T + shift
    c = o["obstacle"]
    moved = {
        "observation": np.column_stack((place, o["observation"][:, 2] + angle)),
        "achieved_goal": place,
        "desired_goal": o["desired_goal"] @ turn.T + shift,
        "obstacle": np.column_stack((c[:, :2] @ turn.T + shift, c[:, 2:4] @ turn.T, c[:, 4])),
    }
    for frame in ("body", "features"):
        for before, after in zip(
            readings.inputs(task, frame, o), readings.inputs(task, frame, moved), strict=True
        ):
            np.testing.assert_allclose(after, before, atol=1e-9)


def test_features_by_hand():
    """Goal ahead, disc of radius 1 ahead at 5 m, moving towards a robot of radius 0.5 m at 1 m/s."""
    task = task_of(VEHICLE)
    o = {
        "observation": np.zeros((1, 3)),
        "achieved_goal": np.zeros((1, 2)),
        "desired_goal": np.array([[10.0, 0.0]]),
        "obstacle": np.array([[5.0, 0.0, -1.0, 0.0, 1.0]]),
    }
    robot, features = readings.inputs(task, "features", o)
    np.testing.assert_allclose(robot, [[10.0, 0.0, 10.0, 1.0, 0.0]])
    names = [
        "px",
        "py",
        "vx",
        "vy",
        "r",
        "distance",
        "tx",
        "ty",
        "clearance",
        "closing",
        "ax",
        "ay",
        "covered",
    ]
    value = dict(zip(names, features[0], strict=False))
    assert value["distance"] == 5.0
    assert value["clearance"] == 3.5
    assert value["closing"] == 1.0
    assert value["covered"] == pytest.approx(np.arcsin(1.5 / 5))
    assert (value["ax"], value["ay"]) == (0.0, 0.0)


@pytest.mark.parametrize("env_id", list(rise_envs.ENVS))
@pytest.mark.parametrize("frame", readings.FRAMES)
def test_every_frame_is_finite_even_on_absurd_readings(env_id, frame):
    task, o = sample(env_id)
    o["obstacle"][0] = 0.0
    o["obstacle"][1] *= 1e6
    o["obstacle"][2, -1] = -5.0  # a negative radius
    o["desired_goal"][3] = o["achieved_goal"][3]
    for part in readings.inputs(task, frame, o):
        assert np.isfinite(part).all()


def test_reading_units_of_features_equal_the_scale_where_features_are_linear():
    """Position, velocity and radius are among the features: their units are the noise scale itself."""
    task, o = sample(PANDA, rows=4_000)
    units = readings.reading_units(task, "features", o)
    np.testing.assert_allclose(units[:7], task.noise_scale, rtol=0.03)
    np.testing.assert_array_equal(readings.reading_units(task, "body", o), task.noise_scale)


def test_standardiser_round_trip_and_constant_columns():
    x = np.column_stack((np.arange(10.0), np.full(10, 3.0)))
    units = readings.Standardiser.fit(x)
    y = units(x)
    np.testing.assert_allclose(y.std(0), [1, 0], atol=1e-6)
    again = readings.Standardiser.from_arrays(units.arrays("u"), "u")
    np.testing.assert_array_equal(again(x), y)
