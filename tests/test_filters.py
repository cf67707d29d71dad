"""Filters before any policy; the Kalman filter against the textbook's matrices and against how balls really move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from rise_agents import make_agent
from rise_agents.experts import make_expert
from rise_agents.filters import FILTERS, filter_class, make_filter
from rise_agents.filters.kalman import KalmanFilter
from rise_agents.rollout import policy_keys, rollout
from rise_agents.seeds import episode_seeds
from rise_envs import obstacles
from rise_envs.task import task_of

VEHICLE, PANDA = "RISE-GroundVehicle-v0", "RISE-SafePanda-v0"


class Watcher:
    """Does nothing, and remembers what it was shown."""

    evaluate_deterministic = False

    def __init__(self):
        self.seen = []

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        self.seen.append(np.array(observation["obstacle"]))
        single = np.ndim(observation["desired_goal"]) == 1
        return np.zeros(2 if single else (len(observation["desired_goal"]), 2), np.float32), None


def observation_of(task, readings):
    batch = len(readings)
    widths = {key: np.ones((batch, width)) for key, width in task.widths.items()}
    return {**widths, "obstacle": readings}


def filtered(task, level, readings):
    """Filtered readings (B, T, C) of readings (B, T, C), and the last covariance (B, N, D, 3)."""
    watcher = Watcher()
    kalman = KalmanFilter(watcher, task, level)
    state = kalman.initial_state(np.arange(len(readings), dtype=np.uint64))
    for t in range(readings.shape[1]):
        _, state = kalman.predict(observation_of(task, readings[:, t]), state)
    return np.stack(watcher.seen, 1), state[1]


def balls(task, episodes, steps, rng):
    """True readings (B, T, C) of balls that move as the environments' do, with no wall or goal near."""
    far = (1e6,) * task.dim
    motion = obstacles.Motion(
        task.dt, task.obstacle_speed, task.redraw_interval, tuple(-x for x in far), far, 0.0
    )
    key = rng.integers(0, 2**63, episodes).astype(np.uint64)
    n = task.n_obstacles
    position = rng.uniform(-10, 10, (episodes, n, task.dim))
    velocity = obstacles.draw_velocity(key, 0, n, motion)
    radius = rng.uniform(0.5, 2.0, (episodes, n))
    out = []
    for t in range(steps):
        out.append(obstacles.readings(position, velocity, radius))
        position = position + task.dt * velocity
        velocity = obstacles.redraw(velocity, key, t + 1, motion)
    return np.stack(out, 1)


def noisy(task, level, true, rng):
    return true + level * np.asarray(task.noise_scale) * rng.normal(size=true.shape)


def matrices(task, level):
    """F, Q, H and R of one coordinate of the first ball, in the textbook's letters."""
    position, velocity, _ = (part[0, 0, ...] for part in task.split(np.asarray(task.noise_scale)[None]))
    q = task.dt / task.redraw_interval
    variance = task.obstacle_speed**2 / (3 * task.dim)
    f = np.array([[1.0, task.dt], [0.0, 1.0 - q]])
    big_q = np.diag([0.0, (1 - (1 - q) ** 2) * variance])
    r = level**2 * np.diag([position[0] ** 2, velocity[0] ** 2])
    return f, big_q, np.eye(2), r, variance


def textbook(task, level, z):
    """Estimates (T, 2) of one coordinate from its readings (T, 2): predict, gain, update; a vague start."""
    f, q, h, r, variance = matrices(task, level)
    x, p = np.zeros(2), np.diag([1e9, variance])
    out = []
    for t, reading in enumerate(z):
        if t:
            x, p = f @ x, f @ p @ f.T + q
        gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
        x = x + gain @ (reading - h @ x)
        p = (np.eye(2) - gain @ h) @ p @ (np.eye(2) - gain @ h).T + gain @ r @ gain.T
        out.append(x)
    return np.array(out), p


