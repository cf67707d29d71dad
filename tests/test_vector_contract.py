"""Every native batched form against Gymnasium's own vectorisation of the single one: equal to the last bit."""

from __future__ import annotations

import copy
import importlib
import pickle
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from rise_agents.experts import make_expert
from rise_envs import ENVS
from rise_envs.task import task_of

MODES = list(AutoresetMode)
NATIVE = [env_id for env_id, (_, vector_entry, _) in ENVS.items() if vector_entry]
COLLIDES = {"terminate_on_collision": True, "reward_type": "sparse"}
KINDS = [(env_id, kwargs) for env_id in NATIVE for kwargs in ({}, COLLIDES, {"max_episode_steps": 7})]
KINDS.append(("RISE-GroundVehicle-v0", {**COLLIDES, "n_obstacles": 3}))


@pytest.fixture(params=NATIVE)
def env_id(request: pytest.FixtureRequest) -> str:
    return request.param


def native(env_id: str, n: int = 5, mode: AutoresetMode = AutoresetMode.NEXT_STEP, **kwargs: Any) -> Any:
    return gym.make_vec(env_id, n, vectorization_mode="vector_entry_point", autoreset_mode=mode, **kwargs)


def reference(env_id: str, n: int, mode: AutoresetMode, **kwargs: Any) -> Any:
    vector_kwargs = {"autoreset_mode": mode}
    return gym.make_vec(env_id, n, vectorization_mode="sync", vector_kwargs=vector_kwargs, **kwargs)


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


def blindly(env_id: str) -> Any:
    """Actions of an expert that sees no obstacle: it reaches goals and meets obstacles, so that all ends occur."""
    expert, channels = make_expert("cbf", env_id), len(task_of(env_id).noise_scale)

    def act(observation: dict[str, Any]) -> np.ndarray:
        far = observation["obstacle"][:, :channels] + 1e3
        return expert.predict({**observation, "obstacle": far})[0].astype(np.float32)

    return act


def reset_ended(env: Any, ended: np.ndarray) -> Any:
    return env.reset(options={"reset_mask": ended.copy()})


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(("env_id", "kwargs"), KINDS, ids=str)
def test_equals_sync_vector_env(env_id: str, kwargs: dict[str, Any], mode: AutoresetMode) -> None:
    a, b = native(env_id, 5, mode, **kwargs), reference(env_id, 5, mode, **kwargs)
    act, ends = blindly(env_id), 0
    out_a, out_b = a.reset(seed=7), b.reset(seed=7)
    assert_same(out_a, out_b, "reset")
    for t in range(ENVS[env_id][2] + 20):
        action = act(out_a[0])
        out_a, out_b = a.step(action), b.step(action)
        assert_same(out_a, out_b, f"step {t}")
        ended = out_a[2] | out_a[3]
        ends += ended.sum()
        if mode == AutoresetMode.DISABLED and ended.any():
            out_a, out_b = reset_ended(a, ended), reset_ended(b, ended)
            assert_same(out_a, out_b, f"reset after {t}")
    assert ends > 5
    a.close(), b.close()


def test_reset_in_mid_episode_goes_on_with_the_generators(env_id: str) -> None:
    a, b = native(env_id, 3), reference(env_id, 3, AutoresetMode.NEXT_STEP)
    for seed in (3, None, [9, None, 1], None):
        assert_same(a.reset(seed=seed), b.reset(seed=seed))
        action = a.action_space.sample()
        assert_same(a.step(action), b.step(action))


def test_masked_reset_with_seeds_touches_only_its_rows(env_id: str) -> None:
    a, b = native(env_id, 4, AutoresetMode.DISABLED), reference(env_id, 4, AutoresetMode.DISABLED)
    mask = np.array([True, False, False, True])
    assert_same(a.reset(seed=0), b.reset(seed=0))
    for seed in (100, [5, 6, 7, 8], None):
        options = {"reset_mask": mask}
        assert_same(a.reset(seed=seed, options=options), b.reset(seed=seed, options=dict(options)))
        assert options.keys() == {"reset_mask"}
        assert_same(a.reset(), b.reset())


