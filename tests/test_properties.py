"""What must hold whatever is done: limits, closed forms, symmetries, and what noise may and may not touch."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from benchmarks import stats
from rise_agents import readings
from rise_agents.experts import make_expert
from rise_envs import ENVS, NOISE_MODELS, ObservationNoise, VectorObservationNoise, streams
from rise_envs import panda_kinematics as panda
from rise_envs.ground_vehicle import GroundVehicleEnv
from rise_envs.panda_motion import Arms
from rise_envs.task import task_of
from rise_envs.vehicle_world import Params, World

NATIVE = [env_id for env_id, (_, vector_entry, _) in ENVS.items() if vector_entry]
TASK = task_of("RISE-GroundVehicle-v0")
MODELS = [*NOISE_MODELS, "step+dropout:0.3+delay:2", "step@position+delay@velocity"]
wild = st.floats(-1e9, 1e9, width=32)


@functools.cache
def made(env_id: str) -> Any:
    return gym.make(env_id).unwrapped


@pytest.fixture(scope="module", autouse=True)
def closed_at_the_end() -> Iterator[None]:
    yield
    for env_id in ENVS:
        made(env_id).close()
    made.cache_clear()


# --- limits -----------------------------------------------------------------------------------------------------


@given(st.lists(st.tuples(wild, wild), min_size=1, max_size=8), st.integers(0, 2**32))
def test_the_vehicle_keeps_its_speeds_and_drives_the_arc(
    actions: list[tuple[float, float]], seed: int
) -> None:
    """The closed form of the arc, x + v/ω·(sin(θ + ωt) − sin θ), or of the straight line where ω vanishes."""
    env, p, dt = made("RISE-GroundVehicle-v0"), Params(), 0.1
    before = env.reset(seed=seed)[0]["observation"]
    for action in actions:
        v = min(max(action[0], p.v_min), p.v_max)
        omega = min(max(action[1], -p.omega_max), p.omega_max)
        x, y, theta = before
        if abs(omega) < 1e-5:  # the arc's own error there: v·ω²·dt³/6
            wanted = x + v * dt * np.cos(theta + omega * dt / 2), y + v * dt * np.sin(theta + omega * dt / 2)
        else:
            wanted = (
                x + v / omega * (np.sin(theta + omega * dt) - np.sin(theta)),
                y - v / omega * (np.cos(theta + omega * dt) - np.cos(theta)),
            )
        after = env.step(np.array(action))[0]["observation"]
        np.testing.assert_allclose(after[:2], wanted, rtol=0, atol=1e-9)
        turned = np.angle(np.exp(1j * (after[2] - theta)))
        assert turned == pytest.approx(omega * dt, abs=1e-12)
        assert (
            np.hypot(*(after[:2] - before[:2])) <= p.v_max * dt + 1e-12
        )  # a chord is no longer than its arc
        before = after


@settings(max_examples=15)
@given(arrays(np.float64, (30, 8, 3), elements=st.floats(-3, 3)))
def test_the_model_of_the_arm_keeps_its_joints_within_their_limits(actions: np.ndarray) -> None:
    """From the neutral pose, and on from where a second of pushing in one direction has put it."""
    actions = actions.copy()
    actions[:25] = np.sign(actions[0])  # a limit is reached only by those who insist
    arms, sphere = Arms.at_rest(8), np.tile([0.9, 0.9, 0.9, 0, 0, 0, 0.05], (8, 1))
    for action in actions:
        before = arms.q
        arms, *_ = arms.step(action, sphere)
        assert (arms.q > panda.JOINT_LOW - 0.01).all() and (arms.q < panda.JOINT_HIGH + 0.01).all()
        assert np.isfinite(arms.speed).all()
        assert np.abs(arms.q - before).max() < 1.0  # rad in a step
        assert np.linalg.norm(arms.velocity, axis=-1).max() < 10.0  # m/s, the bound of the observation space


def test_the_arm_in_the_engine_keeps_its_joints_within_their_limits() -> None:
    env, rng = made("RISE-SafePanda-v0"), np.random.default_rng(0)
    nearest = []
    for seed, way in enumerate(((-1, 0, 0), (-1, 0, 1), (1, 0, 1), (0, 1, -1))):
        observation, _ = env.reset(seed=seed)
        for step in range(50):
            observation = env.step(way if step < 35 else rng.uniform(-5, 5, 3))[0]
            q = observation["observation"][6:]
            nearest.append(np.minimum(q - panda.JOINT_LOW, panda.JOINT_HIGH - q).min())
            assert nearest[-1] > -0.01
            assert env.observation_space["observation"].contains(observation["observation"])
    assert min(nearest) < 0.01  # one was reached


# --- symmetry -----------------------------------------------------------------------------------------------------

# Walls and draws of new velocities know where north is; without them nothing does.
FREE = Params(obstacle_half=1e6, redraw_interval=1e12)
poses = st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-np.pi, np.pi))


def moved(points: np.ndarray, frame: tuple[float, float, float], shift: bool = True) -> np.ndarray:
    """Points (or, without the shift, vectors) (..., 2) turned by frame[2], then shifted."""
    z = (points[..., 0] + 1j * points[..., 1]) * np.exp(1j * frame[2]) + shift * complex(frame[0], frame[1])
    return np.stack((z.real, z.imag), -1)


def moved_world(w: World, frame: tuple[float, float, float]) -> World:
    state = np.concatenate((moved(w.state[:, :2], frame), w.state[:, 2:] + frame[2]), 1)
    disc = np.concatenate(
        (moved(w.disc[..., :2], frame), moved(w.disc[..., 2:4], frame, False), w.disc[..., 4:]), -1
    )
    return World(state, moved(w.goal, frame), disc, w.key, w.step)


@settings(max_examples=60)
@given(poses, st.integers(0, 2**32), arrays(np.float64, (12, 2), elements=st.floats(-2, 3)))
def test_a_scene_moved_as_a_whole_goes_on_in_the_same_way(
    frame: tuple[float, float, float], seed: int, actions: np.ndarray
) -> None:
    """Clearance, cost, reward, ends and what the vehicle sees from its own frame, through a dozen steps."""
    env, twin = (GroundVehicleEnv(n_obstacles=2, params=FREE) for _ in range(2))
    env.reset(seed=seed), twin.reset(seed=seed)
    world = env.world
    world.disc[0, 0, :2] = (
        world.state[0, :2] + 1.6
    )  # near enough to be met, and to be turned away by the goal
    world.goal[0] = world.disc[0, 1, :2] + 3.0
    env.world, twin.world = world, moved_world(world, frame)
    for action in actions:
        a, b = env.step(action), twin.step(action)
        for key in ("clearance", "cost", "is_success"):
            assert b[4][key] == pytest.approx(a[4][key], abs=1e-9), key
        assert b[1:3] == (pytest.approx(a[1], abs=1e-9), a[2])
        np.testing.assert_allclose(twin.world.position, moved(env.world.position, frame), atol=1e-9)
        for name in ("body", "features"):
            seen = [
                readings.inputs(TWO, name, {key: part[None] for key, part in said.items()})
                for said in (a[0], b[0])
            ]
            for one, other in zip(*seen, strict=True):
                np.testing.assert_allclose(*map(circular, (other, one)), atol=1e-7)


TWO = task_of("RISE-GroundVehicle-v0", n_obstacles=2)


def circular(x: np.ndarray) -> np.ndarray:
    """Numbers as cosine and sine beside their size, as a bearing of π may come out as −π."""
    return np.concatenate((np.cos(x), np.abs(x)), -1)


# --- cost -----------------------------------------------------------------------------------------------------------


def blind(env_id: str) -> Callable[[dict[str, np.ndarray]], np.ndarray]:
    """Actions straight to the goal: an expert that is told of no obstacle."""
    expert = make_expert("cbf", env_id)

    def act(observation: dict[str, np.ndarray]) -> np.ndarray:
        return expert.predict({**observation, "obstacle": observation["obstacle"] + 1e3})[0].astype(
            np.float32
        )

    return act


def infos_of_single(env_id: str, act: Any) -> Iterator[tuple[float, float]]:
    env, episodes = made(env_id), 20 if env_id in NATIVE else 4
    for seed in range(episodes):
        observation, info = env.reset(seed=seed)
        for _ in range(ENVS[env_id][2]):
            yield info["cost"], info["clearance"]
            observation, _, terminated, _, info = env.step(act(observation))
            if terminated:
                break
        yield info["cost"], info["clearance"]


def infos_of_batch(env_id: str, act: Any) -> Iterator[tuple[float, float]]:
    env = gym.make_vec(env_id, 64)
    observation, infos = env.reset(seed=0)
    for _ in range(ENVS[env_id][2] + 5):
        yield from zip(infos["cost"], infos["clearance"], strict=True)
        observation, *_, infos = env.step(act(observation))


@pytest.mark.parametrize("env_id", ENVS)
def test_a_step_costs_something_exactly_where_its_clearance_is_negative(env_id: str) -> None:
    act = blind(env_id)
    rows = list(infos_of_single(env_id, act))
    if env_id in NATIVE:
        rows += infos_of_batch(env_id, act)
    cost, clearance = np.array(rows).T
    np.testing.assert_array_equal(cost > 0, clearance < 0)
    assert set(cost) == {0.0, 1.0}  # both were met


# --- noise ----------------------------------------------------------------------------------------------------------


def assert_same(a: Any, b: Any) -> None:
    np.testing.assert_equal(a, b)


@pytest.mark.parametrize("noise", MODELS)
@pytest.mark.parametrize("env_id", ENVS)
def test_noise_changes_readings_only_and_none_changes_nothing(env_id: str, noise: str) -> None:
    """The same seed with noise, with level 0, with scale 0 and bare: one and the same trajectory."""
    bare = gym.make(env_id)
    silent = {"level 0": {"noise_level": 0.0}}
    if noise in ("step", "outlier", "episode", "drift", "quantise"):  # the others do not add, they hold back
        silent["scale 0"] = {"noise_scale": 0.0}
    wrapped = {name: ObservationNoise(gym.make(env_id), noise, **kwargs) for name, kwargs in silent.items()}  # type: ignore[arg-type]
    noisy = ObservationNoise(gym.make(env_id), noise)
    for seed in (0, None):  # the second one is named by the streams of the first
        observation, info = bare.reset(seed=seed)
        said = {name: env.reset(seed=seed) for name, env in wrapped.items()}
        heard, noisy_info = noisy.reset(seed=seed)
        action, changed = np.full(bare.action_space.shape or (), 0.3, np.float32), False
        for _ in range(6):
            for name, parts in said.items():
                assert_same(parts[0], observation), name
                assert parts[0]["obstacle"].tobytes() == observation["obstacle"].tobytes()
            assert_same(noisy_info.pop("clean_observation"), observation)
            assert_same(noisy_info, info)
            changed |= bool((heard.pop("obstacle") != observation["obstacle"]).any())
            assert_same(heard, {key: part for key, part in observation.items() if key != "obstacle"})
            observation, *outcome, info = bare.step(action)
            said = {name: env.step(action) for name, env in wrapped.items()}
            heard, *noisy_outcome, noisy_info = noisy.step(action)
            assert noisy_outcome == outcome
        assert changed or noise.startswith("dropout")
    for env in (bare, noisy, *wrapped.values()):
        env.close()


@pytest.mark.parametrize("env_id", NATIVE)
def test_noise_of_the_twin_has_the_stated_law_and_is_nobody_elses(env_id: str) -> None:
    """Mean and deviation in every channel; no correlation with what the environment drew of the same seeds."""
    n, steps = 4000, 5
    env = VectorObservationNoise(gym.make_vec(env_id, n), "step", noise_level=0.5)
    scale = 0.5 * np.array(task_of(env_id).noise_scale)
    observation, infos = env.reset(seed=0)
    goal, clean = observation["desired_goal"].copy(), infos["clean_observation"]["obstacle"].copy()
    errors = [(observation["obstacle"] - clean) / scale]
    for _ in range(steps - 1):
        observation, *_, infos = env.step(np.zeros(env.action_space.shape or (), np.float32))
        errors.append((observation["obstacle"] - infos["clean_observation"]["obstacle"]) / scale)
    e = np.concatenate(errors)
    np.testing.assert_allclose(e.mean(0), 0.0, atol=4.5 / np.sqrt(len(e)))
    np.testing.assert_allclose(e.std(0), 1.0, rtol=4.5 / np.sqrt(2 * len(e)))
    draws = np.column_stack((goal, clean))
    for drawn in draws.T:
        for error in errors[0].T:
            for f in (np.asarray, np.abs):
                assert abs(np.corrcoef(f(drawn), f(error))[0, 1]) < 4.5 / np.sqrt(n)


def test_the_streams_of_a_seed_are_apart() -> None:
    """Environment, its episodes, noise and policy: the same seed, other numbers."""
    seeds, tags = range(4000), (3, 0x6E6F6973, 0x65706973)
    draws = [streams.uniform(streams.seed_keys(seeds, tag), 0) for tag in tags]
    draws.append(np.array([np.random.default_rng(seed).random() for seed in seeds]))
    correlation = np.corrcoef(draws) - np.eye(len(draws))
    assert np.abs(correlation).max() < 4.5 / np.sqrt(len(seeds))


# --- rates ------------------------------------------------------------------------------------------------------------


@given(st.lists(st.tuples(st.booleans(), st.booleans()), min_size=1, max_size=60))
def test_rates_of_any_episodes(outcomes: list[tuple[bool, bool]]) -> None:
    safe, arrived = zip(*outcomes, strict=True)
    rows = pa.table({"safe": pa.array(safe, pa.bool_()), "arrived": pa.array(arrived, pa.bool_())})
    safety, arrival, reach = stats.safety_rate(rows), stats.arrival_rate(rows), stats.reach_rate(rows)
    assert 0 <= reach <= min(safety, arrival) <= max(safety, arrival) <= 1
    assert reach >= safety + arrival - 1 - 1e-12  # Bonferroni
    assert reach == pytest.approx(sum(map(all, outcomes)) / len(outcomes))


@given(st.integers(1, 10**6), st.data())
def test_wilson_intervals_hold_the_rate_and_mirror(n: int, data: Any) -> None:
    k = data.draw(st.integers(0, n))
    low, high = stats.wilson(k, n)
    assert 0 <= low <= k / n <= high <= 1
    mirrored = stats.wilson(n - k, n)
    assert (1 - mirrored[1], 1 - mirrored[0]) == (
        pytest.approx(low, abs=1e-12),
        pytest.approx(high, abs=1e-12),
    )


@pytest.mark.parametrize("n", [200, 500, 1000, 5000])
@pytest.mark.parametrize("truth", [0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99])
def test_wilson_covers_the_truth_in_simulated_studies(truth: float, n: int) -> None:
    """One study counts the successes of n episodes; n as in the benchmark's presets, alone and pooled."""
    successes = np.random.default_rng(n).binomial(n, truth, size=10_000)
    low, high = stats.wilson(successes, n)
    assert 0.93 <= np.mean((low <= truth) & (truth <= high)) <= 0.97
