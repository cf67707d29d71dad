"""Whatever is handed in and makes no sense is refused by name, and leaves no trace: over the registries."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import re
from collections.abc import Iterator
from typing import Any, get_args, get_origin, get_type_hints

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import batch_space

from rise_agents import AGENTS, agent_class, make_agent
from rise_agents.experts import EXPERTS, make_expert
from rise_envs import ENVS, NOISE_MODELS, ObservationNoise, VectorObservationNoise, make_noise
from rise_envs.noise_models import Delay
from rise_envs.task import env_class, task_of

VEHICLE = "RISE-GroundVehicle-v0"
NATIVE = [env_id for env_id, (_, vector_entry, _) in ENVS.items() if vector_entry]
READ = ("observation", "desired_goal", "obstacle")


def same(a: Any, b: Any) -> None:
    """The same numbers in the same nesting, tensors among them."""
    np.testing.assert_equal(on_host(a), on_host(b))


def on_host(nested: Any) -> Any:
    if isinstance(nested, dict):
        return {key: on_host(part) for key, part in nested.items()}
    if isinstance(nested, tuple):
        return tuple(map(on_host, nested))
    return nested.numpy() if isinstance(nested, torch.Tensor) else nested


# --- actions --------------------------------------------------------------------------------------------------


def wrong_actions(shape: tuple[int, ...]) -> dict[str, Any]:
    """Actions that no environment with actions of this shape takes."""
    last = np.zeros(shape)
    last.flat[-1] = np.nan
    return {
        "nan": last,
        "nan, single": last.astype(np.float32),
        "inf": np.full(shape, np.inf),
        "-inf": np.full(shape, -np.inf),
        "longer": np.zeros((*shape[:-1], shape[-1] + 1)),
        "shorter": np.zeros((*shape[:-1], shape[-1] - 1)),
        "deeper": np.zeros((1, *shape)),
        "number": 0.0,
        "empty": [],
        "ragged": [[0.0], [0.0, 0.0]],
        "none": None,
        "dict": {"action": np.zeros(shape)},
        "text": "forward",
        "texts": np.full(shape, "1"),
        "bytes": np.full(shape, b"1"),
        "objects": np.zeros(shape, object),
        "complex": np.zeros(shape, complex),
        "bool": np.ones(shape, bool),
        "dates": np.zeros(shape, "datetime64[s]"),
    }


ACTION_KINDS = list(wrong_actions((2,)))


@pytest.fixture(scope="module", params=list(ENVS))
def pair(request: pytest.FixtureRequest) -> Iterator[tuple[Any, Any]]:
    """Two environments of a kind: one that is ill-treated, one that is not."""
    made = gym.make(request.param).unwrapped, gym.make(request.param).unwrapped
    yield made
    for env in made:
        env.close()


def assert_same_episodes(env: Any, twin: Any, action: Any) -> None:
    """Where both stand, in this episode, the next one and the one that a seed names, they do the same."""
    for seed in (None, None, 5):
        same(env.step(action), twin.step(action))
        same(env.reset(seed=seed), twin.reset(seed=seed))


@pytest.mark.parametrize("kind", ACTION_KINDS)
def test_actions_of_single_environments(pair: tuple[Any, Any], kind: str) -> None:
    env, twin = pair
    env.reset(seed=3), twin.reset(seed=3)
    shape = env.action_space.shape
    for _ in range(2):
        with pytest.raises(ValueError, match="action"):
            env.step(wrong_actions(shape)[kind])
        assert_same_episodes(env, twin, np.full(shape, 0.5, np.float32))


@pytest.mark.parametrize("backend", ["numpy", "torch"])
@pytest.mark.parametrize("env_id", NATIVE)
def test_actions_of_native_vector_environments(env_id: str, backend: str) -> None:
    kwargs = {"backend": backend} if backend != "numpy" else {}
    if kwargs and "backend" not in inspect.signature(vector_class(env_id)).parameters:
        pytest.skip("it has no such backend")
    env, twin = (gym.make_vec(env_id, 3, **kwargs) for _ in range(2))
    env.reset(seed=0), twin.reset(seed=0)
    shape = env.action_space.shape
    assert shape is not None
    tensors = {"tensor": torch.full(shape, torch.nan), "bools": torch.ones(shape, dtype=torch.bool)}
    for action in (*wrong_actions(shape).values(), *tensors.values(), np.zeros(shape[1])):
        with pytest.raises(ValueError, match="action"):
            env.step(action)
    assert_same_episodes(env, twin, np.full(shape, 0.5, np.float32))


def vector_class(env_id: str) -> Any:
    module, _, name = str(ENVS[env_id][1]).partition(":")
    return getattr(__import__(module, fromlist=[name]), name)


# --- seeds and options ----------------------------------------------------------------------------------------

WRONG_SEEDS = [-1, 1.0, np.nan, "1", True, b"1", [1], np.array([1]), ..., 1j]


@pytest.mark.parametrize("seed", WRONG_SEEDS, ids=repr)
def test_seeds_of_single_environments(pair: tuple[Any, Any], seed: Any) -> None:
    env, twin = pair
    env.reset(seed=3), twin.reset(seed=3)
    for made in (env, ObservationNoise(env, "episode")):
        with pytest.raises(ValueError, match="seed"):
            made.reset(seed=seed)
    assert_same_episodes(env, twin, np.zeros(env.action_space.shape, np.float32))


def test_whole_numbers_of_any_size_and_of_numpy_are_seeds(pair: tuple[Any, Any]) -> None:
    env, twin = pair
    same(env.reset(seed=np.int64(7)), twin.reset(seed=7))
    same(env.reset(seed=2**200), twin.reset(seed=2**200))


@pytest.mark.parametrize("env_id", NATIVE)
def test_seeds_and_options_of_native_vector_environments(env_id: str) -> None:
    env, twin = gym.make_vec(env_id, 2), gym.make_vec(env_id, 2)
    noisy, clean = VectorObservationNoise(env, "drift"), VectorObservationNoise(twin, "drift")
    noisy.reset(seed=0), clean.reset(seed=0)
    wrong: list[Any] = [
        *WRONG_SEEDS[:6],
        [1],
        [1, 2, 3],
        [1, -1],
        [1, 2.5],
        [True, 1],
        "12",
        {1: 2},
        np.ones((2, 1), int),
    ]
    for seed in wrong:
        for made in (env, noisy):
            with pytest.raises(ValueError, match="seed"):
                made.reset(seed=seed)
    masks: list[Any] = [
        None,
        1,
        [1, 0],
        [True],
        [[True], [True, False]],
        ["a", "b"],
        [False, False],
        np.ones((2, 1), bool),
    ]
    for mask in masks:
        for made in (env, noisy):
            with pytest.raises(ValueError, match="reset_mask"):
                made.reset(options={"reset_mask": mask})
    for made in (env, noisy):
        with pytest.raises(ValueError, match="options"):
            made.reset(options=["reset_mask"])  # type: ignore[arg-type]
    assert_same_episodes(noisy, clean, np.zeros(env.action_space.shape, np.float32))


def test_options_that_are_no_dict(pair: tuple[Any, Any]) -> None:
    env, twin = pair
    env.reset(seed=1), twin.reset(seed=1)
    for options in ([], "noise_seed", 3):
        for made in (env, ObservationNoise(env)):
            with pytest.raises(ValueError, match="options"):
                made.reset(options=options)
    assert_same_episodes(env, twin, np.zeros(env.action_space.shape, np.float32))


@pytest.mark.parametrize(
    "noise_seed", [-1, 1.5, np.nan, "a", [1, 2, 3], True, [[1], [2, 3]], [None, 1], 1j, 2**70, {}], ids=repr
)
def test_noise_seeds(noise_seed: Any) -> None:
    wrapped = [ObservationNoise(gym.make(VEHICLE)) for _ in range(2)]
    batched = [VectorObservationNoise(gym.make_vec(VEHICLE, 2)) for _ in range(2)]
    for env, twin in (wrapped, batched):
        env.reset(seed=0), twin.reset(seed=0)
        with pytest.raises(ValueError, match="noise_seed"):
            env.reset(options={"noise_seed": noise_seed})
        action = np.zeros(env.action_space.shape or (), np.float32)
        assert_same_episodes(env, twin, action)


# --- readings on their way through the noise ------------------------------------------------------------------


class Broken(gym.Env):
    """Says ``nonsense`` (of a part, or instead of the whole observation) in the steps that ask for it."""

    observation_space = spaces.Dict(
        obstacle=spaces.Box(-9, 9, (2,), np.float64), place=spaces.Box(-9, 9, (1, 2), np.float32)
    )
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, nonsense: Any = None, whole: bool = False) -> None:
        self.nonsense, self.whole = nonsense, whole

    def _say(self, broken: bool) -> Any:
        said = {"obstacle": self.np_random.normal(size=2), "place": np.ones((1, 2), np.float32)}
        if not broken:
            return said
        return self.nonsense if self.whole else {**said, "obstacle": self.nonsense}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        return self._say(bool(options and options.get("broken"))), {}

    def step(self, action: Any) -> Any:
        return self._say(action[0] > 0), 0.0, False, False, {}


NONSENSE: dict[str, Any] = {
    "nan": np.array([0.0, np.nan]),
    "inf": np.array([np.inf, 0.0]),
    "longer": np.zeros(3),
    "single": np.zeros(1),
    "number": 1.0,
    "deeper": np.zeros((2, 1)),
    "text": np.array(["1", "2"]),
    "objects": np.array([1.0, 2.0], object),
    "complex": np.zeros(2, complex),
    "bool": np.ones(2, bool),
    "none": None,
    "ragged": [[1.0], [1.0, 2.0]],
    "tensor": torch.tensor([0.0, torch.nan]),
    "tensor of bools": torch.tensor([True, False]),
}


@pytest.mark.parametrize("noise", ["step", "dropout+delay:2"])
@pytest.mark.parametrize("nonsense", NONSENSE)
def test_readings_that_make_no_sense(nonsense: str, noise: str) -> None:
    env, twin = (ObservationNoise(Broken(NONSENSE[nonsense]), noise) for _ in range(2))
    env.reset(seed=0), twin.reset(seed=0)
    with pytest.raises(ValueError, match="'obstacle'"):
        env.step(np.ones(1))
    with pytest.raises(ValueError, match="'obstacle'"):
        env.reset(options={"broken": True})
    same(env.reset(seed=1), twin.reset(seed=1))
    assert_same_episodes(env, twin, np.zeros(1))


@pytest.mark.parametrize("observation", [None, {}, {"place": np.ones((1, 2))}, np.zeros(2)], ids=repr)
def test_observations_without_the_reading(observation: Any) -> None:
    env = ObservationNoise(Broken(observation, whole=True))
    env.reset(seed=0)
    with pytest.raises(ValueError, match="obstacle"):
        env.step(np.ones(1))


def test_the_twin_refuses_readings_that_make_no_sense() -> None:
    """Values only: Gymnasium itself stacks observations into the arrays of their space."""
    for nonsense in (NONSENSE["nan"], NONSENSE["inf"]):
        env, twin = (
            VectorObservationNoise(SyncVectorEnv([functools.partial(Broken, nonsense)] * 2), "step")
            for _ in range(2)
        )
        env.reset(seed=0), twin.reset(seed=0)
        with pytest.raises(ValueError, match=r"'obstacle' must be finite.* in row 1"):
            env.step(np.array([[0.0], [1.0]]))
        same(env.reset(seed=1), twin.reset(seed=1))
        assert_same_episodes(env, twin, np.zeros((2, 1)))


@pytest.mark.parametrize(
    "wrong", [{"noise_level": True}, {"noise_level": 10**400}, {"noise": 3}, {"noise": b"step"}]
)
def test_arguments_of_the_noise(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        ObservationNoise(Broken(), **wrong)


@pytest.mark.parametrize("name", NOISE_MODELS)
@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0, "1", None, True, [1.0], 10**400, 1j], ids=repr)
def test_parameters_of_noise_models(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{name}: "):
        NOISE_MODELS[name](value)


def test_a_level_that_delays_for_ever() -> None:
    with pytest.raises(ValueError, match="delay: steps"):
        make_noise(Delay(5000), 1e308)


# --- observations of policies ---------------------------------------------------------------------------------


POLICIES = [*AGENTS, *(f"{name} {env_id}" for env_id, name in EXPERTS)]


@pytest.fixture(scope="module")
def policies(vehicle_demonstrations: Any) -> Any:
    """Trained agents on the vehicle, and experts, each with its environment's id; made once."""
    made: dict[str, tuple[Any, str]] = {}

    def policy(name: str) -> tuple[Any, str]:
        if name not in made and name in AGENTS:
            agent = make_agent(name, VEHICLE, agent_class(name).BRIEF)
            source = vehicle_demonstrations if agent.learns_from == "demonstrations" else VEHICLE
            made[name] = agent.learn(source), VEHICLE
        elif name not in made:
            kind, env_id = name.split(" ")
            made[name] = make_expert(kind, env_id), env_id
        return made[name]

    return policy


