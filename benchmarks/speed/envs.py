"""What environments cost: a step, alone and in a batch, and the memory of one vehicle among many."""

from __future__ import annotations

import gc
import time
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv

import rise_envs  # noqa: F401  registers the environments
from benchmarks.speed.measure import Effort, Sides, Unavailable, paced, rate
from rise_agents.workers import available_cores
from rise_envs.panda_sim import silence

VEHICLE, PANDA, ARMS = "RISE-GroundVehicle-v0", "RISE-SafePanda-v0", "RISE-SafePandaKinematic-v0"
CARTPOLE, REACH = "CartPole-v1", "PandaReach-v3"
_ACTIONS = 16  # batches of actions that are drawn beforehand and used in turn

Work = Callable[[], int]  # takes some steps and says how many


def make(env_id: str) -> gym.Env:
    """A single environment, quietly."""
    with silence():  # Bullet's build lines
        if env_id == REACH:
            import panda_gym  # noqa: F401  registers it
        env = gym.make(env_id)
        env.reset(seed=0)
    return env


def steps_alone(env: gym.Env, steps: int) -> Work:
    """``steps`` random steps, and a reset after each end of an episode."""
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(steps)]

    def work() -> int:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
        return steps

    return work


def make_batch(env_id: str, num_envs: int, **kwargs: Any) -> VectorEnv:
    """The native batched form of an environment."""
    return gym.make_vec(env_id, num_envs, vectorization_mode="vector_entry_point", **kwargs)


def steps_together(env: VectorEnv, env_id: str, device: str | None = None) -> Work:
    """Random steps of a batch through one whole cycle of episodes, so that each reset is counted once.

    Args:
        env: not reset yet.
        env_id: whose time limit is the length of a cycle.
        device: where the actions lie, as tensors; None: NumPy arrays.
    """
    limit = gym.spec(env_id).max_episode_steps
    cycle = min(limit or 200, 200) + 1  # one step of autoreset
    env.action_space.seed(0)
    actions: list[Any] = [env.action_space.sample() for _ in range(_ACTIONS)]
    finish: Callable[[], Any] = str  # nothing
    if device:
        import torch

        actions = [torch.as_tensor(action, device=device) for action in actions]
        finish = torch.cuda.synchronize if device.startswith("cuda") else str
    env.reset(seed=0)

    def work() -> int:
        for step in range(cycle):
            env.step(actions[step % _ACTIONS])
        finish()
        return cycle * env.num_envs

    return work


@contextmanager
def alone(env_id: str, peer_id: str, effort: Effort, steps: int) -> Iterator[Sides]:
    """Two environments through ``make``, ``steps`` a piece."""
    env, peer = make(env_id), make(peer_id)
    ours, theirs = steps_alone(env, steps), steps_alone(peer, steps)
    try:
        yield paced(ours, theirs, effort)
    finally:
        env.close()
        peer.close()


def vehicle(effort: Effort) -> Any:
    """One vehicle against one CartPole."""
    return alone(VEHICLE, CARTPOLE, effort, 1_000)


def panda(effort: Effort) -> Any:
    """Bullet's arm with its sphere against panda-gym's without."""
    return alone(PANDA, REACH, effort, 50)


@contextmanager
def vehicles(effort: Effort) -> Iterator[Sides]:
    """Batched vehicles against batched CartPoles."""
    count = effort.size(1_000, 10)
    env, peer = make_batch(VEHICLE, count), make_batch(CARTPOLE, count)
    ours, theirs = steps_together(env, VEHICLE), steps_together(peer, CARTPOLE)
    yield paced(ours, theirs, effort)
    env.close()
    peer.close()


def make_torch_vehicles(count: int, device: str) -> VectorEnv:
    """Batched vehicles on a torch device; on the CPU they share its cores."""
    import torch

    torch.set_num_threads(available_cores())
    return make_batch(VEHICLE, count, backend="torch", device=device)


@contextmanager
def vehicles_torch(effort: Effort) -> Iterator[Sides]:
    """Batched vehicles in torch, on all cores, against the same in NumPy, which uses one."""
    count = effort.size(100_000, 10)
    env, peer = make_torch_vehicles(count, "cpu"), make_batch(VEHICLE, count)
    ours, theirs = steps_together(env, VEHICLE, "cpu"), steps_together(peer, VEHICLE)
    yield replace(paced(ours, theirs, effort), note=lambda: f"torch on {available_cores()} threads")
    env.close()
    peer.close()


