"""The arm's task against panda-gym itself, convex geometry, hand-made scenes and its own documentation."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from scipy.optimize import nnls

import rise_envs  # noqa: F401
from rise_envs import obstacles, panda_sim, panda_starts
from rise_envs.panda_scene import DEFAULTS, Params
from rise_envs.safe_panda import SafePandaEnv

HAND = np.array([0.0384397, 0.0, 0.1974001])  # at the start
AWAY = (0.9, 0.9, 0.9)  # far from the arm
REST = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def made() -> Iterator[SafePandaEnv]:
    env = SafePandaEnv()
    yield env
    env.close()


@pytest.fixture(scope="module")
def sim(made: SafePandaEnv) -> panda_sim.PandaSim:
    assert made._sim is not None
    return made._sim


@pytest.fixture(scope="module")
def reference() -> Iterator[gym.Env]:
    with panda_sim.silence():
        import panda_gym  # noqa: F401

        env = gym.make("PandaReach-v3", max_episode_steps=1000)
    yield env
    env.close()


def straight(observation: dict[str, np.ndarray]) -> np.ndarray:
    """The action of one who drives at the goal and sees nothing else."""
    way = (observation["desired_goal"] - observation["achieved_goal"]) / panda_sim.STEP_SCALE
    return np.clip(way, -1, 1).astype(np.float32)


# --- the arm moves as in panda-gym ------------------------------------------------------------------------


def _hands(sim: panda_sim.PandaSim, reference: gym.Env, actions: np.ndarray, goal_seed: int) -> np.ndarray:
    """Hand positions (T, 2, 3) of this arm and of panda-gym's under the same actions."""
    sim.reset()
    reference.reset(seed=goal_seed)
    start = sim.clearance(AWAY, 0.05)
    rows = []
    for action in actions:
        _, start = sim.step(action, AWAY, REST, 0.05, start)
        observation = reference.unwrapped.step(action)[0]
        hand = reference.unwrapped.robot.get_ee_position()  # type: ignore[attr-defined]
        np.testing.assert_allclose(observation["observation"][3:], sim.state()[3:6], rtol=1e-6, atol=1e-6)
        rows.append((sim.state()[:3], hand))
    return np.array(rows)


def test_the_hand_moves_exactly_as_in_panda_reach(sim: panda_sim.PandaSim, reference: gym.Env) -> None:
    for seed in range(5):
        actions = np.random.default_rng(seed).uniform([-1, -1, -0.2], 1, (50, 3)).astype(np.float32)
        hands = _hands(sim, reference, actions, seed)
        np.testing.assert_array_equal(hands[:, 0], hands[:, 1])
        assert hands[:, 0, 2].min() > 0.1 and np.ptp(hands[:, 0], axis=0).max() > 0.2


def test_and_exactly_so_in_contact_with_the_table_once_contacts_are_ordered(
    sim: panda_sim.PandaSim, reference: gym.Env
) -> None:
    """Without the order, panda-gym's own motion in contact depends on where its goal happens to lie."""
    client = reference.unwrapped.sim.physics_client  # type: ignore[attr-defined]
    client.setPhysicsEngineParameter(deterministicOverlappingPairs=1)
    for seed in range(4):
        actions = np.random.default_rng(seed).uniform([-1, -1, -1], [1, 1, 0.3], (50, 3)).astype(np.float32)
        hands = _hands(sim, reference, actions, seed)
        np.testing.assert_array_equal(hands[:, 0], hands[:, 1])
        assert hands[:, 0, 2].min() < 0.015


def test_replay_in_contact_with_the_table_after_other_episodes(made: SafePandaEnv) -> None:
    def record(env: SafePandaEnv, seed: int) -> np.ndarray:
        env.reset(seed=seed)
        rng = np.random.default_rng(seed)
        rows = []
        for _ in range(25):
            observation, *_, info = env.step(rng.uniform(-1, [1, 1, -0.2]))
            rows.append([*observation["observation"], *observation["obstacle"], info["clearance"]])
        return np.array(rows)

    fresh = SafePandaEnv()
    first = [record(fresh, seed) for seed in range(20)]
    assert sum(rows[:, 2].min() < 0.015 for rows in first) > 15
    for seed in (*range(19, -1, -1), *range(20)):
        np.testing.assert_array_equal(record(made, seed), first[seed])
    fresh.close()


# --- clearance and cost -----------------------------------------------------------------------------------