@pytest.fixture(scope="module")
def scenes() -> Any:
    """First observations of three episodes of an environment, (3, …) each; made once."""
    made: dict[str, dict[str, np.ndarray]] = {}

    def scene(env_id: str) -> dict[str, np.ndarray]:
        if env_id not in made:
            env = gym.make(env_id)
            firsts = [env.reset(seed=seed)[0] for seed in range(3)]
            env.close()
            made[env_id] = {key: np.stack([first[key] for first in firsts]) for key in firsts[0]}
        return made[env_id]

    return scene


def wrong_parts(x: np.ndarray) -> Iterator[Any]:
    """What cannot stand for the part ``x`` of an observation."""
    for number in (np.nan, np.inf, -np.inf):
        bad = x.copy()
        bad.flat[-1] = number
        yield bad
    yield x[..., :-1]
    yield np.concatenate((x, x), -1)
    yield x[..., None]
    yield x[None, None]
    yield 0.0
    yield None
    yield "far"
    yield x.astype(str)
    yield x.astype(object)
    yield x.astype(complex)
    yield np.ones(x.shape, bool)
    yield [[1.0], [1.0, 2.0]]
    yield torch.full(x.shape, torch.nan, dtype=torch.float64)


@pytest.mark.parametrize("name", POLICIES)
def test_observations_that_make_no_sense(policies: Any, scenes: Any, name: str) -> None:
    policy, env_id = policies(name)
    batch = scenes(env_id)
    single = {key: part[0] for key, part in batch.items()}
    for observation in (single, batch):
        before = policy.predict(observation, deterministic=True)[0]
        for key in READ:
            lacking = {other: part for other, part in observation.items() if other != key}
            with pytest.raises(ValueError, match=re.escape(repr(key))):
                policy.predict(lacking)
            for part in wrong_parts(observation[key]):
                with pytest.raises(ValueError, match=r"observation\['"):
                    policy.predict({**observation, key: part})
        same(policy.predict(observation, deterministic=True)[0], before)
    for key in READ:
        for part in (batch[key][:2], batch[key][:1], batch[key][0]):
            with pytest.raises(ValueError, match=r"observation\['.* must have shape"):
                policy.predict({**batch, key: part})
        with pytest.raises(ValueError, match=r"observation\['.* must have shape"):
            policy.predict({**single, key: batch[key]})
    for nothing in (None, np.zeros(5), [single], "observation"):
        with pytest.raises(ValueError, match="observation must be a dict"):
            policy.predict(nothing)