@contextmanager
def arms(effort: Effort) -> Iterator[Sides]:
    """Batched kinematic arms against panda-gym's single one."""
    env, peer = make_batch(ARMS, effort.size(1_000, 8)), make(REACH)
    ours, theirs = steps_together(env, ARMS), steps_alone(peer, 50)
    yield paced(ours, theirs, effort)
    env.close()
    peer.close()


@contextmanager
def vehicles_cuda(effort: Effort) -> Iterator[Sides]:
    """Batched vehicles on the GPU against NumPy on the CPU, and how near to the memory's speed they come."""
    import torch

    if not torch.cuda.is_available():
        raise Unavailable("no CUDA device here")
    count = effort.size(1_000_000, 1_000)
    env, peer = make_torch_vehicles(count, "cuda"), make_batch(VEHICLE, effort.size(100_000, 1_000))
    ours, theirs = steps_together(env, VEHICLE, "cuda"), steps_together(peer, VEHICLE)
    figures: list[float] = []

    def side() -> float:
        figures.append(rate(ours, effort.seconds))
        return figures[-1]

    def note() -> str:
        needed, copied = step_bytes(env, "cuda"), copy_bandwidth("cuda")
        share = needed * float(np.median(figures)) / copied
        return (
            f"{count:,} vehicles; a step must move {needed:.0f} bytes a vehicle: {100 * share:.0f} % of the "
            f"{copied / 1e9:,.0f} GB/s of a copy"
        )

    yield Sides(side, lambda: rate(theirs, effort.seconds), note)
    env.close()
    peer.close()


def step_bytes(env: VectorEnv, device: str) -> float:
    """Bytes that a step must move for each environment: the state in and out, the action in, the answers out."""
    import torch

    action = torch.as_tensor(env.action_space.sample(), device=device)
    answers = env.step(action)
    unwrapped: Any = env.unwrapped
    state = tensor_bytes(vars(unwrapped.world))
    return (2 * state + tensor_bytes(action) + tensor_bytes(answers)) / env.num_envs


def tensor_bytes(tree: Any) -> int:
    """Bytes of all tensors and arrays in nested mappings and sequences, each counted once."""
    seen: dict[int, int] = {}

    def visit(node: Any) -> None:
        if hasattr(node, "nbytes"):
            seen[id(node)] = node.nbytes
        elif isinstance(node, dict):
            for child in node.values():
                visit(child)
        elif isinstance(node, (tuple, list)):
            for child in node:
                visit(child)

    visit(tree)
    return sum(seen.values())


def copy_bandwidth(device: str, size: int = 1 << 30, copies: int = 10) -> float:
    """Bytes read and written per second where one large tensor is copied to another."""
    import torch

    source = torch.zeros(size, dtype=torch.uint8, device=device)
    target = torch.empty_like(source)
    target.copy_(source)
    torch.cuda.synchronize()
    started = time.perf_counter()
    for _ in range(copies):
        target.copy_(source)
    torch.cuda.synchronize()
    return 2 * size * copies / (time.perf_counter() - started)


@contextmanager
def memory(effort: Effort) -> Iterator[Sides]:
    """Bytes that one more vehicle in a batch holds between steps, the last observations and infos included."""
    few, many = 1_000, effort.size(100_000, 2_000)
    found: dict[str, float] = {}

    def side() -> float:
        small, large = traced(few), traced(many)
        found.update({key: (large[key] - small[key]) / (many - few) for key in large})
        return found["held"]

    yield Sides(
        side,
        note=lambda: (
            f"at most {found['step']:,.0f} bytes within a step, {found['reset']:,.0f} within reset(seed)"
        ),
    )


def traced(num_envs: int) -> dict[str, int]:
    """Bytes that a batch of vehicles holds after a few steps, and the most within its reset and within a step."""
    gc.collect()
    started = not tracemalloc.is_tracing()
    if started:
        tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        env = make_batch(VEHICLE, num_envs)
        answers: Any = env.reset(seed=0)
        most = {"reset": tracemalloc.get_traced_memory()[1] - before}
        actions = env.action_space.sample()
        drawn = actions.nbytes
        for _ in range(3):
            tracemalloc.reset_peak()
            answers = env.step(actions)
        most["step"] = tracemalloc.get_traced_memory()[1] - before - drawn
        gc.collect()
        held = tracemalloc.get_traced_memory()[0] - before - drawn
        del answers
        env.close()
    finally:
        if started:
            tracemalloc.stop()
    return {"held": held, **most}
