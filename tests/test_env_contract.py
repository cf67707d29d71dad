"""What every registered environment keeps, whichever it is: a new one is tested by its registry line."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RescaleAction

import rise_envs
from rise_envs.task import env_class, task_of

STEPS = 8  # too few to reach any goal: no vector environment restarts in between
SEEDS = range(100)
Record = dict[str, np.ndarray]


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


def actions(space: spaces.Box, seed: int, n: int = STEPS) -> np.ndarray:
    """``n`` random actions (n, A) that belong to ``seed``."""
    return np.random.default_rng(seed).uniform(space.low, space.high, (n, *space.shape)).astype(space.dtype)


def record(env: Any, seed: int, n: int = STEPS) -> Record:
    """All that the environment says in ``n`` steps of the episode ``seed``, one array per quantity."""
    observation, info = env.reset(seed=seed)
    rows = [{**observation, "reward": 0.0, "cost": info["cost"], "clearance": info["clearance"]}]
    for action in actions(env.action_space, seed, n):
        observation, reward, terminated, truncated, info = env.step(action)
        assert not terminated and not truncated
        rows.append({**observation, "reward": reward, "cost": info["cost"], "clearance": info["clearance"]})
    return {key: np.array([row[key] for row in rows]) for key in rows[0]}


def record_batch(env: Any, seeds: list[int]) -> list[Record]:
    """The same from a vector environment, one record per seed."""
    observation, info = env.reset(seed=seeds)
    rows = [
        {**observation, "reward": np.zeros(len(seeds)), "cost": info["cost"], "clearance": info["clearance"]}
    ]
    rows = copy.deepcopy(rows)
    space: Any = env.single_action_space
    for action in np.stack([actions(space, seed) for seed in seeds], axis=1):
        observation, reward, _, _, info = env.step(action)
        row = {**observation, "reward": reward, "cost": info["cost"], "clearance": info["clearance"]}
        rows.append(copy.deepcopy(row))
    return [{key: np.array([row[key][i] for row in rows]) for key in rows[0]} for i in range(len(seeds))]


def assert_same(a: Record, b: Record) -> None:
    assert a.keys() == b.keys()
    for key in a:
        assert a[key].dtype == b[key].dtype
        np.testing.assert_array_equal(a[key], b[key], err_msg=key)


@pytest.fixture(scope="module")
def expected() -> Any:
    """The records of the first 100 seeds of an environment, each from its first episodes; made once."""
    made: dict[str, list[Record]] = {}

    def records(env_id: str) -> list[Record]:
        if env_id not in made:
            env = gym.make(env_id)
            made[env_id] = [record(env, seed) for seed in SEEDS]
            env.close()
        return made[env_id]

    return records


# --- the checkers of Gymnasium and Stable-Baselines3 ------------------------------------------------------


# Both checkers would like actions in [−1, 1], where some tasks have them in SI units on purpose.
WISH = "symmetric and normalized"


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


def test_gymnasium_check_env(env: Any) -> None:
    """It draws in every mode, too. Wrapped, its one complaint is that it was not given the bare environment."""
    bare = complaints(check_env, env.unwrapped)
    assert [m for m in bare if is_normalised(env) or WISH not in m] == []
    if not is_normalised(env):
        scaled = complaints(
            lambda e: check_env(e, skip_render_check=True, skip_close_check=True), Scaled(env)
        )
        assert [m for m in scaled if "different from the unwrapped version" not in m] == []


def test_stable_baselines_check_env(env: Any) -> None:
    from stable_baselines3.common.env_checker import check_env as check_env_sb3

    bare = complaints(check_env_sb3, env.unwrapped)
    assert [m for m in bare if is_normalised(env) or WISH not in m] == []
    assert complaints(check_env_sb3, Scaled(env)) == []


# --- spaces and description -------------------------------------------------------------------------------


def test_spaces(env: Any) -> None:
    space = env.observation_space
    assert isinstance(space, spaces.Dict)
    assert set(space) == {"observation", "achieved_goal", "desired_goal", "obstacle"}
    for part in space.values():
        assert isinstance(part, spaces.Box)
        assert part.dtype == np.float64
        assert len(part.shape) == 1
        assert np.isfinite(part.low).all() and np.isfinite(part.high).all()
    assert isinstance(env.action_space, spaces.Box)
    assert env.action_space.dtype == np.float32
    for seed in range(5):
        for observation in _observations(env, seed):
            assert observation in space


def _observations(env: Any, seed: int) -> Iterator[dict[str, np.ndarray]]:
    yield env.reset(seed=seed)[0]
    for action in actions(env.action_space, seed):
        yield env.step(action)[0]


def test_task_describes_the_environment(env_id: str, env: Any) -> None:
    task, unwrapped = task_of(env_id), env.unwrapped
    observation, _ = env.reset(seed=0)
    assert observation["desired_goal"].shape == (task.dim,)
    assert observation["obstacle"].shape == (task.n_obstacles * (2 * task.dim + 1),)
    np.testing.assert_array_equal(unwrapped.noise_scale["obstacle"], task.noise_scale)
    assert sorted(c for group in unwrapped.noise_channels["obstacle"].values() for c in group) == list(
        range(len(task.noise_scale))
    )
    position, rotation = task.pose(observation["observation"][None])
    np.testing.assert_allclose(position[0], observation["achieved_goal"])
    np.testing.assert_allclose(rotation[0] @ rotation[0].T, np.eye(task.dim), atol=1e-12)
    position, velocity, radius = task.split(observation["obstacle"])
    moved = task.split(env.step(np.zeros(env.action_space.shape))[0]["obstacle"])[0]
    np.testing.assert_allclose(moved, position + task.dt * velocity, atol=1e-12)
    assert (radius > 0).all()


def test_time_limit_of_the_registry(env_id: str, env: Any) -> None:
    assert env.spec is not None
    assert env.spec.max_episode_steps == rise_envs.ENVS[env_id][2]


# --- replay -----------------------------------------------------------------------------------------------


def test_seeds_name_different_episodes(env_id: str, expected: Any) -> None:
    firsts = np.array([np.concatenate((r["desired_goal"][0], r["obstacle"][0])) for r in expected(env_id)])
    assert len(np.unique(firsts, axis=0)) == len(SEEDS)


def test_replay_after_other_episodes(env_id: str, env: Any, expected: Any) -> None:
    """Backwards, in a used environment, after episodes of no seed and an action that was refused."""
    for seed in reversed(SEEDS):
        if seed % 10 == 0:
            env.reset()
            with pytest.raises(ValueError, match="finite"):
                env.step(np.full(env.action_space.shape, np.nan))
            env.step(env.action_space.sample())
        assert_same(record(env, seed), expected(env_id)[seed])


def test_unseeded_resets_go_on_with_the_seeded_generator(env: Any, twin: Any) -> None:
    env.reset(seed=1), twin.reset(seed=1)
    for _ in range(3):
        a, b = env.reset()[0], twin.reset()[0]
        for key in a:
            np.testing.assert_array_equal(a[key], b[key])


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_replay_in_gymnasiums_vector_environments(env_id: str, mode: str, expected: Any) -> None:
    # Fresh processes, not forks of this one with its threads.
    context = {"context": "spawn"} if mode == "async" else {}
    env = gym.make_vec(env_id, 2, vectorization_mode=mode, vector_kwargs=context)
    for i in range(0, len(SEEDS), 2):
        for j, made in enumerate(record_batch(env, [i, i + 1])):
            assert_same(made, expected(env_id)[i + j])
    env.close()


def test_replay_in_the_native_vector_environment(env_id: str, expected: Any) -> None:
    if rise_envs.ENVS[env_id][1] is None:
        pytest.skip("it has no batched form")
    env = gym.make_vec(env_id, len(SEEDS))
    for made, single in zip(record_batch(env, list(SEEDS)), expected(env_id), strict=True):
        assert_same(made, single)
    env.close()


# --- infos and ownership ----------------------------------------------------------------------------------


def test_infos(env: Any) -> None:
    for seed in range(3):
        observation, info = env.reset(seed=seed)
        before = observation["achieved_goal"].copy()
        outcomes = [(observation, info)]
        for action in actions(env.action_space, seed):
            observation, _, terminated, _, info = env.step(action)
            assert terminated == info["is_success"]
            np.testing.assert_array_equal(info["previous_achieved_goal"], before)
            before = observation["achieved_goal"].copy()
            outcomes.append((observation, info))
        for _, info in outcomes:
            assert type(info["cost"]) is float and type(info["clearance"]) is float
            assert type(info["is_success"]) is bool
            assert info["cost"] == (1.0 if info["clearance"] < 0 else 0.0)
        assert outcomes[0][1]["cost"] == 0.0


def test_what_is_handed_out_is_the_callers_own(env: Any, twin: Any) -> None:
    """Scribbling over it changes no episode, and the environment never writes into it later."""
    history = []
    a: Any = env.reset(seed=4)
    b: Any = twin.reset(seed=4)
    for action in actions(env.action_space, 4):
        history.append((a, copy.deepcopy(a)))
        for part in (b[0], b[-1]):
            for value in part.values():
                if isinstance(value, np.ndarray):
                    value[...] = 99.0
        a, b = env.step(action), twin.step(action)
        for key in a[0]:
            np.testing.assert_array_equal(a[0][key], b[0][key])
        action[:] = np.nan
    for handed_out, then in history:
        np.testing.assert_equal(handed_out, then)


def test_perceived_is_for_noise_wrappers(env: Any) -> None:
    env.reset(seed=0)
    assert env.unwrapped.perceived is None
    noisy = rise_envs.ObservationNoise(env, "step")
    observation, _ = noisy.reset(seed=0)
    np.testing.assert_array_equal(env.unwrapped.perceived, observation["obstacle"])
    env.reset()
    assert env.unwrapped.perceived is None


def test_drawing_changes_no_episode(env_id: str, expected: Any) -> None:
    if "rgb_array" not in env_class(env_id).metadata["render_modes"]:
        pytest.skip("it draws no pictures")
    env: Any = gym.make(env_id, render_mode="rgb_array")
    env.reset(seed=0)
    pictures = []
    for step, action in enumerate(actions(env.action_space, 0, 4), start=1):
        env.unwrapped.perceived = env.observation_space["obstacle"].low
        pictures += [env.render(), env.render()]
        observation = env.step(action)[0]
        for key in observation:
            np.testing.assert_array_equal(observation[key], expected(env_id)[0][key][step])
    for picture in pictures:
        assert picture.dtype == np.uint8 and picture.ndim == 3 and picture.shape[2] == 3
    np.testing.assert_array_equal(pictures[0], pictures[1])
    assert (pictures[0] != pictures[-1]).any()
    env.close()


# --- misuse -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "wrong", ["shape", "row", "ragged", "nan", "inf", "text", "digits", "complex", "none"]
)
def test_refused_actions_change_nothing(env: Any, twin: Any, wrong: str) -> None:
    shape = env.action_space.shape
    assert shape is not None
    action: Any = {
        "shape": np.zeros(shape[0] + 1),
        "row": np.zeros((1, *shape)),
        "nan": np.full(shape, np.nan),
        "inf": np.array([np.inf] + [0.0] * (shape[0] - 1)),
        "ragged": [[0.0], [0.0, 0.0], []][: shape[0]],
        "text": ["left"] * shape[0],
        "digits": ["1"] * shape[0],
        "complex": np.zeros(shape, complex),
        "none": None,
    }[wrong]
    env.reset(seed=2), twin.reset(seed=2)
    for _ in range(2):
        with pytest.raises(ValueError, match="action"):
            env.unwrapped.step(action)
        good = actions(env.action_space, 2, 1)[0]
        a, b = env.step(good), twin.step(good)
        for key in a[0]:
            np.testing.assert_array_equal(a[0][key], b[0][key])
        assert a[1] == b[1]


def test_actions_beyond_the_bounds_are_clipped(env: Any, twin: Any) -> None:
    assert isinstance(env.action_space, spaces.Box)
    env.reset(seed=0), twin.reset(seed=0)
    a, b = env.step(env.action_space.high * 3 + 1), twin.step(env.action_space.high)
    for key in a[0]:
        np.testing.assert_array_equal(a[0][key], b[0][key])


def test_a_step_before_the_reset_is_refused(env: Any) -> None:
    with pytest.raises((gym.error.ResetNeeded, RuntimeError), match="reset"):
        env.unwrapped.step(env.action_space.sample())


def test_close_may_be_called_twice(env: Any) -> None:
    env.reset(seed=0)
    env.close()
    env.close()


def test_unknown_arguments_are_named(env_id: str) -> None:
    with pytest.raises(ValueError, match="shaped"):
        gym.make(env_id, reward_type="shaped")
    with pytest.raises(TypeError, match="gravity"):
        gym.make(env_id, gravity=3)


# --- goals ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("reward_type", ["dense", "sparse"])
@pytest.mark.parametrize("on_collision", [False, True])
def test_goal_api_is_vectorised_and_agrees_with_the_steps(
    env_id: str, reward_type: str, on_collision: bool
) -> None:
    made = gym.make(env_id, reward_type=reward_type, terminate_on_collision=on_collision)
    env: Any = made.unwrapped
    achieved: list[Any] = []
    desired: list[Any] = []
    infos: list[Any] = []
    rewards: list[float] = []
    ends: list[bool] = []
    for seed in range(4):
        env.reset(seed=seed)
        for action in actions(env.action_space, seed):
            observation, reward, terminated, truncated, info = env.step(action)
            assert type(reward) is float and type(terminated) is bool and truncated is False
            goal = (observation["achieved_goal"], observation["desired_goal"], info)
            assert env.compute_reward(*goal) == reward
            assert env.compute_terminated(*goal) == terminated
            assert not env.compute_truncated(*goal)
            for values, value in zip((achieved, desired, infos), goal, strict=True):
                values.append(value)
            rewards.append(reward)
            ends.append(terminated)
    batch = (np.array(achieved), np.array(desired), np.array(infos))
    assert env.compute_reward(*batch).tolist() == rewards
    assert env.compute_terminated(*batch).tolist() == ends
    assert env.compute_truncated(*batch).tolist() == [False] * len(rewards)
    reached = (np.array(achieved), np.array(achieved), np.array(infos))  # as hindsight relabels
    assert env.compute_terminated(*reached).all()
    assert (env.compute_reward(*reached) >= (0 if reward_type == "sparse" else 1)).all()
    made.close()


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