@pytest.mark.parametrize(
    ("task", "level"),
    [(task_of(VEHICLE), 1.0), (task_of(VEHICLE, n_obstacles=3), 0.3), (task_of(PANDA), 2.0)],
    ids=["vehicle", "three discs", "panda"],
)
def test_against_the_textbook_s_matrices(task, level):
    rng = np.random.default_rng(0)
    readings = noisy(task, level, balls(task, 4, 40, rng), rng)
    got, covariance = filtered(task, level, readings)
    z_p, z_v, z_r = (
        part.reshape(4, 40, task.n_obstacles, -1) for part in task.split(readings.reshape(160, -1))
    )
    p, v, r = (part.reshape(4, 40, task.n_obstacles, -1) for part in task.split(got.reshape(160, -1)))
    for b in range(4):
        for n in range(task.n_obstacles):
            for d in range(task.dim):
                z = np.stack((z_p[b, :, n, d], z_v[b, :, n, d]), -1)
                expected, last = textbook(task, level, z)
                np.testing.assert_allclose(p[b, :, n, d], expected[:, 0], rtol=1e-6, atol=1e-6)
                np.testing.assert_allclose(v[b, :, n, d], expected[:, 1], rtol=1e-6, atol=1e-6)
                entries = [last[0, 0], last[0, 1], last[1, 1]]
                np.testing.assert_allclose(covariance[b, n, d], entries, rtol=1e-5, atol=1e-9)
            means = np.cumsum(z_r[b, :, n, 0]) / np.arange(1, 41)
            np.testing.assert_allclose(r[b, :, n, 0], means, rtol=1e-9)


@pytest.mark.parametrize("env", [VEHICLE, PANDA])
def test_the_gain_settles_where_the_riccati_equation_says(env):
    """The covariance after many readings is that of the stationary filter, found by scipy."""
    task, level = task_of(env), 1.5
    _, covariance = filtered(task, level, np.zeros((1, 400, task.widths["obstacle"])))
    f, q, h, r, _ = matrices(task, level)
    before = solve_discrete_are(f.T, h.T, q, r)
    after = before - before @ h.T @ np.linalg.inv(h @ before @ h.T + r) @ h @ before
    np.testing.assert_allclose(covariance[0, 0, 0], [after[0, 0], after[0, 1], after[1, 1]], rtol=1e-6)


@pytest.mark.parametrize("env", [VEHICLE, PANDA])
def test_errors_are_as_large_as_the_filter_believes(env):
    """On balls that move by the environments' own code: its model of the draws is right, in mean square."""
    task, rng = task_of(env), np.random.default_rng(1)
    true = balls(task, 4_000, 50, rng)
    got, covariance = filtered(task, 1.0, noisy(task, 1.0, true, rng))
    p, v, _ = task.split(got[:, -1] - true[:, -1])
    np.testing.assert_allclose((p**2).mean(0), covariance[0, ..., 0], rtol=0.1)
    np.testing.assert_allclose((v**2).mean(0), covariance[0, ..., 2], rtol=0.1)
    np.testing.assert_allclose((p * v).mean(0), covariance[0, ..., 1], rtol=0.2)


def test_noise_on_balls_of_constant_velocity_averages_out():
    """With no draws in sight nothing limits the filter: the error falls with the readings, far below the noise."""
    task, rng = replace(task_of(VEHICLE), redraw_interval=1e9), np.random.default_rng(2)
    true = balls(task, 500, 200, rng)
    readings = noisy(task, 1.0, true, rng)
    got, _ = filtered(task, 1.0, readings)
    raw, early, late = (
        ((x - true[:, t]) ** 2).mean(0)
        for x, t in ((readings[:, 50], 50), (got[:, 20], 20), (got[:, -1], -1))
    )
    assert (late < 0.05 * raw).all() and (late < 0.5 * early).all()
    assert late[4] == pytest.approx(1 / 200, rel=0.2)  # the radius: a mean of 200 readings


def test_an_error_that_stays_does_not_average_out():
    task, rng = task_of(VEHICLE), np.random.default_rng(3)
    true = balls(task, 2_000, 60, rng)
    bias = rng.normal(size=(2_000, 1, 5))
    got, _ = filtered(task, 1.0, true + bias)
    p, _, r = task.split(got[:, -1] - true[:, -1])
    assert (p**2).mean() > 0.9 and (r**2).mean() > 0.9


def test_level_0_is_the_identity():
    """To the last bit, whatever was read before; of an exact channel at other levels nothing is changed either."""
    task, rng = task_of(VEHICLE), np.random.default_rng(4)
    readings = rng.normal(size=(3, 10, 5))
    np.testing.assert_array_equal(filtered(task, 0.0, readings)[0], readings)
    exact = replace(task, noise_scale=(0.0, 0.0, 1.0, 1.0, 1.0))
    true = balls(task, 3, 10, rng)
    got, covariance = filtered(exact, 1.0, noisy(exact, 1.0, true, rng))
    np.testing.assert_allclose(got[..., :2], true[..., :2], atol=1e-12)
    assert np.isfinite(got).all() and np.isfinite(covariance).all()


