"""What agents cost: one action, and one update of behaviour cloning."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from benchmarks.speed.envs import VEHICLE, Work, make
from benchmarks.speed.measure import Effort, Sides, Unavailable, rate

_CALLS = 200
BATCH = 1_024


@functools.cache
def recorded() -> Any:
    """A few thousand transitions to learn from."""
    from rise_agents import demonstrations

    return demonstrations.generate(VEHICLE, "cbf", 48)


def observations(env: Any, count: int) -> list[dict[str, np.ndarray]]:
    """What ``count`` random steps show."""
    env.action_space.seed(0)
    return [env.step(env.action_space.sample())[0] for _ in range(count)]


def calls(predict: Callable[..., Any], seen: list[dict[str, np.ndarray]], deterministic: bool) -> Work:
    """A call with one observation after the other, the state handed on as in a roll-out."""

    def work() -> int:
        state = None
        for observation in seen:
            _, state = predict(observation, state=state, deterministic=deterministic)
        return len(seen)

    return work


@contextmanager
def predict(effort: Effort, deterministic: bool = False) -> Iterator[Sides]:
    """RISE, of its default size, against an untrained PPO of SB3's default size, on the same observations."""
    import torch
    from stable_baselines3 import PPO

    from rise_agents import make_agent

    torch.set_num_threads(1)
    brief = {"updates": 5, "vae_updates": 5}
    agent = make_agent("rise", VEHICLE, brief).learn(recorded())
    env = make(VEHICLE)
    peer = PPO("MultiInputPolicy", env, n_steps=8, batch_size=8, device="cpu")
    seen = observations(env, _CALLS)
    ours, theirs = (calls(each.predict, seen, deterministic) for each in (agent, peer))
    yield Sides(lambda: 1e6 / rate(ours, effort.seconds), lambda: 1e6 / rate(theirs, effort.seconds))
    env.close()


@contextmanager
def onnx(effort: Effort) -> Iterator[Sides]:
    """One call of onnxruntime with one observation, of RISE of its default size, exported."""
    import tempfile
    from pathlib import Path

    from rise_agents import make_agent
    from rise_agents.export import export, sample
    from rise_agents.onnx_policy import OnnxPolicy

    agent: Any = make_agent("rise", VEHICLE, {"updates": 5, "vae_updates": 5}).learn(recorded())
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rise.onnx"
        try:
            export(agent, path, sample(agent, 10, 10))
        except ImportError:
            raise Unavailable("onnx and onnxruntime are not installed") from None
        policy = OnnxPolicy(path)
    env = make(VEHICLE)
    seen = observations(env, _CALLS)
    env.close()
    epsilon = np.zeros((1, agent.config.latent), np.float32)
    inputs = [{**{key: o[key][None] for key in policy.task.widths}, "epsilon": epsilon} for o in seen]
    processor: list[float] = []

    def ours() -> float:
        taken: list[float] = []
        run, used, ends = policy.session.run, time.process_time(), time.perf_counter() + effort.seconds
        while time.perf_counter() < ends or not taken:
            for given in inputs:
                started = time.perf_counter()
                run(None, given)
                taken.append(time.perf_counter() - started)
        processor.append((time.process_time() - used) / len(taken))
        return 1e6 * float(np.median(taken))

    yield Sides(
        ours,
        note=lambda: f"median of single calls; {1e6 * np.median(processor):.1f} µs of processor time each",
    )


@contextmanager
def cloning(effort: Effort, name: str) -> Iterator[Sides]:
    """An update within ``learn`` against the forward and backward pass alone.

    The bare pass has the same network, the same number of rows and the same loss. Its input lies ready: it
    neither gathers rows nor draws samples, and no optimiser follows.
    """
    import torch

    from rise_agents import make_agent
    from rise_agents.cloning import imitation_loss, output_size
    from rise_agents.networks import mlp
    from rise_agents.readings import inputs
    from rise_envs.task import task_of

    torch.set_num_threads(1)
    data = recorded()
    updates = effort.size(200, 10)
    encoder = {"vae_updates": 1} if name == "rise" else {}
    agent: Any = make_agent(name, VEHICLE, {"updates": updates, "batch_size": BATCH, **encoder})
    config = agent.config
    robot, reading = inputs(task_of(VEHICLE), config.frame, data.subsample(10))
    width = robot.shape[1] + (config.latent if encoder else reading.shape[1])
    samples = (config.n_samples,) if encoder else ()

    def ours() -> float:
        marks: list[tuple[float, float]] = []
        agent.learn(data, lambda share, figures: marks.append((share, time.perf_counter())))
        # From a fifth on: RISE's encoder is done by then, and the first updates are not like the others.
        marks = [mark for mark in marks if mark[0] > 0.2]
        (share, started), (last, ended) = marks[0], marks[-1]
        return 1e3 * (ended - started) / ((last - share) * (updates + len(encoder)))

    network = mlp(width, config.hidden, output_size(data.actions.shape[1], config.loss))
    x = torch.randn((*samples, BATCH, width))
    action = torch.rand((BATCH, data.actions.shape[1])) * 2 - 1

    def work() -> int:
        for parameter in network.parameters():
            parameter.grad = None
        imitation_loss(network(x), action, config.loss).backward()
        return 1

    yield Sides(ours, lambda: 1e3 / rate(work, effort.seconds))