@pytest.mark.parametrize("name", POLICIES)
def test_a_bad_observation_moves_no_stream(policies: Any, scenes: Any, name: str) -> None:
    """What is drawn after a refusal is what would have been drawn without it."""
    policy, env_id = policies(name)
    batch = scenes(env_id)
    start = getattr(policy, "initial_state", lambda keys: None)
    _, state = policy.predict(batch, start(np.arange(3, dtype=np.uint64)))
    expected, _ = policy.predict(batch, state)
    with pytest.raises(ValueError, match="obstacle"):
        policy.predict({**batch, "obstacle": np.full(batch["obstacle"].shape, np.nan)}, state)
    same(policy.predict(batch, state)[0], expected)


@pytest.mark.parametrize("name", POLICIES)
def test_lists_tensors_and_single_precision_are_observations(policies: Any, scenes: Any, name: str) -> None:
    policy, env_id = policies(name)
    batch = scenes(env_id)
    expected = policy.predict(batch, deterministic=True)[0]
    tensors = {key: torch.from_numpy(part) for key, part in batch.items()}
    lists = {key: part.tolist() for key, part in batch.items()}
    for alike in (tensors, lists, {**batch, "else": None}):
        same(policy.predict(alike, deterministic=True)[0], expected)
    rounded = {key: part.astype(np.float32) for key, part in batch.items()}
    assert np.isfinite(policy.predict(rounded, deterministic=True)[0]).all()


