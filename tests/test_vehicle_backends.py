"""The batched vehicle's backends: NumPy and torch, compiled and not, are one and the same environment."""

from __future__ import annotations

import multiprocessing
import pickle
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode

from rise_agents import AGENTS, agent_class, make_agent
from rise_agents.demonstrations import generate
from rise_envs import shared
from rise_envs.noise import NOISE_MODELS
from rise_envs.noise_wrappers import VectorObservationNoise
from rise_envs.vehicle_world import Params

ID = "RISE-GroundVehicle-v0"
OTHERS = {
    "NumPy, array by array": {"compiled": False},
    "torch": {"backend": "torch"},
    "torch, tensor by tensor": {"backend": "torch", "compiled": False},
}
KINDS = {
    "default": {},
    "sparse-collision-3-discs": {"n_obstacles": 3, "terminate_on_collision": True, "reward_type": "sparse"},
}


def make(n: int = 40, mode: AutoresetMode = AutoresetMode.NEXT_STEP, **kwargs: Any) -> Any:
    return gym.make_vec(ID, n, vectorization_mode="vector_entry_point", autoreset_mode=mode, **kwargs)


def as_numpy(nested: Any) -> Any:
    if isinstance(nested, torch.Tensor):
        return nested.numpy()
    if isinstance(nested, dict):
        return {key: as_numpy(value) for key, value in nested.items()}
    return tuple(map(as_numpy, nested)) if isinstance(nested, tuple) else nested


def assert_same(a: Any, b: Any, where: str, rtol: float = 0.0) -> None:
    if isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            assert_same(a[key], b[key], f"{where}/{key}", rtol)
    elif isinstance(a, tuple):
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_same(x, y, f"{where}[{i}]", rtol)
    else:
        assert a.dtype == b.dtype, where
        np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol, err_msg=where)


def without_finals(out: Any) -> Any:
    """``final_obs``, of which NumPy gives dictionaries and torch a batch, apart."""
    if isinstance(out[-1], dict) and "final_obs" in out[-1]:
        return (*out[:-1], {key: value for key, value in out[-1].items() if key != "final_obs"})
    return out


@pytest.mark.parametrize("mode", list(AutoresetMode))
@pytest.mark.parametrize("kwargs", KINDS.values(), ids=KINDS)
@pytest.mark.parametrize("other", OTHERS.values(), ids=OTHERS)
def test_every_backend_gives_the_same_bits(other: dict, kwargs: dict, mode: AutoresetMode) -> None:
    a, b = make(mode=mode, **kwargs), make(mode=mode, **kwargs, **other)
    out_a, out_b = a.reset(seed=3), b.reset(seed=3)
    rng, ends = np.random.default_rng(0), 0
    for step in range(230):
        assert_same(without_finals(out_a), as_numpy(without_finals(out_b)), f"step {step}")
        action = rng.uniform([0.5, -0.4], [2.6, 0.4], (40, 2)).astype(np.float32)
        given = torch.from_numpy(action) if isinstance(out_b[0]["observation"], torch.Tensor) else action
        out_a, out_b = a.step(action), b.step(given)
        ended = out_a[2] | out_a[3]
        ends += ended.sum()
        if "final_obs" in out_a[-1] and isinstance(out_b[-1]["final_obs"], dict):
            for i in np.flatnonzero(ended):
                for key, value in out_b[-1]["final_obs"].items():
                    np.testing.assert_array_equal(value[i], out_a[-1]["final_obs"][i][key])
        if mode == AutoresetMode.DISABLED and ended.any():
            out_a = a.reset(options={"reset_mask": ended})
            out_b = b.reset(options={"reset_mask": torch.from_numpy(ended) if given is not action else ended})
    assert ends >= 40


def leaves(nested: Any) -> list[Any]:
    if isinstance(nested, dict | tuple):
        return [
            leaf
            for part in (nested.values() if isinstance(nested, dict) else nested)
            for leaf in leaves(part)
        ]
    return [nested]


@pytest.mark.parametrize("compiled", [True, False])
def test_torch_hands_out_tensors_only_and_nothing_twice(compiled: bool) -> None:
    env = make(mode=AutoresetMode.SAME_STEP, backend="torch", compiled=compiled, max_episode_steps=3)
    out = env.reset(seed=0)
    for _ in range(4):
        assert all(isinstance(leaf, torch.Tensor) for leaf in leaves(out))
        arrays = [leaf.numpy() for leaf in leaves(out)]
        for i, one in enumerate(arrays):
            assert not any(np.shares_memory(one, other) for other in arrays[i + 1 :])
        kept = [array.copy() for array in arrays]
        out = env.step(torch.ones((40, 2)))
        for array, then in zip(arrays, kept, strict=True):
            np.testing.assert_array_equal(array, then)
            array[...] = 77


@pytest.mark.parametrize("kwargs", [{}, *OTHERS.values()], ids=str)
def test_a_pickled_batch_goes_on_as_its_original(kwargs: dict[str, Any]) -> None:
    env = make(3, max_episode_steps=4, **kwargs)
    env.reset(seed=2)
    action = np.ones((3, 2), np.float32)
    env.step(action)
    twin = pickle.loads(pickle.dumps(env))
    for step in range(6):
        assert_same(as_numpy(env.step(action)), as_numpy(twin.step(action)), str(step))


