"""ObservationNoise, and its vector twin against single environments wrapped one by one."""

from __future__ import annotations

import functools

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import DictInfoToList
from numpy.testing import assert_array_equal, assert_equal

import rise_envs
from rise_envs import streams
from rise_envs.noise import corrupt, make_noise
from rise_envs.noise_models import Delay, EpisodeBias, StepNoise
from rise_envs.noise_wrappers import ObservationNoise, VectorObservationNoise, noise_keys
from rise_envs.task import task_of

MODES = list(AutoresetMode)
MODELS = ["step", "episode", "step+dropout:0.4+delay:2", "drift:1+quantise:0.3"]
MODELS += ["outlier:0.3", "step@velocity+delay:2@position"]
GROUPS = {"position": [0, 1], "velocity": [2, 3]}


class Walk(gym.Env):
    """A random walk of random length whose observation lies in one buffer that every step overwrites."""

    observation_space = spaces.Dict(
        obstacle=spaces.Box(-100, 100, (2, 2), np.float32),
        achieved_goal=spaces.Box(-100, 100, (2,), np.float64),
        desired_goal=spaces.Box(-100, 100, (2,), np.float64),
        image=spaces.Box(0, 255, (2, 2), np.uint8),
        count=spaces.Discrete(100),
    )
    action_space = spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self):
        self.perceived = None
        self.noise_scale = {"obstacle": np.array([[0.1, 1.0], [2.0, 0.0]])}
        self.noise_channels = {"obstacle": GROUPS}
        self.resets = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.resets += 1
        self.options, self.perceived = options, None
        self.left = self.np_random.integers(1, 6)
        self.buffer = {
            "obstacle": self.np_random.normal(size=(2, 2)).astype(np.float32),
            "achieved_goal": np.zeros(2),
            "desired_goal": self.np_random.normal(size=2),
            "image": np.zeros((2, 2), np.uint8),
            "count": np.int64(0),
        }
        return self.buffer, {"cost": 0.0}

    def step(self, action):
        self.left -= 1
        self.buffer["obstacle"] += self.np_random.normal(size=(2, 2)).astype(np.float32)
        self.buffer["achieved_goal"] += action
        self.buffer["count"] += 1
        return self.buffer, 0.5, bool(self.left == 0), bool(self.left < 0), {"cost": 1.0}


class BoxWalk(gym.ObservationWrapper):
    """The same with a Box observation."""

    observation_space = spaces.Box(-100, 100, (2, 2), np.float32)

    def __init__(self):
        super().__init__(Walk())

    def observation(self, observation):
        return observation["obstacle"].copy()


def vehicle(**kwargs):
    return gym.make("RISE-GroundVehicle-v0", max_episode_steps=4, **kwargs)


def episode(env, n_steps=4, seed=None, options=None):
    """Observations and infos of an episode under fixed actions."""
    observation, info = env.reset(seed=seed, options=options)
    observations, infos = [observation], [info]
    actions = np.random.default_rng(5).uniform(-1, 1, (n_steps, 2)).astype(np.float32)
    for action in actions:
        observation, _, _, _, info = env.step(action)
        observations.append(observation)
        infos.append(info)
    return observations, infos


# The single environment


def test_noise_is_that_of_the_model_and_the_scale_of_the_environment():
    observations, infos = episode(
        ObservationNoise(Walk(), "step+episode", noise_level=2), options={"noise_seed": 7}
    )
    clean = np.stack([i["clean_observation"]["obstacle"].ravel() for i in infos]).astype(np.float64)
    key = streams.seed_keys([7], 0x65706973)
    expected = corrupt(StepNoise(2) + EpisodeBias(2), clean[None], [0.1, 1.0, 2.0, 0.0], key)[0]
    assert_array_equal(np.stack([o["obstacle"].ravel() for o in observations]), expected.astype(np.float32))