def test_a_copy_goes_on_as_its_original(env_id: str) -> None:
    env = native(env_id, 3, max_episode_steps=4)
    env.reset(seed=2)
    action = env.action_space.sample()
    env.step(action)
    twins = copy.deepcopy(env), pickle.loads(pickle.dumps(env))
    for _ in range(6):
        out = env.step(action)
        for twin in twins:
            assert_same(twin.step(action), out)


def test_unseeded_resets_differ(env_id: str) -> None:
    first, second = (native(env_id, 2).reset()[0]["desired_goal"] for _ in range(2))
    assert not np.isin(first, second).any()


def test_rows_do_not_depend_on_the_batch(env_id: str) -> None:
    """Row 7 of 1,000 does what it does alone: no draw and no rounding depends on the company."""
    big, one = native(env_id, 1000), native(env_id, 1)
    big_obs, one_obs = big.reset(seed=50)[0], one.reset(seed=57)[0]
    big.action_space.seed(0)
    for _ in range(20):
        action = big.action_space.sample()
        big_obs, big_reward, *_, big_info = big.step(action)
        one_obs, one_reward, *_, one_info = one.step(action[7:8])
        assert_same({k: v[7:8] for k, v in big_obs.items()}, one_obs)
        assert big_reward[7] == one_reward[0]
        assert big_info["clearance"][7] == one_info["clearance"][0]


@pytest.mark.parametrize("mode", MODES)
def test_nothing_handed_out_is_written_to_later_or_shared(env_id: str, mode: AutoresetMode) -> None:
    """What was returned stays as it was; and scribbling over it does not change the episode."""
    kept, scribbled = (
        native(env_id, 4, mode, max_episode_steps=6),
        native(env_id, 4, mode, max_episode_steps=6),
    )
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


def test_invalid_actions_leave_the_state(env_id: str) -> None:
    a, b = native(env_id, 3), native(env_id, 3)
    a.reset(seed=0), b.reset(seed=0)
    shape = a.action_space.shape
    wrong = (
        (np.zeros((2, shape[1])), "shape"),
        (np.full(shape, np.nan), "finite"),
        (np.full(shape, "a"), "numeric"),
    )
    for action, message in wrong:
        with pytest.raises(ValueError, match=message):
            a.step(action)
    good = a.action_space.sample()
    assert_same(a.step(good), b.step(good))


def test_errors_of_use(env_id: str) -> None:
    env = native(env_id, 3, AutoresetMode.DISABLED, max_episode_steps=2)
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


def test_a_refused_reset_changes_nothing(env_id: str) -> None:
    a, b = native(env_id, 3), native(env_id, 3)
    a.reset(seed=0), b.reset(seed=0)
    for seed in ([1, 2], [5, 6, -1]):
        with pytest.raises((ValueError, gym.error.Error)):
            a.reset(seed=seed)
    assert_same(a.reset(), b.reset())


@pytest.mark.parametrize(
    ("n", "kwargs", "message"),
    [
        (2, {"render_mode": "rgb_array"}, "draw"),
        (0, {}, "num_envs"),
        (2, {"mode": "Sometimes"}, "Sometimes"),
        (2, {"reward_type": "shaped"}, "reward_type"),
        (2, {"max_episode_steps": 0}, "max_episode_steps"),
    ],
    ids=str,
)
def test_constructor_checks(env_id: str, n: int, kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        native(env_id, n, **kwargs)


def test_declares_its_autoreset_mode_and_closes_twice(env_id: str) -> None:
    for mode in MODES:
        env = native(env_id, 2, mode)
        assert env.metadata["autoreset_mode"] is mode
        env.close()
        env.close()
    module, _, name = ENVS[env_id][1].partition(":")  # type: ignore[union-attr]
    assert (
        getattr(importlib.import_module(module), name).metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    )


def test_the_spaces_hold_one_rows_bounds_only(env_id: str) -> None:
    """They equal Gymnasium's, whose bounds take as much memory as all the rest."""
    env = native(env_id, 100)
    for space, single in (
        (env.observation_space, env.single_observation_space),
        (env.action_space, env.single_action_space),
    ):
        assert space == batch_space(single, 100)
        assert space.contains(space.sample())
    boxes = [*env.observation_space.values(), env.action_space]
    assert all(box.low.strides[0] == box.high.strides[0] == 0 for box in boxes)