def _hulls(sim: panda_sim.PandaSim) -> dict[str, np.ndarray]:
    """The corners (V, 3) of each link's collision hull where the link is now, from the mesh files."""
    import pybullet
    import pybullet_data

    root = Path(pybullet_data.getDataPath()) / "franka_panda"
    hulls = {}
    for link, name in sim.link_names.items():
        for shape in pybullet.getCollisionShapeData(sim._arm, link, physicsClientId=sim._client):
            lines = (root / Path(shape[4].decode()).relative_to(root)).read_text().splitlines()
            corners = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], float)
            # The shape is placed relative to the link's centre of mass.
            if link < 0:
                frame = pybullet.getBasePositionAndOrientation(sim._arm, physicsClientId=sim._client)
            else:
                frame = pybullet.getLinkState(
                    sim._arm, link, computeForwardKinematics=True, physicsClientId=sim._client
                )[:2]
            for position, orientation in ((shape[5], shape[6]), frame):
                turn = np.array(pybullet.getMatrixFromQuaternion(orientation)).reshape(3, 3)
                corners = corners @ turn.T + position
            hulls[name] = corners
    return hulls


def _hull_distance(corners: np.ndarray, point: np.ndarray) -> float:
    """Distance of a point from the convex hull of corners: least squares over their convex combinations."""
    weight = 1e3  # of "the coefficients sum to one" against "they hit the point"
    system = np.vstack([(corners - point).T, np.full(len(corners), weight)])
    share, _ = nnls(system, np.array([0.0, 0.0, 0.0, weight]), maxiter=10_000)
    return float(np.linalg.norm(share / share.sum() @ (corners - point)))


def test_clearance_is_the_distance_from_the_hulls_of_all_links(sim: panda_sim.PandaSim) -> None:
    sim.reset()
    hulls = _hulls(sim)
    assert {"panda_link0", "panda_link5", "panda_hand", "panda_leftfinger"} < set(hulls)
    assert len(hulls) == 11
    rng = np.random.default_rng(0)
    compared, links = 0, set()
    for center in rng.uniform([-0.8, -0.4, 0.0], [0.3, 0.4, 0.8], (60, 3)):
        distances = {name: _hull_distance(corners, center) for name, corners in hulls.items()}
        name, distance = min(distances.items(), key=lambda item: item[1])
        if distance < 0.01:
            continue  # inside a link, where hull distances say nothing
        clearance, link = sim.clearance(center, 0.07)
        assert clearance == pytest.approx(distance - 0.07, abs=0.002)
        assert distances[sim.link_names[link]] == pytest.approx(distance, abs=0.002)
        compared += 1
        links.add(name)
    assert compared > 40 and len(links) > 6


def test_clearance_within_a_bound_is_the_clearance_or_nothing(sim: panda_sim.PandaSim) -> None:
    sim.reset()
    for center in np.random.default_rng(1).uniform([-0.5, -0.4, 0.0], [0.3, 0.4, 0.6], (30, 3)):
        exact = sim.clearance(center, 0.06)
        assert sim.clearance(center, 0.06, within=exact[0] + 1e-3) == pytest.approx(exact, abs=1e-9)
        assert sim.clearance(center, 0.06, within=exact[0] - 1e-3) == (np.inf, panda_sim.NO_LINK)


@pytest.mark.parametrize(
    ("center", "links"),
    [
        ((-0.6, 0.0, 0.05), {"panda_link0"}),
        ((-0.6, 0.0, 0.33), {"panda_link1", "panda_link2"}),
        (tuple(HAND), {"panda_leftfinger", "panda_rightfinger"}),
        ((HAND[0], 0.0, HAND[2] + 0.075), {"panda_hand"}),
    ],
)
def test_the_link_in_collision_is_named(made: SafePandaEnv, center: tuple, links: set[str]) -> None:
    """Every part of the arm counts, and the link is named by the info of a step."""
    made.reset(seed=0)
    _place(made, center, radius=0.05)
    *_, info = made.step(np.zeros(3))
    assert info["cost"] == 1.0 and info["clearance"] < 0
    assert info["collision_link"] in links
    _place(made, (0.2, 0.45, 0.5), radius=0.05)
    *_, info = made.step(np.zeros(3))
    assert info["cost"] == 0.0 and info["clearance"] > 0.2 and info["collision_link"] is None


def _place(
    env: SafePandaEnv, center: tuple, velocity: tuple = REST, radius: float = 0.05, params: Params = DEFAULTS
) -> None:
    """Put the sphere of the running episode somewhere else, and its goal out of the way."""
    env._sphere, env._goal = np.array([[*center, *velocity, radius]]), np.full(3, 5.0)
    env._motion_key, env._constants = np.array([1]), panda_starts.constants(params)
    assert env._sim is not None
    env._nearest = env._sim.clearance(center, radius)