def test_only_what_is_named_is_touched():
    env = ObservationNoise(Walk())
    observation, info = env.reset(seed=0)
    for _ in range(4):
        clean = info["clean_observation"]
        changed = observation["obstacle"] != clean["obstacle"]
        assert_array_equal(changed, env.unwrapped.noise_scale["obstacle"] > 0)
        assert observation["count"] == clean["count"]
        for key in ("achieved_goal", "desired_goal", "image"):
            assert_array_equal(observation[key], clean[key])
        observation, _, _, _, info = env.step(np.ones(2, np.float32))
    observation, info = ObservationNoise(Walk(), keys=["desired_goal", "obstacle"]).reset()
    assert (observation["desired_goal"] != info["clean_observation"]["desired_goal"]).all()


@pytest.mark.parametrize("make", [Walk, vehicle])
def test_the_environment_moves_the_same_with_and_without_noise(make):
    bare, noisy = make(), ObservationNoise(make())
    for seed in (3, None, None, 8):
        plain, _ = episode(noisy, seed=seed)
        truth = []
        observation, _ = bare.reset(seed=seed)
        truth.append(observation["obstacle"].copy())
        for action in np.random.default_rng(5).uniform(-1, 1, (4, 2)).astype(np.float32):
            truth.append(bare.step(action)[0]["obstacle"].copy())
        assert len(plain) == len(truth)
    again, infos = episode(ObservationNoise(make()), seed=8)
    assert_equal([i["clean_observation"]["obstacle"] for i in infos], truth)
    assert any((a["obstacle"] != t).any() for a, t in zip(again, truth, strict=True))


@pytest.mark.parametrize("noise", MODELS)
def test_seeds_replay_and_episodes_differ(noise):
    env = ObservationNoise(Walk(), noise)
    first, _ = episode(env, seed=3)
    first = [o["obstacle"] for o in first]
    later = [[o["obstacle"] - i["clean_observation"]["obstacle"] for o, i in zip(*episode(env), strict=True)]]
    later += [
        [o["obstacle"] - i["clean_observation"]["obstacle"] for o, i in zip(*episode(env), strict=True)]
    ]
    assert not np.array_equal(*later)
    fresh = ObservationNoise(Walk(), noise)
    episode(fresh)
    assert_equal([o["obstacle"] for o in episode(fresh, seed=3)[0]], first)
    again = [o["obstacle"] - i["clean_observation"]["obstacle"] for o, i in zip(*episode(fresh), strict=True)]
    assert_equal(again, later[0])


def test_a_noise_seed_names_the_noise_whatever_the_environment_does():
    def added(seed, noise_seed):
        env = ObservationNoise(Walk(), keys="desired_goal", noise_scale=1.0)
        pairs = zip(*episode(env, seed=seed, options={"noise_seed": noise_seed}), strict=True)
        return np.array([o["desired_goal"] - i["clean_observation"]["desired_goal"] for o, i in pairs])

    np.testing.assert_allclose(added(1, 5), added(2, 5), atol=1e-14)
    assert (np.abs(added(1, 5) - added(1, 6)) > 1e-9).all()
    assert (np.abs(added(5, 5) - added(5, 6)) > 1e-9).all()


def test_options_reach_the_environment_without_the_noise_seed():
    env, options = ObservationNoise(Walk()), {"noise_seed": np.int64(3), "else": 1}
    env.reset(options=options)
    assert env.unwrapped.options == {"else": 1} and options == {"noise_seed": 3, "else": 1}
    env.reset(options={"noise_seed": 3})
    assert env.unwrapped.options is None


@pytest.mark.parametrize("noise_seed", [-1, 1.5, "a", [1, 2], True])
def test_a_wrong_noise_seed_leaves_everything_as_it_was(noise_seed):
    env = ObservationNoise(Walk())
    with pytest.raises(ValueError, match="noise_seed"):
        env.reset(seed=1, options={"noise_seed": noise_seed})
    assert env.unwrapped.resets == 0