def test_raw_observations_that_make_no_sense() -> None:
    from toy_envs import Walk

    agent = make_agent(
        "cppo", "ToyWalk-v0", {**agent_class("cppo").BRIEF, "frame": "raw", "batch_size": 32}
    ).learn(Walk(dict_space=True))
    good = {"place": np.zeros((4, 2)), "again": np.zeros((4, 2, 1))}
    assert agent.predict(good)[0].shape == (4, 2)
    for key, part in good.items():
        with pytest.raises(ValueError, match=key):
            agent.predict({other: part for other, part in good.items() if other != key})
        wrong: list[Any] = [
            part[:3],
            part[0],
            part[None],
            None,
            "a",
            part.astype(complex),
            np.full_like(part, np.nan),
        ]
        for value in wrong:
            with pytest.raises(ValueError, match=r"observation\['"):
                agent.predict({**good, key: value})
    with pytest.raises(ValueError, match="the policy reads 4 numbers, got 5"):
        agent.predict({**good, "place": np.zeros((4, 3))})


# --- settings -------------------------------------------------------------------------------------------------


def wrong_values(kind: Any) -> list[Any]:
    """Values that no field of this annotation takes."""
    always = [None, True, [[1.0], [2.0]], {"a": 1}, 1j, b"1", object()]
    if kind is int:
        return [*always, np.nan, np.inf, 1.5, "1", -1, 10**400]
    if kind is float:
        return [*always, np.nan, np.inf, -np.inf, "1", 10**400]
    if kind is str:
        return [*always, "nonsense", 3, np.nan]
    if kind is bool:
        return [value for value in always if value is not True] + ["False", 0, 1.0]
    assert get_origin(kind) is tuple
    entries = get_args(kind)
    filler = [1 if entries[0] is int else 1.0] * len(entries)
    nested = [(wrong, *filler[1:]) for wrong in wrong_values(entries[0])]
    return [*always, np.nan, 3, "1", (), *nested]


