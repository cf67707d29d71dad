"""The wrappers, unchanged, on environments of other projects."""

from __future__ import annotations

import importlib
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from numpy.testing import assert_array_equal, assert_equal

from rise_envs.cost import CostFromTuple, CostToTuple, RequireCost
from rise_envs.noise_wrappers import ObservationNoise, VectorObservationNoise

# id, the module that registers it, what is noised, and its scale per channel
CARTPOLE = ("CartPole-v1", None, None, [0.1, 0.5, 0.02, 0.5])
PARKING = ("parking-v0", "highway_env", "observation", 0.05)
FETCH = ("FetchReach-v4", "gymnasium_robotics", "observation", 0.01)
ELSEWHERE = pytest.mark.parametrize(
    ("env_id", "module", "keys", "scale"),
    [CARTPOLE, PARKING, FETCH],
    ids=lambda x: x if "-v" in str(x) else "",
)


def make(env_id, module):
    if module is not None:
        gym.register_envs(importlib.import_module(module))
    return gym.make(env_id)


def noised(observation, keys):
    return observation if keys is None else observation[keys]


def play(env, n_steps):
    """Observations and infos under fixed actions."""
    observation, info = env.reset(seed=11)
    log = [(observation, info)]
    env.action_space.seed(0)
    for _ in range(n_steps):
        observation, _, terminated, truncated, info = env.step(env.action_space.sample())
        log.append((observation, info))
        if terminated or truncated:
            break
    return log


@ELSEWHERE
def test_noise_of_the_stated_size_on_what_is_named_only(env_id, module, keys, scale):
    env = ObservationNoise(make(env_id, module), "step", keys=keys, noise_level=0.5, noise_scale=scale)
    errors = []
    for episode in range(8):
        log = play(env, 25) if episode == 0 else [env.reset()]
        for observation, info in log:
            assert env.observation_space.contains(observation)
            clean = info["clean_observation"]
            part = noised(observation, keys)
            assert part.dtype == noised(env.env.observation_space, keys).dtype
            errors.append((part - noised(clean, keys)) / (0.5 * np.asarray(scale)))
            for goal in ("desired_goal", "achieved_goal") if keys else ():
                assert_array_equal(observation[goal], clean[goal])
    errors = np.ravel(errors)
    assert abs(errors.mean()) < 4.5 / np.sqrt(len(errors))
    assert abs(errors.std() - 1) < 4.5 / np.sqrt(2 * len(errors))
    env.close()


@ELSEWHERE
def test_the_environment_moves_as_without_the_wrapper(env_id, module, keys, scale):
    bare = make(env_id, module)
    env = ObservationNoise(make(env_id, module), "step+dropout:0.2", keys=keys, noise_scale=scale)
    truth = [observation for observation, _ in play(bare, 15)]
    assert_equal([info["clean_observation"] for _, info in play(env, 15)], truth)
    silent = ObservationNoise(make(env_id, module), "step+delay", keys=keys, noise_level=0, noise_scale=scale)
    assert_equal([observation for observation, _ in play(silent, 15)], truth)
    for each in (bare, env, silent):
        each.close()


@ELSEWHERE
@pytest.mark.filterwarnings(
    "ignore:.*A Box observation space m(ax|in)imum value is -?infinity",
    "ignore:.*is different from the unwrapped version",
)
def test_gymnasium_accepts_the_wrapped_environment(env_id, module, keys, scale):
    env = make(env_id, module).unwrapped
    check_env(ObservationNoise(env, "step+delay", keys=keys, noise_scale=scale), skip_render_check=True)
    env.close()


@ELSEWHERE
def test_batches(env_id, module, keys, scale):
    arguments = {"noise": "episode+dropout", "keys": keys, "noise_scale": scale}
    make_one = partial(make, env_id, module)
    twin = VectorObservationNoise(gym.vector.SyncVectorEnv([make_one] * 2), **arguments)
    singles = gym.vector.SyncVectorEnv([lambda: ObservationNoise(make_one(), **arguments)] * 2)
    for (ours, info), (theirs, _) in zip(play_batch(twin), play_batch(singles), strict=True):
        assert_equal(ours, theirs)
        assert twin.observation_space.contains(ours)
        assert (noised(ours, keys) != noised(info["clean_observation"], keys)).any()
    twin.close(), singles.close()


def play_batch(env):
    log = [env.reset(seed=5)]
    env.action_space.seed(0)
    for _ in range(12):
        observation, _, _, _, info = env.step(env.action_space.sample())
        log.append((observation, info))
    return log


class FetchCost(gym.Wrapper):
    """Someone's own cost: the gripper must not go below 0.45 m."""

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        return (
            observation,
            reward,
            terminated,
            truncated,
            {**info, "cost": float(observation["observation"][2] < 0.45)},
        )


@ELSEWHERE
def test_an_environment_without_cost_is_told_so(env_id, module, keys, scale):
    env = RequireCost(make(env_id, module))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=rf"{env_id}.* gave no info\['cost'\]"):
        env.step(env.action_space.sample())
    env.close()


def test_cost_and_noise_together_in_another_project():
    fetch = FetchCost(make(*FETCH[:2]))
    env = CostToTuple(ObservationNoise(CostFromTuple(CostToTuple(fetch)), "step", keys="observation"))
    env.reset(seed=0)
    down = np.array([0, 0, -1, 0], np.float32)
    costs = [env.step(down)[2] for _ in range(20)]
    assert costs[0] == 0.0
    assert costs[-1] == 1.0
    env.close()