def test_the_clean_observation_is_a_copy():
    env = ObservationNoise(Walk())
    observation, info = env.reset(seed=0)
    before = {key: np.copy(value) for key, value in info["clean_observation"].items()}
    for value in observation.values():
        value += 1
    env.step(np.ones(2, np.float32))
    assert_equal(info["clean_observation"], before)
    env = ObservationNoise(BoxWalk())
    _, info = env.reset(seed=0)
    assert info["clean_observation"].dtype == np.float32


def test_the_environment_learns_what_was_read():
    env = ObservationNoise(vehicle(), "step")
    observation, _ = env.reset(seed=0)
    assert_array_equal(env.unwrapped.perceived, observation["obstacle"])
    observation = env.step(env.action_space.sample())[0]
    assert_array_equal(env.unwrapped.perceived, observation["obstacle"])
    env = ObservationNoise(vehicle(), keys="observation")
    env.reset(seed=0)
    assert env.unwrapped.perceived is None


def test_spaces():
    env = ObservationNoise(Walk())
    assert env.observation_space["obstacle"] == spaces.Box(-np.inf, np.inf, (2, 2), np.float32)
    for key in ("image", "desired_goal", "count"):
        assert env.observation_space[key] == Walk.observation_space[key]
    assert list(env.observation_space) == list(Walk.observation_space)
    for each in (env, ObservationNoise(BoxWalk()), ObservationNoise(vehicle())):
        assert each.observation_space.contains(each.reset(seed=0)[0])
        assert each.observation_space.contains(each.step(each.action_space.sample())[0])


@pytest.mark.parametrize("env_id", rise_envs.ENVS)
def test_every_environment_publishes_the_scale_of_its_task(env_id):
    with gym.make(env_id) as env:
        assert_array_equal(ObservationNoise(env)._rows.scale, task_of(env_id).noise_scale)


def test_the_published_scale_is_used_or_1():
    assert_array_equal(ObservationNoise(Walk())._rows.scale, [0.1, 1, 2, 0])
    assert_array_equal(ObservationNoise(Walk(), keys=["desired_goal"])._rows.scale, [1, 1])
    assert_array_equal(ObservationNoise(vehicle(n_obstacles=2))._rows.scale, np.ones(10))
    assert_array_equal(ObservationNoise(BoxWalk(), noise_scale=[3, 4])._rows.scale, [3, 4, 3, 4])
    both = {"obstacle": 2.0, "desired_goal": [5, 6]}
    scale = ObservationNoise(Walk(), keys=["desired_goal", "obstacle"], noise_scale=both)._rows.scale
    assert_array_equal(scale, [5, 6, 2, 2, 2, 2])


@pytest.mark.parametrize("env_id", rise_envs.ENVS)
def test_noise_in_a_group_of_every_environment(env_id):
    """Columns by hand: D positions, D velocities, a radius."""
    with gym.make(env_id) as env:
        dim = {5: 2, 7: 3}[env.observation_space["obstacle"].shape[0]]
        for group, columns in (
            ("position", range(dim)),
            ("velocity", range(dim, 2 * dim)),
            ("radius", [2 * dim]),
        ):
            observation, info = ObservationNoise(env, f"step@{group}").reset(seed=0)
            changed = observation["obstacle"] != info["clean_observation"]["obstacle"]
            assert np.flatnonzero(changed).tolist() == list(columns)


def test_groups_of_several_obstacles_and_of_several_keys():
    observation, info = ObservationNoise(vehicle(n_obstacles=2), "step@radius").reset(seed=0)
    changed = observation["obstacle"] != info["clean_observation"]["obstacle"]
    assert np.flatnonzero(changed).tolist() == [4, 9]
    batch = VectorObservationNoise(gym.make_vec("RISE-GroundVehicle-v0", 2, n_obstacles=2), "step@velocity")
    observation, info = batch.reset(seed=0)
    changed = observation["obstacle"] != info["clean_observation"]["obstacle"]
    assert np.flatnonzero(changed[0]).tolist() == np.flatnonzero(changed[1]).tolist() == [2, 3, 7, 8]
    named = {"desired_goal": {"mine": [1]}, "obstacle": {"mine": [0, 3]}}
    env = ObservationNoise(
        Walk(), "step@mine", ["desired_goal", "obstacle"], noise_scale=1.0, noise_channels=named
    )
    observation, info = env.reset(seed=0)
    clean = info["clean_observation"]
    assert ((observation["desired_goal"] != clean["desired_goal"]) == [False, True]).all()
    assert ((observation["obstacle"] != clean["obstacle"]) == [[True, False], [False, True]]).all()