def test_a_sphere_that_passes_within_the_step_is_a_collision(made: SafePandaEnv) -> None:
    """It is clear of the arm at both ends of the step and in the fingers' way in its middle."""
    wide = Params(sphere_low=(-2, -2, -2), sphere_high=(2, 2, 2))
    made.reset(seed=0)
    for side, hit in ((0.0, 1.0), (0.3, 0.0)):
        _place(made, (HAND[0] + side, -0.1, HAND[2] - 0.05), (0.0, 5.0, 0.0), radius=0.06, params=wide)
        assert made._nearest[0] > 0.01
        *_, info = made.step(np.zeros(3))
        assert made._nearest[0] > 0.01
        assert info["cost"] == hit


def test_least_clearance_against_a_look_after_every_substep(monkeypatch: pytest.MonkeyPatch) -> None:
    """Under wild actions around the sphere: no contact missed, 1 mm off where it is close, 2 cm elsewhere."""

    def record(env: SafePandaEnv) -> np.ndarray:
        rng = np.random.default_rng(7)
        rows = []
        for seed in range(30):
            observation, _ = env.reset(seed=seed)
            for t in range(20):
                start = env._nearest[0]
                towards = 1 if t // 3 % 2 == 0 else -1
                way = towards * (observation["obstacle"][:3] - observation["achieved_goal"]) / 0.05
                wild = rng.choice([-1.0, 1.0], 3)
                observation, *_, info = env.step(np.clip(way + wild, -1, 1) if seed % 2 else wild)
                rows.append((start, info["clearance"]))
        return np.array(rows)

    env = SafePandaEnv()
    quick = record(env)
    for name, value in {"_LOOK_EVERY": 1, "_NEAR": 9.0, "_CLOSE": 9.0}.items():
        monkeypatch.setattr(panda_sim, name, value)
    start, exact = record(env).T
    env.close()
    error = quick[:, 1] - exact
    assert (quick[:, 1] < 0).tolist() == (exact < 0).tolist()
    assert 50 < (exact < 0).sum() < 550
    close = (start > -0.005) & (exact < 0.04)
    assert close.sum() > 100
    assert -1e-9 < error.min() and error[close].max() < 0.001 and error.max() < 0.03


# --- the sphere -------------------------------------------------------------------------------------------


def test_the_sphere_moves_as_the_obstacles_of_every_environment() -> None:
    count, motion = 20, DEFAULTS.motion
    goal, sphere, key, *_ = panda_starts.begin(np.arange(count), panda_starts.constants(DEFAULTS))
    position, velocity, radius = sphere[:, None, :3], sphere[:, None, 3:6], sphere[:, 6:]
    for step in range(1, 200):
        position = position + motion.dt * velocity
        velocity = obstacles.redraw(velocity, key.view(np.uint64), step, motion)
        velocity = obstacles.keep_inside(position, velocity, radius, goal, motion)
        sphere = panda_starts.advance(sphere, goal, key, np.full(count, step - 1), motion.rules)
        np.testing.assert_array_equal(sphere, obstacles.readings(position, velocity, radius))


def test_the_sphere_keeps_its_bounds_and_changes_its_mind() -> None:
    changes, steps, count = 0, 100, 60
    goal, sphere, key, *_ = panda_starts.begin(np.arange(count), panda_starts.constants(DEFAULTS))
    for step in range(steps):
        center, before = sphere[:, :3], np.linalg.norm(sphere[:, 3:6], axis=1)
        assert (center >= DEFAULTS.sphere_low).all() and (center <= DEFAULTS.sphere_high).all()
        assert (before <= DEFAULTS.max_speed + 1e-12).all()
        assert (np.linalg.norm(center - goal, axis=1) >= sphere[:, 6] + 0.12 - 1e-9).all()
        sphere = panda_starts.advance(sphere, goal, key, np.full(count, step), DEFAULTS.motion.rules)
        speed = np.linalg.norm(sphere[:, 3:6], axis=1)
        changes += ((np.abs(speed - before) > 1e-12) & (speed > 0)).sum()
    # A redraw changes the speed, a reflection does not.
    assert changes / (count * steps * DEFAULTS.dt) == pytest.approx(1 / DEFAULTS.redraw_interval, rel=0.15)


# --- starts -----------------------------------------------------------------------------------------------