def test_rows_do_not_depend_on_their_neighbours_nor_on_who_began_when():
    task, rng = task_of(VEHICLE, n_obstacles=2), np.random.default_rng(5)
    readings = rng.normal(size=(5, 12, 10))
    together, _ = filtered(task, 1.0, readings)
    for row in range(5):
        np.testing.assert_array_equal(filtered(task, 1.0, readings[row : row + 1])[0][0], together[row])
    # Row 2 begins anew in step 6, told by episode_start.
    watcher = Watcher()
    kalman = KalmanFilter(watcher, task, 1.0)
    state = None
    for t in range(12):
        starts = np.arange(5) == 2 if t == 6 else None
        _, state = kalman.predict(observation_of(task, readings[:, t]), state, starts)
    seen = np.stack(watcher.seen, 1)
    np.testing.assert_array_equal(seen[:, :6], together[:, :6])
    np.testing.assert_array_equal(seen[[0, 1, 3, 4]], together[[0, 1, 3, 4]])
    np.testing.assert_array_equal(seen[2, 6:], filtered(task, 1.0, readings[2:3, 6:])[0][0])


def test_a_single_observation_is_filtered_as_a_batch_of_one():
    task, rng = task_of(VEHICLE), np.random.default_rng(6)
    readings = rng.normal(size=(1, 8, 5))
    expected, _ = filtered(task, 1.0, readings)
    watcher = Watcher()
    kalman, state = KalmanFilter(watcher, task, 1.0), None
    for t in range(8):
        one = {key: value[0] for key, value in observation_of(task, readings[:, t]).items()}
        action, state = kalman.predict(one, state, np.ones(1, bool) if t == 0 else None)
        assert action.shape == (2,)
    np.testing.assert_array_equal(np.stack(watcher.seen), expected[0])


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("slots", [1, 64])
def test_a_roll_out_behind_a_filter_does_not_depend_on_its_batch(name, slots, vehicle_demonstrations):
    """Also around an agent that draws and an expert that remembers: their states are merged row by row."""
    brief = {"updates": 30, "vae_updates": 30, "batch_size": 32, "vae_batch_size": 32}
    agent = make_agent("rise", VEHICLE, brief).learn(vehicle_demonstrations)
    seeds = episode_seeds("validation", 0, 0, 9)
    for policy in (agent, make_expert("cbf", VEHICLE)):
        results = [
            rollout(
                make_filter(name, policy, VEHICLE, 1.0),
                VEHICLE,
                seeds,
                noise_level=1.0,
                deterministic=False,
                slots=n,
            )[0]
            for n in (3, slots)
        ]
        for field, values in vars(results[0]).items():
            np.testing.assert_allclose(vars(results[1])[field], values, rtol=1e-3, err_msg=field)


def test_behind_the_filter_an_agent_draws_what_it_draws_without(vehicle_demonstrations):
    """At level 0 the whole policy is the inner one, state and all."""
    brief = {"updates": 5, "vae_updates": 5, "batch_size": 32, "vae_batch_size": 32}
    agent = make_agent("rise", VEHICLE, brief).learn(vehicle_demonstrations)
    kalman = make_filter("kalman", agent, VEHICLE, 0.0)
    assert kalman.evaluate_deterministic is False
    observation = {key: value[:6] for key, value in vehicle_demonstrations.observations.items()}
    keys = policy_keys(range(6))
    inner, outer = agent.initial_state(keys), kalman.initial_state(keys)
    for _ in range(3):
        expected, inner = agent.predict(observation, inner)
        action, outer = kalman.predict(observation, outer)
        np.testing.assert_array_equal(action, expected)
    assert outer[2].tolist() == [3] * 6


def test_what_makes_no_sense_is_refused():
    with pytest.raises(ValueError, match="did you mean 'kalman'"):
        filter_class("kalmann")
    for level in (-1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="noise_level"):
            make_filter("kalman", Watcher(), VEHICLE, level)
    kalman = make_filter("kalman", Watcher(), VEHICLE, 1.0)
    broken = observation_of(task_of(VEHICLE), np.full((1, 5), np.nan))
    with pytest.raises(ValueError, match=r"obstacle.*not finite"):
        kalman.predict(broken)
