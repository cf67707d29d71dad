"""What every registered environment keeps, whichever it is: a new one is tested by its registry line."""

from __future__ import annotations

import copy
import functools
import pickle
import warnings
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import RescaleAction

import rise_envs
from rise_envs.task import task_of
from rise_envs.testing import CHECKS
from rise_envs.testing.any_env import WISH
from rise_envs.testing.goal_env import wrong_actions
from rise_envs.testing.subject import Subject, actions, assert_same, record_batch

SEEDS = range(100)


@pytest.fixture(params=list(rise_envs.ENVS))
def env_id(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def env(env_id: str) -> Iterator[gym.Env]:
    made = gym.make(env_id)
    yield made
    made.close()


@pytest.fixture
def twin(env_id: str) -> Iterator[gym.Env]:
    made = gym.make(env_id)
    yield made
    made.close()


@functools.cache
def subject(env_id: str) -> Subject:
    """Each environment, with the records of its first 100 episodes, which are made once."""
    return Subject(env_id, len(SEEDS))


@pytest.mark.parametrize("check", CHECKS)
def test_contract(env_id: str, check: str) -> None:
    CHECKS[check].run(subject(env_id))


# --- the checkers of Gymnasium and Stable-Baselines3 ------------------------------------------------------


class Scaled(RescaleAction):
    """Actions in [−1, 1], and the goal API where Stable-Baselines3's checker looks for it."""

    def __init__(self, env: Any) -> None:
        super().__init__(env, np.float32(-1), np.float32(1))
        self.compute_reward = env.unwrapped.compute_reward


def complaints(check: Any, env: Any) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check(env)
    return [str(w.message) for w in caught]


def is_normalised(env: Any) -> bool:
    return env.action_space == spaces.Box(-1, 1, env.action_space.shape, np.float32)


def test_stable_baselines_check_env(env: Any) -> None:
    from stable_baselines3.common.env_checker import check_env as check_env_sb3

    bare = complaints(check_env_sb3, env.unwrapped)
    assert [m for m in bare if is_normalised(env) or WISH not in m] == []
    assert complaints(check_env_sb3, Scaled(env)) == []


def test_stable_baselines_makes_batches(env_id: str) -> None:
    """It asks for pictures first, and makes an environment that refuses the argument without them."""
    from stable_baselines3.common.env_util import make_vec_env

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*render_mode='rgb_array' that is not in the possible")
        envs = make_vec_env(env_id, 2, seed=3, wrapper_class=rise_envs.ObservationNoise)
    twin = rise_envs.VectorObservationNoise(gym.make_vec(env_id, 2, vectorization_mode="sync"))
    np.testing.assert_equal(envs.reset(), twin.reset(seed=3)[0])
    envs.close(), twin.close()


# --- replay -----------------------------------------------------------------------------------------------


def test_replay_in_processes(env_id: str) -> None:
    # Fresh processes, not forks of this one with its threads.
    env = gym.make_vec(env_id, 2, vectorization_mode="async", vector_kwargs={"context": "spawn"})
    for i in range(0, len(SEEDS), 2):
        for made, single in zip(
            record_batch(env, [i, i + 1]), subject(env_id).records[i : i + 2], strict=True
        ):
            assert_same(made, single)
    env.close()


# --- misuse -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wrong", list(wrong_actions((2,))))
def test_refused_actions_change_nothing(env: Any, twin: Any, wrong: str) -> None:
    action = wrong_actions(env.action_space.shape)[wrong]
    env.reset(seed=2), twin.reset(seed=2)
    for _ in range(2):
        with pytest.raises(ValueError, match="action"):
            env.unwrapped.step(action)
        good = actions(env.action_space, 2, 1)[0]
        a, b = env.step(good), twin.step(good)
        for key in a[0]:
            np.testing.assert_array_equal(a[0][key], b[0][key])
        assert a[1] == b[1]


def test_unknown_arguments_are_named(env_id: str) -> None:
    with pytest.raises(ValueError, match="shaped"):
        gym.make(env_id, reward_type="shaped")
    with pytest.raises(TypeError, match="gravity"):
        gym.make(env_id, gravity=3)


# --- goals ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("reward_type", ["dense", "sparse"])
def test_hindsight_replay_of_stable_baselines(env_id: str, reward_type: str) -> None:
    """SAC learns a little with SB3's HER buffer, whose relabelled rewards are those of the new goals."""
    from stable_baselines3 import SAC, HerReplayBuffer

    env = gym.make(env_id, reward_type=reward_type, max_episode_steps=20)
    model = SAC(
        "MultiInputPolicy",
        RescaleAction(env, np.float32(-1), np.float32(1)),
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"copy_info_dict": reward_type == "dense"},
        learning_starts=45,
        batch_size=32,
        buffer_size=1000,
        policy_kwargs={"net_arch": [16]},
        seed=0,
        device="cpu",
    )
    model.learn(60)
    assert model.replay_buffer is not None
    sample: Any = model.replay_buffer.sample(400)
    goal = sample.observations["desired_goal"]
    gap = np.linalg.norm((sample.next_observations["achieved_goal"] - goal).numpy(), axis=-1)
    before = np.linalg.norm((sample.observations["achieved_goal"] - goal).numpy(), axis=-1)
    radius = task_of(env_id).goal_radius
    reached = gap <= radius
    assert 0.05 < reached.mean() < 1
    expected = reached - 1.0 if reward_type == "sparse" else (before - gap) / radius + reached
    np.testing.assert_allclose(sample.rewards.numpy()[:, 0], expected, atol=1e-4)
    env.close()


def pickled(env: Any) -> Any:
    return pickle.loads(pickle.dumps(env))


@pytest.mark.parametrize("copied", [copy.deepcopy, pickled])
@pytest.mark.parametrize("env_id", [each for each in rise_envs.ENVS if each != "RISE-SafePanda-v0"])
def test_a_copy_goes_on_as_its_original(env_id: str, copied: Any) -> None:
    """But for the arm whose state is the engine's."""
    env = rise_envs.ObservationNoise(gym.make(env_id), "step+delay:2")
    env.reset(seed=4)
    doings = actions(env.action_space, 0)
    for action in doings[:3]:
        env.step(action)
    twin = copied(env)
    theirs = [twin.step(action) for action in doings] + [twin.reset()]
    np.testing.assert_equal([env.step(action) for action in doings] + [env.reset()], theirs)
