"""The bridge to stable-baselines3 against Gymnasium's own vector environments."""

from __future__ import annotations

import multiprocessing
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from stable_baselines3.common.vec_env import DummyVecEnv
from toy_envs import Bandit, Walk

import rise_envs  # noqa: F401
from rise_agents import vec_env
from rise_agents.bridge import Bridge
from rise_agents.seeds import SPLITS

VEHICLE = "RISE-GroundVehicle-v0"
KEYS = ("observation", "desired_goal", "obstacle")


def encode(observation):
    return np.concatenate([observation[key] for key in KEYS], -1).astype(np.float32)


def vehicles(n, native, steps=40):
    mode, kwargs = {"autoreset_mode": AutoresetMode.SAME_STEP}, {"max_episode_steps": steps}
    if native:
        return gym.make_vec(VEHICLE, n, **mode, **kwargs)
    return gym.make_vec(VEHICLE, n, vectorization_mode="sync", vector_kwargs=mode, **kwargs)


def walks(n=2, **walk):
    return SyncVectorEnv([lambda: Walk(**walk)] * n, autoreset_mode=AutoresetMode.SAME_STEP)


def flat(observation):
    return observation.astype(np.float32)


def test_native_and_serial_vehicles_look_alike_through_the_bridge():
    bridges = [Bridge(vehicles(3, native), encode, 10) for native in (True, False)]
    for bridge in bridges:
        bridge.seed(5)
    np.testing.assert_array_equal(*(bridge.reset() for bridge in bridges))
    rng, ended = np.random.default_rng(0), 0
    for _ in range(90):
        action = rng.uniform(-1, 1, (3, 2)).astype(np.float32)
        (obs, reward, done, info), (obs_2, reward_2, done_2, info_2) = (b.step(action) for b in bridges)
        np.testing.assert_array_equal(obs, obs_2)
        np.testing.assert_array_equal(reward, reward_2)
        np.testing.assert_array_equal(done, done_2)
        np.testing.assert_array_equal(bridges[0].costs, bridges[1].costs)
        ended += done.sum()
        for i in np.flatnonzero(done):
            np.testing.assert_array_equal(
                info[i].pop("terminal_observation"), info_2[i].pop("terminal_observation")
            )
            assert info[i] == info_2[i]
    assert ended >= 6


@pytest.mark.parametrize("ends", ["truncated", "terminated"])
def test_the_end_of_an_episode_is_told_as_dummy_vec_env_tells_it(ends):
    """Same walk through SB3's own DummyVecEnv: it is the reference for the meaning of every entry."""
    bridge = Bridge(walks(1, length=5, ends=ends), flat, 2)
    dummy = DummyVecEnv([lambda: Walk(length=5, ends=ends)])
    bridge.seed(0)
    dummy.seed(bridge._seeds[0])
    np.testing.assert_allclose(bridge.reset(), dummy.reset(), rtol=1e-6)
    costs = 0.0
    for _ in range(12):
        action = np.full((1, 2), 0.25, np.float32)
        obs, reward, done, (info,) = bridge.step(action)
        obs_2, reward_2, done_2, (info_2,) = dummy.step(action)
        np.testing.assert_allclose(obs, obs_2, rtol=1e-6)
        np.testing.assert_allclose(reward, reward_2, rtol=1e-6)
        assert bridge.costs[0] == info_2["cost"]
        costs += info_2["cost"]
        assert done[0] == done_2[0]
        if done[0]:
            assert info["TimeLimit.truncated"] is info_2["TimeLimit.truncated"] is (ends == "truncated")
            np.testing.assert_allclose(
                info["terminal_observation"], info_2["terminal_observation"], rtol=1e-6
            )
            assert info["episode"] == {"r": pytest.approx(costs), "l": 5, "c": pytest.approx(costs)}
            costs = 0.0
        else:
            assert info == {}


def test_the_cost_of_the_last_step_is_the_ended_episodes_own():
    """The vehicle's reset reports a cost of 0 too: it must not hide a collision in the step before."""
    infos = {
        "cost": np.array([0.0, 0.0, 1.0]),
        "_cost": np.array([True, True, True]),
        "final_info": {"cost": np.array([0.0, 7.0, 0.0]), "_cost": np.array([False, True, False])},
    }
    np.testing.assert_array_equal(vec_env.step_costs(infos, np.array([False, True, False])), [0, 7, 1])