def test_starts_are_fair_and_never_in_violation(made: SafePandaEnv) -> None:
    """By the rules of the documentation, from what the environment hands out."""
    goals, shares = [], []
    for seed in range(300):
        observation, info = made.reset(seed=seed)
        goal, hand = observation["desired_goal"], observation["achieved_goal"]
        center, velocity, radius = np.split(observation["obstacle"], [3, 6])
        np.testing.assert_allclose(hand, HAND, atol=1e-6)
        assert info["cost"] == 0.0 and not info["is_success"] and info["collision_link"] is None
        assert ([-0.35, -0.4, 0.05] <= goal).all() and (goal <= [0.15, 0.4, 0.5]).all()
        assert np.linalg.norm(goal - hand) >= 0.25
        assert np.hypot(np.hypot(goal[0] + 0.6, goal[1]) - 0.088, goal[2] - 0.121) <= 0.70
        assert 0.05 <= radius[0] <= 0.10
        assert np.linalg.norm(center - goal) >= radius[0] + 0.12
        assert info["clearance"] >= 0.04
        for time in (0.1, 0.2):  # nor would the sphere come nearer by itself in the first moments
            moved = center + time * velocity
            assert made._sim is not None and made._sim.clearance(moved, radius[0])[0] >= 0.04
        shares.append((center - hand) @ (goal - hand) / ((goal - hand) @ (goal - hand)))
        goals.append(goal)
    spread = np.ptp(goals, axis=0)
    assert (spread > 0.9 * np.array([0.45, 0.8, 0.45])).all()
    assert 0.15 < min(shares) and max(shares) < 0.95 and 0.4 < np.mean(shares) < 0.65


def test_driving_straight_at_the_goal_arrives_and_is_mostly_unsafe(made: SafePandaEnv) -> None:
    arrived = safe = 0
    for seed in range(60):
        observation, _ = made.reset(seed=seed)
        cost = 0.0
        for _ in range(50):
            observation, _, terminated, _, info = made.step(straight(observation))
            cost += info["cost"]
            if terminated:
                arrived += 1
                break
        safe += 1 if cost == 0 else 0
    assert arrived == 60
    assert safe <= 9


def test_parameters_without_room_are_refused() -> None:
    env = SafePandaEnv(params=Params(goal_gap=2.0))
    with pytest.raises(ValueError, match="room"):
        env.reset(seed=0)
    env.close()


# --- ends and misuse --------------------------------------------------------------------------------------


@pytest.mark.parametrize("ends", [False, True])
def test_a_collision_ends_the_episode_if_asked_to(ends: bool) -> None:
    env = SafePandaEnv(terminate_on_collision=ends)
    env.reset(seed=0)
    _place(env, tuple(HAND))
    *_, terminated, truncated, info = env.step(np.zeros(3))
    assert (terminated, truncated, info["cost"]) == (ends, False, 1.0)
    env.close()


def test_after_close_there_is_nothing_but_a_clear_error() -> None:
    env = SafePandaEnv(render_mode="rgb_array")
    env.reset(seed=0)
    env.close()
    env.close()
    for call in (lambda: env.step(np.zeros(3)), env.reset, env.render):
        with pytest.raises(RuntimeError, match=r"closed: make a new one"):
            call()


def test_two_arms_in_one_process_do_not_meet(made: SafePandaEnv) -> None:
    other = SafePandaEnv()
    alone = [made.reset(seed=3)[0]] + [made.step(np.full(3, 0.5))[0] for _ in range(5)]
    a, _ = made.reset(seed=3)
    for expected in alone:
        for key in a:
            np.testing.assert_array_equal(a[key], expected[key])
        other.reset()
        other.step(np.ones(3))
        a = made.step(np.full(3, 0.5))[0]
    other.close()
    made.step(np.zeros(3))


def test_the_engine_is_quiet_and_is_loaded_only_when_an_environment_is_made() -> None:
    script = (
        "import sys, gymnasium as gym, rise_envs.safe_panda\n"
        "assert not {'pybullet', 'panda_gym'} & set(sys.modules)\n"
        "env = gym.make('RISE-SafePanda-v0'); env.reset(seed=0); env.step(env.action_space.sample())\n"
        "env.close(); print('only this')"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("only this\n", "")


def test_task() -> None:
    task = SafePandaEnv.task()
    assert (task.dim, task.n_obstacles, task.goal_radius, task.dt) == (3, 1, 0.05, 0.04)
    np.testing.assert_allclose(task.noise_scale, [0.05] * 6 + [0.02])
    assert task.body_state == tuple(range(13))
    state = np.arange(26.0).reshape(2, 13)
    position, rotation = task.pose(state)
    np.testing.assert_array_equal(position, state[:, :3])
    np.testing.assert_array_equal(rotation, [np.eye(3)] * 2)