@pytest.mark.parametrize("array", [list, np.array])
def test_a_spec_keeps_groups_and_scale(array):
    scale, groups = {"obstacle": array([0.5, 1.0, 1.0, 1.0, 2.0])}, {"obstacle": {"mine": array([0, 4])}}
    env = ObservationNoise(vehicle(), "step@mine", noise_scale=scale, noise_channels=groups)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert_equal(episode(again, seed=1)[0], episode(env, seed=1)[0])


class Plain(gym.Env):
    action_space = spaces.Discrete(2)

    def __init__(self, space):
        self.observation_space = space


FLOATS = spaces.Box(-1, 1, (3,), np.float32)


@pytest.mark.parametrize(
    ("space", "arguments", "message"),
    [
        (FLOATS, {"noise_level": -1}, "noise_level"),
        (FLOATS, {"noise_level": np.nan}, "noise_level"),
        (FLOATS, {"noise_level": "1"}, "noise_level"),
        (FLOATS, {"noise": "gaussian"}, "unknown noise model"),
        (FLOATS, {"noise_scale": -1}, "noise_scale.*≥ 0"),
        (FLOATS, {"noise_scale": [1, 2, np.nan]}, "noise_scale.*finite"),
        (FLOATS, {"noise_scale": [1, 2]}, r"noise_scale.*broadcast to \(3,\)"),
        (FLOATS, {"noise_scale": "big"}, "noise_scale"),
        (FLOATS, {"noise_scale": {"a": 1}}, "noise_scale must have the noised keys"),
        (
            FLOATS,
            {"noise": "step@x"},
            "no group 'x' of reading channels, the environment names none: pass noise_ch",
        ),
        (
            FLOATS,
            {"noise": "step@x", "noise_channels": {"y": [0]}},
            "no group 'x' of reading channels, there are: y",
        ),
        (
            FLOATS,
            {"noise_channels": {"x": [3]}},
            "noise_channels of 'observation' must be lists.*from 0 to 2",
        ),
        (FLOATS, {"noise_channels": {"x": [0.5]}}, "noise_channels.*whole numbers"),
        (FLOATS, {"noise_channels": {"x": 1}}, "noise_channels.*lists"),
        (FLOATS, {"noise_channels": {"x": []}}, "noise_channels.*lists"),
        (FLOATS, {"noise_channels": {"x": [-1]}}, "noise_channels.*from 0"),
        (FLOATS, {"noise_channels": [0]}, "noise_channels.*by group"),
        (spaces.Dict(a=FLOATS), {"keys": "a", "noise_channels": {"x": [0]}}, r"noised keys, of \['a'\]"),
        (FLOATS, {"keys": ("a",)}, "need a Dict observation space"),
        (spaces.Box(0, 255, (3,), np.uint8), {}, "Box of floats"),
        (spaces.Discrete(3), {}, "Box of floats"),
        (spaces.Dict(a=FLOATS, b=FLOATS), {}, r"keys must name what to noise, some of \['a', 'b'\]"),
        (spaces.Dict(a=FLOATS), {"keys": ["x"]}, r"keys must be some of \['a'\]"),
        (spaces.Dict(a=FLOATS), {"keys": ()}, "keys must be some of"),
        (spaces.Dict(a=spaces.Discrete(2)), {"keys": "a"}, "observation 'a' is Discrete"),
        (spaces.Dict(a=spaces.Dict(b=FLOATS)), {"keys": "a"}, "Box of floats"),
        (spaces.Dict(a=FLOATS, b=FLOATS), {"keys": "a", "noise_scale": {"b": 1}}, "noised keys"),
    ],
)
def test_wrong_arguments(space, arguments, message):
    with pytest.raises(ValueError, match=message):
        ObservationNoise(Plain(space), **arguments)