def fields_of(kind: Any) -> list[tuple[str, Any]]:
    hints = get_type_hints(kind)
    return [(field.name, hints[field.name]) for field in dataclasses.fields(kind)]


@pytest.mark.parametrize("name", AGENTS)
def test_every_setting_of_every_agent(name: str) -> None:
    for field, kind in fields_of(agent_class(name).Config):
        for value in wrong_values(kind):
            with pytest.raises(ValueError, match=field):
                make_agent(name, VEHICLE, {field: value})


@pytest.mark.parametrize("name", AGENTS)
def test_arguments_of_make_agent(name: str) -> None:
    for config in (["updates"], "updates", 3):
        with pytest.raises(ValueError, match="config"):
            make_agent(name, VEHICLE, config)  # type: ignore[arg-type]
    for seed in WRONG_SEEDS:
        with pytest.raises(ValueError, match="seed"):
            make_agent(name, VEHICLE, seed=seed)
    make_agent(name, VEHICLE, {"hidden": [np.int64(8), 8]})  # lists and NumPy's numbers are settings
    with pytest.raises(ValueError, match="seed"):
        make_expert("cbf", VEHICLE, seed=-1)


def default_params(env_id: str) -> Any:
    return inspect.signature(env_class(env_id)).parameters["params"].default


@pytest.mark.parametrize("env_id", ENVS)
def test_every_parameter_of_every_environment(env_id: str) -> None:
    defaults = default_params(env_id)
    for field, kind in fields_of(type(defaults)):
        for value in wrong_values(kind):
            with pytest.raises(ValueError, match=field):
                dataclasses.replace(defaults, **{field: value})
        corner = getattr(defaults, field)
        if kind is float and field not in ("v_min", "start_clearance"):
            with pytest.raises(ValueError, match=field):
                dataclasses.replace(defaults, **{field: -1.0})
        elif field in ("goal_distance", "radius", "placed", "obstacle_radius", "obstacle_along"):
            with pytest.raises(ValueError, match=field):
                dataclasses.replace(defaults, **{field: corner[::-1]})


