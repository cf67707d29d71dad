"""The kinematic arm's task against Bullet's: the same scenarios, and starts that keep the engine's promise."""

from __future__ import annotations

from collections.abc import Iterator

import gymnasium as gym
import numpy as np
import pytest

import rise_envs
from rise_envs import panda_starts
from rise_envs.panda_scene import DEFAULTS, START_HAND, Params
from rise_envs.panda_sim import PandaSim
from rise_envs.safe_panda import SafePandaEnv
from rise_envs.safe_panda_kinematic import SafePandaKinematicEnv

MODEL, BULLET = "RISE-SafePandaKinematic-v0", "RISE-SafePanda-v0"


@pytest.fixture(scope="module")
def bullet() -> Iterator[SafePandaEnv]:
    env = SafePandaEnv()
    yield env
    env.close()


@pytest.fixture(scope="module")
def sim() -> Iterator[PandaSim]:
    made = PandaSim()
    yield made
    made.close()


def test_it_stands_in_for_an_environment_with_the_same_spaces_and_task(bullet: SafePandaEnv) -> None:
    assert rise_envs.STAND_INS[MODEL] == BULLET and set(rise_envs.STAND_INS) <= set(rise_envs.ENVS)
    env = SafePandaKinematicEnv()
    assert env.observation_space == bullet.observation_space and env.action_space == bullet.action_space
    assert env.task() == bullet.task()


def test_a_seed_names_the_same_scenario_in_both(bullet: SafePandaEnv) -> None:
    """Goal, sphere and its motion to the last bit, in seeded episodes and in those that follow."""
    env = SafePandaKinematicEnv()
    for seed in (0, 1, None, None, 2**40, None):
        (a, info_a), (b, info_b) = env.reset(seed=seed), bullet.reset(seed=seed)
        assert info_a.keys() == info_b.keys()
        assert info_a["clearance"] == pytest.approx(info_b["clearance"], abs=0.012)
        for _ in range(50):
            for key in ("desired_goal", "obstacle"):
                np.testing.assert_array_equal(a[key], b[key])
            np.testing.assert_allclose(a["achieved_goal"], b["achieved_goal"], atol=0.01)
            way = a["desired_goal"] - b["achieved_goal"]
            action = np.clip(way / 0.05, -1, 1).astype(np.float32)
            a, _, _, _, info_a = env.step(action)
            b, _, _, _, info_b = bullet.step(action)
            assert info_a.keys() == info_b.keys()
            if info_b["clearance"] < 0.1:
                assert info_a["clearance"] == pytest.approx(info_b["clearance"], abs=0.02)


def test_capsules_underestimate_no_clearance_by_more_than_their_margin(sim: PandaSim) -> None:
    """In the neutral pose, wherever a start may have its sphere: what the promise of 4 cm rests on."""
    sim.reset()
    rng = np.random.default_rng(0)
    centers = rng.uniform(DEFAULTS.sphere_low, DEFAULTS.sphere_high, (30_000, 3))
    capsules = panda_starts._CAPSULES
    found = np.array([panda_starts._nearest(*center, capsules)[0] for center in centers])
    near = (found > 0.085) & (found < 0.18)
    engine = np.array([sim.clearance(center, 0.0)[0] for center in centers[near]])
    assert near.sum() > 3000
    assert (found[near] - engine).max() < panda_starts._CAPSULE_ERROR


def test_starts_do_not_depend_on_the_batch_and_are_as_documented() -> None:
    constants = panda_starts.constants(DEFAULTS)
    keys = np.random.default_rng(1).integers(-(2**63), 2**63, 3000)
    goal, sphere, motion, clearance, _ = panda_starts.begin(keys, constants)
    for i in (0, 1500, 2999):
        alone = panda_starts.begin(keys[i : i + 1], constants)
        for whole, one in zip((goal, sphere, motion, clearance), alone, strict=False):
            np.testing.assert_array_equal(whole[i : i + 1], one)
    center, velocity, radius = sphere[:, :3], sphere[:, 3:6], sphere[:, 6]
    way, hand = goal - START_HAND, np.array(START_HAND)
    assert (np.linalg.norm(way, axis=1) >= 0.25).all()
    assert (np.hypot(np.hypot(goal[:, 0] + 0.6, goal[:, 1]) - 0.088, goal[:, 2] - 0.121) <= 0.70).all()
    assert (np.linalg.norm(center - goal, axis=1) >= radius + 0.12).all()
    assert (clearance >= 0.045 + 0.2 * np.linalg.norm(velocity, axis=1) - 1e-12).all()
    assert radius.min() < 0.051 and radius.max() > 0.099
    assert (np.linalg.norm(velocity, axis=1) <= 0.15).all()
    share = np.einsum("bi,bi->b", center - hand, way) / (way**2).sum(1)
    assert 0.45 < share.mean() < 0.65
    spread = np.ptp(goal, axis=0)
    assert (spread > 0.95 * np.array([0.5, 0.8, 0.45])).all()


def test_parameters_without_room_are_refused() -> None:
    for env in (
        SafePandaKinematicEnv(params=Params(goal_gap=2.0)),
        gym.make_vec(MODEL, 2, params=Params(goal_gap=2.0)),
    ):
        with pytest.raises(ValueError, match="room"):
            env.reset(seed=0)


def test_a_collision_is_named_and_ends_the_episode_if_asked_to() -> None:
    params = Params(start_clearance=-1.0, max_offset=0.0, placed=(0.0, 0.0))  # the sphere starts in the hand
    env = SafePandaKinematicEnv(terminate_on_collision=True, params=params)
    _, info = env.reset(seed=0)
    assert info["cost"] == 1.0 and info["clearance"] < 0 and "finger" in info["collision_link"]
    *_, terminated, truncated, info = env.step(np.zeros(3))
    assert (terminated, truncated, info["cost"]) == (True, False, 1.0)
    assert "finger" in info["collision_link"]


def test_there_are_no_pictures() -> None:
    with pytest.raises(TypeError, match=r"no pictures.*RISE-SafePanda-v0"):
        SafePandaKinematicEnv(render_mode="rgb_array")
    assert SafePandaKinematicEnv().render_mode is None