def test_step_before_reset():
    class Careless(Walk):
        def step(self, action):
            return self.observation_space.sample(), 0.0, False, False, {}

    with pytest.raises(gym.error.ResetNeeded):
        ObservationNoise(Careless()).step(np.zeros(2))


def test_what_is_recorded_gets_the_noise_that_it_would_have_met():
    seeds, noise = [5, 8], "step+drift:0.2+delay:1"
    clean, noisy = [], []
    for seed in seeds:
        env = ObservationNoise(vehicle(), noise, noise_scale=0.5)
        observation, info = env.reset(seed=0, options={"noise_seed": seed})
        steps = [(observation, info), *(env.step(np.ones(2, np.float32))[::4] for _ in range(9))]
        noisy.append([each["obstacle"] for each, _ in steps])
        clean.append([info["clean_observation"]["obstacle"] for _, info in steps])
    assert_array_equal(corrupt(noise, np.array(clean), 0.5, noise_keys(seeds)), noisy)


@pytest.mark.parametrize("noise", ["episode", make_noise("drift:1e-05@position") + Delay(3)])
def test_a_spec_rebuilds_the_wrapper(noise):
    env = ObservationNoise(vehicle(), noise, noise_level=0.5)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert_equal(episode(again, seed=1)[0], episode(env, seed=1)[0])


# The vector environment against single ones

N = 3


def reference(make, mode, **arguments):
    return SyncVectorEnv([lambda: ObservationNoise(make(), **arguments)] * N, autoreset_mode=mode)


def run(env, mode, n_steps=25, **reset):
    """Everything a vector environment hands out under fixed actions, resets of several kinds included."""
    rng = np.random.default_rng(0)
    log = [env.reset(**reset)]
    for t in range(n_steps):
        actions = rng.uniform(-1, 1, (N, 2)).astype(np.float32)
        log.append(env.step(actions))
        done = log[-1][2] | log[-1][3]
        if mode == AutoresetMode.DISABLED and done.any():
            seeds = [None if i else 100 + t for i in range(N)]
            log.append(env.reset(options={"reset_mask": done}, seed=seeds if t % 2 else None))
        if t == 10:
            log.append(env.reset(seed=[5, 3, 9]))
        if t == 18:
            log.append(env.reset())
    return log


def assert_same(ours, theirs):
    """Equal, where Gymnasium's masks say that there is something to compare."""
    if isinstance(theirs, dict):
        assert ours.keys() == theirs.keys()
        for key, value in theirs.items():
            if f"_{key}" in theirs and not isinstance(value, dict):
                mask = theirs[f"_{key}"]
                assert_same(list(ours[key][mask]), list(value[mask]))
            else:
                assert_same(ours[key], value)
    elif isinstance(theirs, list | tuple):
        assert len(ours) == len(theirs)
        for a, b in zip(ours, theirs, strict=True):
            assert_same(a, b)
    else:
        assert np.asarray(ours).dtype == np.asarray(theirs).dtype
        assert_array_equal(ours, theirs)


@pytest.mark.parametrize("noise", MODELS)
@pytest.mark.parametrize("mode", MODES, ids=str)
@pytest.mark.parametrize("make", [Walk, BoxWalk])
def test_the_twin_gives_what_wrapped_environments_give(make, mode, noise):
    arguments = {"noise": noise} | ({} if make is Walk else {"noise_channels": GROUPS})
    twin = VectorObservationNoise(SyncVectorEnv([make] * N, autoreset_mode=mode), **arguments)
    theirs = run(reference(make, mode, **arguments), mode, seed=4)
    assert_same(run(twin, mode, seed=4), theirs)
    ends = [step[2] | step[3] for step in theirs if len(step) == 5]
    assert np.sum(ends, axis=0).min() >= 2, "every row must have gone through a reset"


