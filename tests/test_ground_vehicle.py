"""The vehicle's task against its documentation: starts, dynamics, cost, rewards and ends."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

import rise_envs  # noqa: F401
from rise_envs import geometry, streams, vehicle_arrays, vehicle_compiled
from rise_envs.ground_vehicle import GroundVehicleEnv
from rise_envs.vehicle_world import Params, World, observe, sample_starts

PARAMS = Params()


def starts(n: int, n_obstacles: int = 1, params: Params = PARAMS, seed: int = 0) -> World:
    base = streams.seed_bases([seed] * n)
    return sample_starts(base, np.arange(n), n_obstacles, params.constants(), vehicle_compiled)[0]


def make(**kwargs: Any) -> GroundVehicleEnv:
    return GroundVehicleEnv(**kwargs)


def drive(env: GroundVehicleEnv, seed: int, n_steps: int = 200) -> list[dict[str, Any]]:
    """Records of an episode driven straight at the goal: observation, action, next observation, outcome."""
    observation, _ = env.reset(seed=seed)
    records = []
    for _ in range(n_steps):
        way = observation["desired_goal"] - observation["achieved_goal"]
        turn = np.arctan2(way[1], way[0]) - observation["observation"][2]
        action = np.clip([2.5, 2 * ((turn + np.pi) % (2 * np.pi) - np.pi)], [0, -1.5], [2.5, 1.5])
        after, reward, terminated, truncated, info = env.step(action)
        records.append(
            {"obs": observation, "action": action, "next": after, "reward": reward}
            | {"terminated": terminated, "truncated": truncated, "info": info}
        )
        observation = after
        if terminated:
            break
    return records


# --- starts -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_obstacles", [1, 4])
def test_starts_keep_every_stated_rule(n_obstacles: int) -> None:
    w = starts(2000, n_obstacles)
    start, ahead = w.state[:, :2], w.goal - w.state[:, :2]
    distance = np.linalg.norm(ahead, axis=-1)
    assert (np.abs(start) <= 10).all() and (np.abs(w.goal) <= 10).all()
    assert distance.min() >= 12.5 and distance.max() <= 20
    course = np.arctan2(ahead[:, 1], ahead[:, 0])
    off = geometry.wrap_angle(w.state[:, 2] - course)
    assert np.abs(off).max() <= np.pi / 3
    assert (w.state[:, 2] >= -np.pi).all() and (w.state[:, 2] <= np.pi).all()

    unit = ahead / distance[:, None]
    offset = w.position - start[:, None]
    along = np.einsum("bnd,bd->bn", offset, unit) / distance[:, None]
    aside = offset[..., 1] * unit[:, None, 0] - offset[..., 0] * unit[:, None, 1]
    assert along.min() >= 0.35 - 1e-12 and along.max() <= 0.75 + 1e-12
    assert np.abs(aside).max() <= 2.5 + 1e-12
    assert (w.radius >= 0.75).all() and (w.radius <= 2).all()
    assert (np.linalg.norm(w.velocity, axis=-1) <= 1).all()
    assert (np.abs(w.position) <= 12).all()
    gap = np.linalg.norm(w.position - w.goal[:, None], axis=-1) - w.radius
    assert gap.min() >= 1.5

    for time in np.linspace(0, 1, 11):  # the vehicle at rest, the discs on their way
        distance = np.linalg.norm(w.position + time * w.velocity - start[:, None], axis=-1)
        assert (distance - w.radius - 0.5).min() >= 1 - 1e-9


def test_starts_fill_their_ranges() -> None:
    w = starts(5000)
    ahead = w.goal - w.state[:, :2]
    off = geometry.wrap_angle(w.state[:, 2] - np.arctan2(ahead[:, 1], ahead[:, 0]))
    uniform = {"heading": (off / (np.pi / 3) + 1) / 2, "radius": (w.radius[:, 0] - 0.75) / 1.25}
    for name, sample in uniform.items():
        assert stats.kstest(sample, "uniform").pvalue > 0.01, name
    left = (w.position[:, 0, 0] - w.state[:, 0]) * ahead[:, 1] > (
        w.position[:, 0, 1] - w.state[:, 1]
    ) * ahead[:, 0]
    assert left.mean() == pytest.approx(0.5, abs=0.03)
    assert w.goal.mean(0) == pytest.approx(np.zeros(2), abs=0.3)  # no side of the arena is favoured


def test_a_start_is_a_function_of_its_key() -> None:
    together, base = starts(300, 2), streams.seed_bases([0])
    for row in (0, 7, 299):
        alone, _ = sample_starts(base, np.array([row]), 2, PARAMS.constants(), vehicle_compiled)
        for name, value in vars(alone).items():
            np.testing.assert_array_equal(value, getattr(together, name)[row : row + 1], err_msg=name)


def test_parameters_that_leave_no_room_end_in_an_error() -> None:
    crowded = replace(PARAMS, start_margin=30.0)
    for dynamics in (vehicle_compiled, vehicle_arrays):
        with pytest.raises(ValueError, match="no fair start"):
            sample_starts(streams.seed_bases([1]), np.array([0]), 1, crowded.constants(), dynamics)


# --- dynamics ---------------------------------------------------------------------------------------------


def test_observations_follow_the_documented_dynamics() -> None:
    """The vehicle drives the exact arc; each disc moves with the velocity that its reading announced."""
    for record in drive(make(n_obstacles=2), seed=5):
        before, after = record["obs"], record["next"]
        driven = geometry.unicycle(before["observation"], record["action"], 0.1)
        np.testing.assert_allclose(after["observation"], driven, rtol=0, atol=1e-13)
        np.testing.assert_array_equal(after["achieved_goal"], after["observation"][:2])
        discs, moved = before["obstacle"].reshape(2, 5), after["obstacle"].reshape(2, 5)
        np.testing.assert_allclose(moved[:, :2], discs[:, :2] + 0.1 * discs[:, 2:4], rtol=0, atol=1e-14)
        np.testing.assert_array_equal(moved[:, 4], discs[:, 4])
        np.testing.assert_array_equal(after["desired_goal"], before["desired_goal"])


def test_discs_ignore_the_vehicle() -> None:
    """Whatever is driven, the discs of a seed do the same."""
    still, moving = make(), make()
    still.reset(seed=3), moving.reset(seed=3)
    for _ in range(200):
        a, b = still.step([0.0, 0.0])[0], moving.step([2.5, 1.0])[0]
        np.testing.assert_array_equal(a["obstacle"], b["obstacle"])


def test_discs_change_their_velocity_now_and_then() -> None:
    env, changes = make(), 0
    for seed in range(20):
        velocities = [r["next"]["obstacle"][2:4] for r in drive(env, seed)]
        changes += sum((a != b).any() for a, b in pairwise(velocities))
    assert changes > 40


def test_actions_outside_the_bounds_are_clipped() -> None:
    a, b = make(), make()
    a.reset(seed=0), b.reset(seed=0)
    wild, tame = a.step([9.0, -9.0]), b.step(np.array([2.5, -1.5], np.float32))
    np.testing.assert_array_equal(wild[0]["observation"], tame[0]["observation"])
    a.step([-1.0, 0.0])
    assert a.world.state[0, :2].tolist() == wild[0]["achieved_goal"].tolist()  # it has no reverse gear


wide = st.floats(-1e6, 1e6)


@given(st.lists(st.tuples(wide, wide), min_size=1, max_size=10), st.integers(0, 10**6))
def test_no_action_breaks_the_limits(actions: list[tuple[float, float]], seed: int) -> None:
    env = make()
    before = env.reset(seed=seed)[0]["observation"]
    for action in actions:
        observation = env.step(action)[0]
        assert observation in env.observation_space
        after = observation["observation"]
        assert np.linalg.norm(after[:2] - before[:2]) <= 0.25 + 1e-12
        assert abs(geometry.wrap_angle(after[2] - before[2])) <= 0.15 + 1e-12
        before = after


def test_pinned_episode() -> None:
    """v0 means these numbers: a change of the task needs a new version."""
    env = make()
    first, info = env.reset(seed=0)
    for _ in range(50):
        last = env.step([1.0, 0.2])
    np.testing.assert_allclose(
        np.concatenate((first["observation"], first["desired_goal"], first["obstacle"])),
        PINNED_START,
        rtol=1e-12,
    )
    np.testing.assert_allclose(
        np.concatenate((last[0]["observation"], last[0]["obstacle"])), PINNED_END, rtol=1e-9
    )
    np.testing.assert_allclose([info["clearance"], last[1], last[4]["clearance"]], PINNED_OUTCOME, rtol=1e-9)


PINNED_START = [
    -7.389722887154264,
    -1.0771488772413274,
    0.8706711802302901,
    4.006263428504083,
    9.706562016167291,
    -3.109731748088347,
    2.58559739040843,
    -0.1498496810114348,
    0.28726981524420825,
    1.4577749313234918,
]
PINNED_END = [
    -6.436663360563594,
    3.6214213569222307,
    1.8706711802302909,
    -3.9286985577731857,
    3.90511164074203,
    -0.4984417041497878,
    -0.2969043141929591,
    1.4577749313234918,
]
PINNED_OUTCOME = [3.6755220049000012, 0.031919076613675657, 0.5661837904406517]


# --- cost and ends ----------------------------------------------------------------------------------------


def test_cost_and_clearance_over_whole_episodes() -> None:
    """Against 200 samples within each step, from nothing but the observations and actions."""
    env, share, costs = make(n_obstacles=2), np.linspace(0, 0.1, 200), []
    for seed in range(6):
        for r in drive(env, seed):
            discs = r["obs"]["obstacle"].reshape(2, 5)
            vehicle = geometry.unicycle(
                np.tile(r["obs"]["observation"], (200, 1)), np.tile(r["action"], (200, 1)), share
            )[:, :2]
            centers = discs[:, :2] + share[:, None, None] * discs[:, 2:4]
            sampled = (np.linalg.norm(vehicle[:, None] - centers, axis=-1) - discs[:, 4] - 0.5).min()
            info = r["info"]
            assert info["clearance"] == pytest.approx(sampled, abs=1e-3)
            assert info["cost"] == float(info["clearance"] < 0)
            costs.append(info["cost"])
    assert 0 < np.mean(costs) < 1


def world(state: list[float], disc: list[float], goal: list[float]) -> World:
    """One hand-made scene: vehicle (x, y, θ), disc (x, y, vx, vy, r), goal."""
    here, there, ball = (np.array([part], dtype=float) for part in (state, goal, [disc]))
    return World(here, there, ball, key=np.array([1]), step=np.array([0]))


def test_a_graze_between_two_clear_instants_costs() -> None:
    """A quick vehicle cuts the corner of a disc: clear before and after the step, in collision between."""
    params = replace(PARAMS, v_max=25.0, omega_max=10.0)
    before = world([-1.25, 0, 0], [0, 1.49, 0, 0, 1.0], [9, 9])
    env = make(params=params)
    env.world = before
    *_, info = env.step([25.0, 0.0])
    for instant in (before, env.world):
        distance = np.linalg.norm(instant.position[0, 0] - instant.state[0, :2])
        assert distance > instant.radius[0, 0] + params.robot_radius
    assert info["clearance"] == pytest.approx(-0.01)
    assert info["cost"] == 1.0


@pytest.mark.parametrize("discs", [0, 2])
def test_a_scene_must_have_the_environments_number_of_discs(discs: int) -> None:
    env, scene = make(), world([0, 0, 0], [1.6, 0, 0, 0, 1.0], [9, 9])
    scene.disc = np.repeat(scene.disc, discs, axis=1)
    with pytest.raises(ValueError, match="disc"):
        env.world = scene


@pytest.mark.parametrize("ends", [False, True])
def test_collision_ends_the_episode_only_if_asked(ends: bool) -> None:
    env = make(terminate_on_collision=ends)
    env.world = world([0, 0, 0], [1.6, 0, 0, 0, 1.0], [9, 9])
    _, _, terminated, truncated, info = env.step([2.5, 0.0])
    assert (terminated, truncated, info["cost"], info["is_success"]) == (ends, False, 1.0, False)


def test_reaching_the_goal_ends_the_episode() -> None:
    env = make()
    env.world = world([0, 0, 0], [-9, -9, 0, 0, 1.0], [0.95, 0])
    _, reward, terminated, _, info = env.step([1.9, 0.0])
    assert not terminated and not info["is_success"]  # 0.76 m away
    assert reward == pytest.approx(0.19 / 0.75)
    _, reward, terminated, _, info = env.step([0.2, 0.0])
    assert terminated and info["is_success"]  # 0.74 m away
    assert reward == pytest.approx(0.02 / 0.75 + 1)


def test_episodes_last_200_steps_at_most() -> None:
    env = gym.make("RISE-GroundVehicle-v0")
    env.reset(seed=0)
    ends = [env.step(np.zeros(2, np.float32))[3] for _ in range(200)]
    assert ends == [False] * 199 + [True]


def test_dense_rewards_add_up_to_the_way_travelled() -> None:
    for seed in range(5):
        records = drive(make(), seed)
        assert records[-1]["terminated"]
        first, last = records[0]["obs"], records[-1]["next"]
        way = [np.linalg.norm(o["desired_goal"] - o["achieved_goal"]) for o in (first, last)]
        assert sum(r["reward"] for r in records) == pytest.approx((way[0] - way[1]) / 0.75 + 1)
        sparse = [r["reward"] for r in drive(make(reward_type="sparse"), seed)]
        assert sparse == [-1.0] * (len(records) - 1) + [0.0]


def test_info_of_the_reset() -> None:
    env = make()
    observation, info = env.reset(seed=11)
    disc = observation["obstacle"]
    instant = np.linalg.norm(disc[:2] - observation["achieved_goal"]) - disc[4] - 0.5
    assert info["cost"] == 0.0 and info["clearance"] == pytest.approx(instant)
    np.testing.assert_array_equal(info["previous_achieved_goal"], observation["achieved_goal"])


# --- arguments --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_obstacles", [0, -1, 1.5])
def test_number_of_obstacles_is_checked(n_obstacles: Any) -> None:
    with pytest.raises(ValueError, match="n_obstacles"):
        make(n_obstacles=n_obstacles)


@pytest.mark.parametrize("n_obstacles", [1, 3, 12])
def test_number_of_obstacles_shapes_the_readings(n_obstacles: int) -> None:
    env = make(n_obstacles=n_obstacles)
    observation, _ = env.reset(seed=0)
    assert observation["obstacle"].shape == (5 * n_obstacles,)
    assert observation in env.observation_space
    assert env.noise_scale["obstacle"].tolist() == [1.0] * 5 * n_obstacles
    assert env.task(n_obstacles=n_obstacles).noise_scale == (1.0,) * 5 * n_obstacles


@pytest.mark.parametrize(
    "wrong",
    [
        {"dt": 0.0},
        {"dt": np.nan},
        {"v_max": np.inf},
        {"v_min": 3.0},
        {"robot_radius": -0.5},
        {"goal_distance": (20.0, 12.5)},
        {"goal_distance": (0.5, 12.5)},
        {"obstacle_radius": (-1.0, 2.0)},
        {"redraw_interval": 0.0},
    ],
)
def test_parameters_are_checked(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        replace(PARAMS, **wrong)


def test_parameters_reach_the_task() -> None:
    params = replace(PARAMS, v_min=-1.0, v_max=1.0, obstacle_speed=0.0, goal_radius=2.0)
    env = make(params=params)
    env.reset(seed=0)
    assert env.action_space.low.tolist() == [-1.0, -1.5]
    assert env.task(params=params).goal_radius == 2.0
    before = env.world
    after = env.step([-1.0, 0.0])[0]
    assert (after["obstacle"][:2] == before.position[0, 0]).all()
    heading = before.state[0, 2]
    np.testing.assert_allclose(
        after["achieved_goal"], before.state[0, :2] - 0.1 * np.array([np.cos(heading), np.sin(heading)])
    )


def test_pose_of_the_task_is_the_vehicles_frame() -> None:
    state = starts(50).state
    position, rotation = make().task().pose(state)
    np.testing.assert_array_equal(position, state[:, :2])
    np.testing.assert_allclose(
        rotation @ np.swapaxes(rotation, 1, 2), np.tile(np.eye(2), (50, 1, 1)), atol=1e-15
    )
    forward = geometry.unicycle(state, np.tile([1.0, 0.0], (50, 1)), 1.0)[:, :2] - position
    np.testing.assert_allclose(rotation[..., 0], forward, atol=1e-12)


def test_observe_copies() -> None:
    w = starts(3)
    for array in observe(w).values():
        array[:] = 0
    assert (w.state != 0).any() and (w.goal != 0).any() and (w.position != 0).any()