@pytest.mark.parametrize(("cost", "message"), [("none", "no info\\['cost'\\]"), ("nan", "finite and ≥ 0")])
def test_a_missing_or_broken_cost_raises(cost, message):
    bridge = Bridge(walks(cost=cost), flat, 2)
    bridge.reset()
    with pytest.raises(ValueError, match=message):
        bridge.step(np.zeros((2, 2), np.float32))


def test_actions_reach_the_bounds_and_never_pass_them():
    low, high = np.array([0.0, -1.5]), np.array([2.5, 1.5])
    actions = np.array([[-1, -1], [1, 1], [0, 0], [-9, 9], [0.5, -0.5]])
    expected = [[0, -1.5], [2.5, 1.5], [1.25, 0], [0, 1.5], [1.875, -0.75]]
    got = vec_env.rescale(actions, low, high)
    np.testing.assert_allclose(got, expected)
    assert got.dtype == np.float32
    odd = vec_env.rescale(np.ones((1, 2)), np.array([-0.1, -0.1]), np.array([0.1, 0.7]))
    assert (odd <= np.float32([0.1, 0.7])).all()


def test_the_bridge_rescales_to_asymmetric_bounds():
    """The bandit's reward is its action: −1 … 1 must arrive as −1 … 3."""
    bridge = Bridge(vec_env.as_vector_env(Bandit()), flat, 1)
    bridge.reset()
    assert bridge.action_space == spaces.Box(-1, 1, (1,), np.float32)
    for action, reward in ((-1, -1), (0, 1), (1, 3)):
        assert bridge.step(np.float32([[action]]))[1] == reward


def test_training_episodes_lie_in_the_training_range_and_differ_between_runs():
    bridge = Bridge(walks(), flat, 2)
    seen = {seed: tuple(bridge.seed(seed)) for seed in (0, 1)}
    assert set(seen[0]).isdisjoint(seen[1])
    assert all(0 <= s < SPLITS["validation"] for seeds in seen.values() for s in seeds)
    bridge.seed(0)
    first = bridge.reset()
    assert not np.array_equal(first, bridge.reset())  # the seeds name the first episodes only
    bridge.seed(0)
    np.testing.assert_array_equal(first, bridge.reset())


def test_random_inputs_are_replayed_by_their_seeds():
    venv = vehicles(4, native=True)
    runs = [vec_env.random_inputs(venv, encode, np.arange(4) + first, 50) for first in (0, 0, 100)]
    assert runs[0].shape == (52, 10)
    np.testing.assert_array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])


def test_the_native_batch_is_used_where_there_is_one():
    native = vec_env.make_training_env(VEHICLE, 2)
    assert type(native).__name__ == "GroundVehicleVectorEnv"
    alone = vec_env.make_training_env("ToyWalk-v0", 1)
    assert isinstance(alone, SyncVectorEnv)
    # CartPole's own batch cannot reset within a step: processes instead.
    processes = vec_env.make_training_env("CartPole-v1", 2)
    assert isinstance(processes, AsyncVectorEnv)
    for env in (native, alone, processes):
        assert env.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
        env.close()


def test_other_autoreset_modes_are_refused():
    with pytest.raises(ValueError, match="SAME_STEP"):
        vec_env.as_vector_env(gym.make_vec(VEHICLE, 2, autoreset_mode=AutoresetMode.NEXT_STEP))


def test_unbounded_actions_are_refused():
    with pytest.raises(ValueError, match="finite bounds"):
        vec_env.action_bounds(spaces.Box(-np.inf, 1.0, (1,)))
    assert vec_env.action_bounds(spaces.Discrete(2)) is None


def _train_for_ever(pids):
    venv = vec_env.make_training_env("CartPole-v1", 3)
    venv.reset(seed=0)
    for process in venv.processes:
        pids.put(process.pid)
    time.sleep(60)


def test_sub_environments_end_with_a_trainer_that_is_killed():
    context = multiprocessing.get_context("spawn")
    pids = context.Queue()
    trainer = context.Process(target=_train_for_ever, args=(pids,))
    trainer.start()
    children = [pids.get(timeout=60) for _ in range(3)]
    trainer.kill()
    trainer.join()
    deadline = time.monotonic() + 30
    while any(Path(f"/proc/{pid}").exists() for pid in children) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not [pid for pid in children if Path(f"/proc/{pid}").exists()]