@pytest.mark.parametrize("noise", ["step", "step@velocity"])
@pytest.mark.parametrize("mode", MODES, ids=str)
def test_the_twin_of_processes(mode, noise):
    twin = VectorObservationNoise(AsyncVectorEnv([Walk] * N, autoreset_mode=mode), noise)
    try:
        assert_same(run(twin, mode, seed=4), run(reference(Walk, mode, noise=noise), mode, seed=4))
    finally:
        twin.close()


@pytest.mark.parametrize("noise", [*MODELS[1:3], MODELS[-1]])
@pytest.mark.parametrize("mode", MODES, ids=str)
def test_the_twin_of_a_native_vector_environment(mode, noise):
    native = gym.make_vec(
        "RISE-GroundVehicle-v0",
        num_envs=N,
        vectorization_mode="vector_entry_point",
        max_episode_steps=4,
        autoreset_mode=mode,
    )
    twin = VectorObservationNoise(native, noise)
    assert_same(run(twin, mode, seed=4), run(reference(vehicle, mode, noise=noise), mode, seed=4))


def test_the_last_observation_is_noised_as_in_the_single_environment():
    """By hand, without any other code of the vector kind."""
    single = ObservationNoise(Walk(), "step+delay")
    twin = VectorObservationNoise(SyncVectorEnv([Walk], autoreset_mode="SameStep"), "step+delay")
    single.reset(seed=2)
    twin.reset(seed=2)
    for _ in range(4):
        while True:
            observation, _, terminated, _, info = single.step(np.zeros(2, np.float32))
            batch, _, _, _, infos = twin.step(np.zeros((1, 2), np.float32))
            if terminated:
                break
            assert_array_equal(batch["obstacle"][0], observation["obstacle"])
        last, clean = infos["final_obs"][0], infos["final_info"]["clean_observation"]
        assert_array_equal(last["obstacle"], observation["obstacle"])
        assert_array_equal(clean["obstacle"][0], info["clean_observation"]["obstacle"])
        observation, _ = single.reset()
        assert_array_equal(batch["obstacle"][0], observation["obstacle"])


@pytest.mark.parametrize("mode", MODES, ids=str)
def test_noise_seeds_of_a_batch(mode):
    twin = VectorObservationNoise(SyncVectorEnv([Walk] * N, autoreset_mode=mode), "episode")
    batch, _ = twin.reset(seed=1, options={"noise_seed": np.array([7, 8, 7])})
    for i, noise_seed in enumerate((7, 8, 7)):
        observation, _ = ObservationNoise(Walk(), "episode").reset(
            seed=1 + i, options={"noise_seed": noise_seed}
        )
        assert_array_equal(batch["obstacle"][i], observation["obstacle"])
    # A mask: the others keep what they were given.
    mask = np.array([False, True, False])
    options = {"noise_seed": [1, 2, 3], "reset_mask": mask}
    after, infos = twin.reset(seed=[50, 60, 70], options=options)
    assert list(options) == ["noise_seed", "reset_mask"]
    observation, _ = ObservationNoise(Walk(), "episode").reset(seed=60, options={"noise_seed": 2})
    assert_array_equal(after["obstacle"][1], observation["obstacle"])
    assert_array_equal(after["obstacle"][[0, 2]], batch["obstacle"][[0, 2]])
    assert_array_equal(infos["_clean_observation"], mask)
    with pytest.raises(ValueError, match="noise_seed"):
        twin.reset(options={"noise_seed": [1, 2]})


def test_spaces_scale_and_info_of_the_twin():
    for vector in (SyncVectorEnv, AsyncVectorEnv):
        twin = VectorObservationNoise(vector([Walk] * N))
        try:
            assert_array_equal(twin._rows.scale, [0.1, 1, 2, 0])
        finally:
            twin.close()
    assert twin.single_observation_space == ObservationNoise(Walk()).observation_space
    twin = VectorObservationNoise(SyncVectorEnv([BoxWalk] * N))
    batch, infos = twin.reset(seed=0)
    assert twin.observation_space.contains(batch)
    assert infos["clean_observation"].shape == (N, 2, 2)
    listed = DictInfoToList(VectorObservationNoise(SyncVectorEnv([Walk] * N)))
    _, infos = listed.reset(seed=0)
    assert Walk.observation_space.contains({**infos[2]["clean_observation"]})