@pytest.mark.parametrize("compiled", [True, False])
def test_torch_takes_arrays_and_tensors_and_refuses_bad_ones(compiled: bool) -> None:
    env = make(3, backend="torch", compiled=compiled)
    env.reset(seed=0)
    before = env.unwrapped.world.copy()
    for action, message in (
        (torch.zeros(2, 2), "shape"),
        (torch.full((3, 2), torch.nan), "finite"),
        (torch.zeros((3, 2), dtype=torch.complex64), "numeric"),
        (np.full((3, 2), np.inf), "finite"),
    ):
        with pytest.raises(ValueError, match=message):
            env.step(action)
    for name, value in vars(before).items():
        np.testing.assert_array_equal(getattr(env.unwrapped.world, name), value)
    env.step(np.zeros((3, 2))), env.step(torch.zeros(3, 2, dtype=torch.bfloat16))


def test_unknown_backends_and_devices_are_named() -> None:
    with pytest.raises(ValueError, match="'numpy', 'torch'"):
        make(backend="jax")
    with pytest.raises(ValueError, match="backend='torch'"):
        make(device="cuda")
    with pytest.raises(ValueError, match="compiled=True"):
        make(backend="torch", device="meta", compiled=True)
    with pytest.raises(ValueError, match="nowhere"):
        make(backend="torch", device="nowhere")


@pytest.mark.parametrize("other", [{}, *OTHERS.values()], ids=["NumPy", *OTHERS])
def test_parameters_without_room_are_refused_and_nothing_has_started(other: dict) -> None:
    env = make(3, params=Params(start_margin=30.0), **other)
    with pytest.raises(ValueError, match="no fair start"):
        env.reset(seed=0)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros((3, 2)))


@pytest.mark.parametrize("noise", [*NOISE_MODELS, "step+dropout:0.3+delay:2@radius"])
@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_noise_on_tensors_is_that_on_arrays(noise: str, mode: AutoresetMode) -> None:
    a, b = (
        VectorObservationNoise(make(mode=mode, max_episode_steps=7, **kwargs), noise)
        for kwargs in ({}, {"backend": "torch", "compiled": False})
    )
    options = {"noise_seed": np.arange(40)}
    out_a, out_b = a.reset(seed=3, options=options), b.reset(seed=3, options=options)
    for step in range(24):
        assert isinstance(out_b[0]["obstacle"], torch.Tensor)
        assert_same(without_finals(out_a), as_numpy(without_finals(out_b)), f"step {step}", rtol=1e-12)
        if "final_obs" in out_a[-1]:
            final = out_b[-1]["final_obs"]["obstacle"].numpy()
            for i in np.flatnonzero(out_a[2] | out_a[3]):
                np.testing.assert_allclose(final[i], out_a[-1]["final_obs"][i]["obstacle"], rtol=1e-12)
        action = np.full((40, 2), 1.5, np.float32)
        out_a, out_b = a.step(action), b.step(torch.from_numpy(action))
        ended = out_a[2] | out_a[3]
        if mode == AutoresetMode.DISABLED and ended.any():
            out_a, out_b = (env.reset(options={"reset_mask": ended}) for env in (a, b))


@pytest.mark.parametrize("name", AGENTS)
def test_agents_act_on_tensors_as_on_arrays(name: str) -> None:
    agent = make_agent(name, ID, agent_class(name).BRIEF)
    agent.learn(generate(ID, "cbf", 3) if agent.learns_from == "demonstrations" else None)
    seen, tensors = (make(**kwargs).reset(seed=1)[0] for kwargs in ({}, {"backend": "torch"}))
    np.testing.assert_array_equal(
        agent.predict(tensors, deterministic=True)[0], agent.predict(seen, deterministic=True)[0]
    )


# --- threads ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rows", [1, 16, 5_000, 8_192, 20_001])
@pytest.mark.parametrize("threads", [1, 2, 3])
def test_threads_cover_every_row_once(rows: int, threads: int) -> None:
    hits = np.zeros(rows, int)

    def work(first: int, last: int) -> int:
        hits[first:last] += 1
        return first

    begins = shared.run(work, rows, threads, piece=4_096)
    assert (hits == 1).all()
    assert sorted(begins) == list(range(0, rows, 4_096))


def test_a_failing_piece_is_told() -> None:
    def work(first: int, last: int) -> None:
        if first == 16_384:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        shared.run(work, 20_000, 2, piece=4_096)


def test_threads_change_no_bit() -> None:
    alone, shared_out = make(9_000), make(9_000, backend="torch")
    out_a, out_b = alone.reset(seed=0), shared_out.reset(seed=0)
    for _ in range(5):
        action = alone.action_space.sample()
        out_a, out_b = alone.step(action), shared_out.step(action)
        assert_same(out_a, as_numpy(out_b), "threads")


def _step_in_child() -> None:
    env = make(9_000, backend="torch")
    env.reset(seed=0)
    env.step(env.action_space.sample())


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_steps_too() -> None:
    _step_in_child()  # the parent has its threads now; a child inherits none of them
    child = multiprocessing.get_context("fork").Process(target=_step_in_child)
    child.start()
    child.join(60)
    assert child.exitcode == 0