@pytest.mark.parametrize("env_id", ENVS)
def test_params_as_a_dict(env_id: str) -> None:
    for make in (gym.make, *([lambda i, **kw: gym.make_vec(i, 2, **kw)] if env_id in NATIVE else [])):
        with pytest.raises(ValueError, match=r"unknown setting 'goal_radus'.* did you mean 'goal_radius'"):
            make(env_id, params={"goal_radus": 0.5})
        with pytest.raises(ValueError, match="goal_radius"):
            make(env_id, params={"goal_radius": np.nan})
        for params in (None, 3, "params", [("goal_radius", 0.5)]):
            with pytest.raises(ValueError, match="params"):
                make(env_id, params=params)
        env: Any = make(env_id, params={"goal_radius": 0.11})
        assert env.unwrapped.params == dataclasses.replace(default_params(env_id), goal_radius=0.11)
        env.close()
    assert task_of(env_id, params={"goal_radius": 0.11}).goal_radius == 0.11


@pytest.mark.parametrize("env_id", ENVS)
def test_arguments_of_every_environment(env_id: str) -> None:
    known = inspect.signature(env_class(env_id)).parameters
    for flag in ("False", 1, None, np.nan):
        with pytest.raises(ValueError, match="terminate_on_collision"):
            gym.make(env_id, terminate_on_collision=flag)
    for reward_type in (None, 3, [], "Dense"):
        with pytest.raises(ValueError, match="reward_type"):
            gym.make(env_id, reward_type=reward_type)
    for n_obstacles in (0, True, 1.0, np.nan, np.inf, "1", None) if "n_obstacles" in known else ():
        with pytest.raises(ValueError, match="n_obstacles"):
            gym.make(env_id, n_obstacles=n_obstacles)


@pytest.mark.parametrize("env_id", NATIVE)
@pytest.mark.parametrize("name", ["num_envs", "max_episode_steps"])
@pytest.mark.parametrize("count", [0, -3, 1.5, np.nan, True, "2", 10**400], ids=repr)
def test_numbers_of_native_vector_environments(env_id: str, name: str, count: Any) -> None:
    with pytest.raises(ValueError, match=name):
        vector_class(env_id)(**{name: count})


@pytest.mark.parametrize("env_id", ENVS)
def test_the_task_tells_the_shapes_of_the_observations(env_id: str, scenes: Any) -> None:
    """They are what every policy's observations are checked against."""
    assert {key: part.shape[1:] for key, part in scenes(env_id).items() if key in READ} == task_of(
        env_id
    ).shapes


# --- environments to train in ---------------------------------------------------------------------------------


def test_an_environment_of_tensors_is_refused() -> None:
    venv = gym.make_vec(VEHICLE, 4, autoreset_mode=AutoresetMode.SAME_STEP, backend="torch")
    with pytest.raises(ValueError, match=r"observations of NumPy.* as torch\.Tensor"):
        make_agent("cppo", VEHICLE, agent_class("cppo").BRIEF).learn(venv)


@pytest.mark.parametrize("key", READ)
@pytest.mark.parametrize("frame", ["world", "body", "features"])
def test_an_environment_without_what_the_frame_reads_is_refused(key: str, frame: str) -> None:
    venv = gym.make_vec(VEHICLE, 4, autoreset_mode=AutoresetMode.SAME_STEP)
    parts = {name: part for name, part in venv.single_observation_space.spaces.items() if name != key}
    venv.single_observation_space = spaces.Dict(parts)
    venv.observation_space = batch_space(venv.single_observation_space, 4)
    with pytest.raises(ValueError, match=f"'{key}'.*raw"):
        make_agent("cppo", VEHICLE, {**agent_class("cppo").BRIEF, "frame": frame}).learn(venv)
    box = gym.make_vec(
        "CartPole-v1", 4, vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP}, vectorization_mode="sync"
    )
    with pytest.raises(ValueError, match="raw"):
        make_agent("cppo", VEHICLE, {**agent_class("cppo").BRIEF, "frame": frame}).learn(box)
