"""The batched arms against Gymnasium's own vectorisation of the single one: equal to the last bit."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import rise_envs  # noqa: F401
from rise_envs.safe_panda_kinematic_vector import SafePandaKinematicVectorEnv

ID = "RISE-SafePandaKinematic-v0"
MODES = list(AutoresetMode)


def native(n: int = 5, mode: AutoresetMode = AutoresetMode.NEXT_STEP, **kwargs: Any) -> Any:
    return gym.make_vec(ID, n, autoreset_mode=mode, **kwargs)


def reference(n: int, mode: AutoresetMode, **kwargs: Any) -> Any:
    return gym.make_vec(ID, n, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **kwargs)


def assert_same(a: Any, b: Any, where: str = "") -> None:
    """Same structure, types, shapes and bits."""
    assert type(a) is type(b), where
    if isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            assert_same(a[key], b[key], f"{where}/{key}")
    elif isinstance(a, np.ndarray) and a.dtype == object:
        assert a.shape == b.shape, where
        for x, y in zip(a, b, strict=True):
            assert_same(x, y, where)
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype, where
        np.testing.assert_array_equal(a, b, err_msg=where)
    elif isinstance(a, tuple):
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_same(x, y, f"{where}[{i}]")
    else:
        assert a == b, where


def towards_goal(observation: dict[str, Any], rng: np.random.Generator) -> np.ndarray:
    """Actions that reach goals and now and then meet the sphere, so that every kind of end occurs."""
    way = (observation["desired_goal"] - observation["achieved_goal"]) / 0.05
    return np.clip(way + rng.normal(0, 0.7, way.shape), -1, 1).astype(np.float32)


def reset_ended(env: Any, ended: np.ndarray) -> Any:
    return env.reset(options={"reset_mask": ended.copy()})


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"terminate_on_collision": True, "reward_type": "sparse"},
        {"max_episode_steps": 7},
    ],
    ids=["default", "sparse-collision", "short"],
)
def test_equals_sync_vector_env(mode: AutoresetMode, kwargs: dict[str, Any]) -> None:
    a, b = native(5, mode, **kwargs), reference(5, mode, **kwargs)
    rng, ends = np.random.default_rng(0), 0
    out_a, out_b = a.reset(seed=7), b.reset(seed=7)
    assert_same(out_a, out_b, "reset")
    for t in range(90):
        action = towards_goal(out_a[0], rng)
        out_a, out_b = a.step(action), b.step(action)
        assert_same(out_a, out_b, f"step {t}")
        ended = out_a[2] | out_a[3]
        ends += ended.sum()
        if mode == AutoresetMode.DISABLED and ended.any():
            out_a, out_b = reset_ended(a, ended), reset_ended(b, ended)
            assert_same(out_a, out_b, f"reset after {t}")
    assert ends > 5


def test_reset_in_mid_episode_goes_on_with_the_generators() -> None:
    a, b = native(3), reference(3, AutoresetMode.NEXT_STEP)
    for seed in (3, None, [9, None, 1], None):
        assert_same(a.reset(seed=seed), b.reset(seed=seed))
        action = a.action_space.sample()
        assert_same(a.step(action), b.step(action))


def test_masked_reset_with_seeds_touches_only_its_rows() -> None:
    a, b = native(4, AutoresetMode.DISABLED), reference(4, AutoresetMode.DISABLED)
    mask = np.array([True, False, False, True])
    assert_same(a.reset(seed=0), b.reset(seed=0))
    for seed in (100, [5, 6, 7, 8], None):
        options = {"reset_mask": mask}
        assert_same(a.reset(seed=seed, options=options), b.reset(seed=seed, options=dict(options)))
        assert options.keys() == {"reset_mask"}
        assert_same(a.reset(), b.reset())


def test_unseeded_resets_differ() -> None:
    first, second = (native(2).reset()[0]["desired_goal"] for _ in range(2))
    assert not np.isin(first, second).any()


def test_rows_do_not_depend_on_the_batch() -> None:
    """Row 7 of 1,000 moves as it does alone: no draw and no rounding depends on the company."""
    big, one = native(1000), native(1)
    big_obs, one_obs = big.reset(seed=50)[0], one.reset(seed=57)[0]
    rng = np.random.default_rng(0)
    for _ in range(60):
        action = towards_goal(big_obs, rng)
        big_obs, big_reward, *_, big_info = big.step(action)
        one_obs, one_reward, *_, one_info = one.step(action[7:8])
        assert_same({k: v[7:8] for k, v in big_obs.items()}, one_obs)
        assert big_reward[7] == one_reward[0]
        assert big_info["clearance"][7] == one_info["clearance"][0]


@pytest.mark.parametrize("mode", MODES)
def test_nothing_handed_out_is_written_to_later_or_shared(mode: AutoresetMode) -> None:
    """What was returned stays as it was; and scribbling over it does not change the episode."""
    kept, scribbled = native(4, mode, max_episode_steps=6), native(4, mode, max_episode_steps=6)
    history = []
    out_a, out_b = kept.reset(seed=1), scribbled.reset(seed=1)
    for t in range(20):
        history.append((out_a, copy.deepcopy(out_a)))
        assert_same(out_a, out_b)
        ended = np.zeros(4, bool) if t == 0 else out_a[2] | out_a[3]
        scribble(out_b)
        action = kept.single_action_space.high * np.ones((4, 1), np.float32)
        if mode == AutoresetMode.DISABLED and ended.any():
            reset_ended(kept, ended), reset_ended(scribbled, ended)
        out_a, out_b = kept.step(action), scribbled.step(action)
        action[:] = np.nan
    for out, then in history:
        assert_same(out, then)
    arrays = list(leaves(out_a))
    for i, one in enumerate(arrays):
        assert not any(np.shares_memory(one, other) for other in arrays[i + 1 :])


def leaves(nested: Any) -> Any:
    """The arrays of numbers in nested tuples, dicts and arrays of objects."""
    if isinstance(nested, dict | tuple) or (isinstance(nested, np.ndarray) and nested.dtype == object):
        for part in nested.values() if isinstance(nested, dict) else nested:
            yield from leaves(part)
    elif isinstance(nested, np.ndarray):
        yield nested


def scribble(nested: Any) -> None:
    for array in leaves(nested):
        array[...] = True if array.dtype == bool else 77


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros((2, 3)), "shape"),
        (np.full((3, 3), np.nan), "finite"),
        ([["a", "b", "c"]] * 3, "numeric"),
    ],
)
def test_invalid_actions_leave_the_state(action: Any, message: str) -> None:
    a, b = native(3), native(3)
    a.reset(seed=0), b.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        a.step(action)
    good = a.action_space.sample()
    assert_same(a.step(good), b.step(good))


def test_errors_of_use() -> None:
    env = native(3, AutoresetMode.DISABLED, max_episode_steps=2)
    with pytest.raises(gym.error.ResetNeeded, match="reset"):
        env.step(env.action_space.sample())
    some = np.array([True, False, False])
    with pytest.raises(gym.error.ResetNeeded, match="first reset"):
        env.reset(options={"reset_mask": some})
    for mask in (some[:2], np.zeros(3, bool), np.array([1, 0, 0])):
        with pytest.raises(ValueError, match="reset_mask"):
            env.reset(options={"reset_mask": mask})
    with pytest.raises(ValueError, match="3 seeds, got 2"):
        env.reset(seed=[1, 2])

    env.reset(seed=0)
    action = env.action_space.sample()
    env.step(action), env.step(action)
    with pytest.raises(gym.error.ResetNeeded, match="have ended"):
        env.step(action)
    env.reset(options={"reset_mask": np.ones(3, bool)})
    env.step(action)


def test_a_refused_reset_changes_nothing() -> None:
    a, b = native(3), native(3)
    a.reset(seed=0), b.reset(seed=0)
    for seed in ([1, 2], [5, 6, -1]):
        with pytest.raises((ValueError, gym.error.Error)):
            a.reset(seed=seed)
    assert_same(a.reset(), b.reset())


def test_constructor_checks() -> None:
    with pytest.raises(ValueError, match="no pictures"):
        SafePandaKinematicVectorEnv(2, render_mode="rgb_array")
    with pytest.raises(ValueError, match="num_envs"):
        SafePandaKinematicVectorEnv(0)
    with pytest.raises(ValueError, match="Sometimes"):
        SafePandaKinematicVectorEnv(2, autoreset_mode="Sometimes")
    with pytest.raises(ValueError, match="reward_type"):
        SafePandaKinematicVectorEnv(2, reward_type="shaped")


def test_declares_its_autoreset_mode_and_closes_twice() -> None:
    for mode in MODES:
        env = native(2, mode)
        assert env.metadata["autoreset_mode"] is mode
        env.close()
        env.close()
    assert SafePandaKinematicVectorEnv.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