def test_what_the_twin_refuses():
    env = SyncVectorEnv([Walk])
    del env.metadata["autoreset_mode"]
    with pytest.raises(ValueError, match="autoreset_mode"):
        VectorObservationNoise(env)
    with pytest.raises(ValueError, match="keys must be"):
        VectorObservationNoise(SyncVectorEnv([Walk]), keys="x")
    with pytest.raises(gym.error.ResetNeeded):
        twin = VectorObservationNoise(gym.make_vec("RISE-GroundVehicle-v0", 2))
        twin.step(np.zeros((2, 2), np.float32))


def test_other_wrappers_go_around_it():
    make = functools.partial(ObservationNoise, noise="episode")
    sync = gym.make_vec("RISE-GroundVehicle-v0", 2, vectorization_mode="sync", wrappers=(make,))
    twin = VectorObservationNoise(gym.make_vec("RISE-GroundVehicle-v0", 2), "episode")
    assert_same(twin.reset(seed=3), sync.reset(seed=3))


# Wrappers around wrappers


class Known(gym.Wrapper):
    """Somebody's wrapper, who knows how well the sensors of what is inside do."""

    noise_scale = {"observation": [3.0, 4.0]}  # noqa: RUF012
    noise_channels = {"observation": {"second": [1, 3]}}  # noqa: RUF012

    def __init__(self):
        super().__init__(BoxWalk())


def test_what_a_wrapper_publishes_counts():
    single = ObservationNoise(gym.wrappers.TimeLimit(Known(), 5), "step@second")
    batch = VectorObservationNoise(SyncVectorEnv([Known]), "step@second")
    observation, info = single.reset(seed=0)
    changed = observation != info["clean_observation"]
    assert_array_equal(changed, [[False, True], [False, True]])
    assert_array_equal(single._rows.scale, [3, 4, 3, 4])
    assert_array_equal(batch.reset(seed=0)[0][0], observation)


def twice(env, wrap):
    """Noise of the same model on two parts, the second a bias on top of the first."""
    inner = wrap(env, "episode", "desired_goal")
    return wrap(inner, "episode", ["obstacle", "desired_goal"], noise_scale=1.0)


def test_noise_upon_noise_has_a_stream_of_its_own():
    """Two independent biases of deviation 1 on the goal, and one of deviation 1 on the obstacle."""
    errors, n = [], 3000
    env = twice(Walk(), ObservationNoise)
    for seed in range(n):
        observation, info = env.reset(seed=seed)
        goal = observation["desired_goal"] - env.unwrapped.buffer["desired_goal"]
        errors.append([*goal, *(observation["obstacle"] - env.unwrapped.buffer["obstacle"]).flat])
        assert_equal(info["clean_observation"], env.unwrapped.buffer)
    expected = np.diag([2.0, 2, 1, 1, 1, 1])
    np.testing.assert_allclose(np.cov(np.transpose(errors)), expected, atol=4.5 * 2 * np.sqrt(2 / n))


@pytest.mark.parametrize("mode", MODES, ids=str)
@pytest.mark.parametrize("inside", [0, 1, 2], ids=["both-outside", "one-inside", "both-inside"])
def test_noise_upon_noise_is_the_same_single_and_batched(inside, mode):
    def make():
        env = Walk()
        for wrapper in range(inside):
            env = ObservationNoise(env, MODELS[wrapper])
        return env

    ours = SyncVectorEnv([make] * N, autoreset_mode=mode)
    for wrapper in range(inside, 2):
        ours = VectorObservationNoise(ours, MODELS[wrapper])
    both = SyncVectorEnv(
        [lambda: ObservationNoise(ObservationNoise(Walk(), MODELS[0]), MODELS[1])] * N, autoreset_mode=mode
    )
    assert_same(run(ours, mode, seed=4), run(both, mode, seed=4))
