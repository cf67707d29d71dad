"""Each kind of agent as a graph: its own code (frames, belief) traced, its networks with the weights it acts by.

What is random is an input: ``epsilon``, standard normal draws. The agents draw by SplitMix64 on 64-bit keys, with
logarithm and cosine in float64; ONNX has neither unsigned products nor a promise of how functions round, so that draws
made inside the graph would be others than the agents'. Drawn outside, by :mod:`rise_agents.draws`, they are the same to
the bit, and ``epsilon = 0`` is the deterministic agent.

Shapes: B batch, M averaged samples, Z latent, A actions.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rise_agents import readings
from rise_agents.agent import nearest
from rise_agents.belief.posterior import Frame
from rise_agents.export.pose import traceable
from rise_agents.export.trace import Graph, NotExportable
from rise_agents.forward import LOG_SIGMA_RANGE
from rise_envs.task import Task, task_of

STATE = ("origin", "rotation", "sums", "steps")  # of a belief, as its agent carries it
_NEXT = "next_"


@dataclass(frozen=True)
class Exported:
    """A graph, and what its user must know.

    Attributes:
        graph: with its inputs and outputs.
        draws: standard normal numbers that ``epsilon`` takes for each row; 0: there is no such input.
        precision: of these numbers.
        state: names of inputs that carry something from step to step; the outputs are called the same with ``next_``.
        about: what inputs and outputs mean, by name.
    """

    graph: Graph
    draws: int
    precision: str = "float32"
    state: tuple[str, ...] = ()
    about: dict[str, str] = field(default_factory=dict)


def build(agent: Any) -> Exported:
    """The graph of a trained agent.

    Raises:
        NotExportable: an agent, or a setting of it, that has no form in ONNX.
    """
    if agent.name not in _KINDS:
        raise NotExportable(f"{agent.name!r} cannot be exported: {nearest(agent.name, _KINDS)}")
    graph, task = Graph(), task_of(agent.env_id)
    rows = {key: graph.input(key, shape) for key, shape in task.shapes.items()}
    exported = _KINDS[agent.name](agent, traceable(task), graph, rows)
    about = {**_ABOUT, **{_NEXT + name: f"{name}, to hand in with the next step" for name in STATE}}
    known = {name: about[name] for name in (*graph.inputs, *graph.outputs)}
    return Exported(graph, exported.draws, exported.precision, exported.state, known)


_ABOUT = {
    "observation": "state s as the environment gives it, SI units",
    "desired_goal": "goal g, m",
    "obstacle": "reading c: position, velocity and radius of each obstacle, SI units, noisy or not",
    "epsilon": "standard normal draws, fresh in every step; zeros: act deterministically",
    "action": "action a in the environment's units, inside its bounds",
    "origin": "origin of the frame that the episode began in, m; zeros at the start",
    "rotation": "its axes as columns; zeros at the start",
    "sums": "what is remembered of the readings; zeros at the start",
    "steps": "readings so far; 0: the episode begins",
}


def _rise(agent: Any, task: Task, graph: Graph, rows: dict[str, Any]) -> Exported:
    """π(s, g, μ + σ ⊙ ε), averaged over M draws."""
    c = agent.config
    robot, reading = readings.inputs(task, c.frame, rows)
    heads: Any = graph.network(agent._encoder.layers(), "Relu", reading)
    mu, log_sigma = heads[:, : c.latent], np.clip(heads[:, c.latent :], *LOG_SIGMA_RANGE)
    robot = robot.astype(np.float32)
    samples = 1 if c.posterior == "mean" else c.average
    draws = 0 if c.posterior == "mean" else samples * c.latent
    z: Any = mu
    if draws:
        epsilon: Any = graph.input("epsilon", (draws,), np.float32)
        if samples > 1:  # the samples of a row as rows of their own
            epsilon = epsilon.reshape(-1, samples, c.latent)
            mu, log_sigma, robot = (part[:, None] for part in (mu, log_sigma, robot))
            robot = robot + np.zeros((1, samples, 1), np.float32)
            robot = robot.reshape(-1, robot.shape[-1])
        z = (mu + np.exp(log_sigma) * epsilon).reshape(-1, c.latent)
    action = _act(agent, graph, agent._policy, robot, z)
    if samples > 1:
        action = action.reshape(-1, samples, agent.units.size).mean(1)
    graph.output("action", action)
    return Exported(graph, draws)


def _pcbc(agent: Any, task: Task, graph: Graph, rows: dict[str, Any]) -> Exported:
    """π(s, g, c)."""
    seen = readings.inputs(task, agent.config.frame, rows)
    graph.output("action", _act(agent, graph, agent._clone._policy, *seen))
    return Exported(graph, 0)


def _cppo(agent: Any, task: Task, graph: Graph, rows: dict[str, Any]) -> Exported:
    """The mean action and σ ε, clipped, in float64 as the agent computes it."""
    actor = agent._actor
    if agent.config.frame == "raw" or actor.discrete:
        raise NotExportable("a cppo with frame='raw' or discrete actions cannot be exported")
    seen: Any = np.concatenate(readings.inputs(task, agent.config.frame, rows), -1)
    standard = ((seen - actor.units.mean) / actor.units.scale).astype(np.float32)
    output: Any = graph.network(actor.layers, "Tanh", standard)
    output = output + actor.sigma * graph.input("epsilon", (len(actor.sigma),), np.float64)
    low, high = actor.bounds
    wanted = low + 0.5 * (np.clip(output, -1.0, 1.0) + 1.0) * (high - low)
    graph.output("action", np.clip(wanted.astype(np.float32), *(b.astype(np.float32) for b in actor.bounds)))
    return Exported(graph, len(actor.sigma), "float64")


def _belief(agent: Any, task: Task, graph: Graph, rows: dict[str, Any]) -> Exported:
    """π(s, g, c̃) on the belief over the obstacle, whose memory is an input and an output."""
    if agent.config.shield:
        raise NotExportable(
            "the shield searches a grid of actions, which has no form in ONNX here: set shield=false"
        )
    agent = copy.copy(agent)
    agent.task = task
    start = agent.initial_state(np.zeros(1, np.uint64))
    state: list[Any] = [graph.input(name, part.shape[1:]) for name, part in zip(STATE, start, strict=True)]
    new = state[-1] == 0
    fresh: tuple[Any, ...] = (*Frame.of(task, rows["observation"], rows["desired_goal"]), 0.0, 0.0)
    begun = [
        np.where(new[(...,) + (None,) * (old.ndim - 1)], first, old)
        for first, old in zip(fresh, state, strict=True)
    ]
    mu, sigma, after = agent._updated(
        rows, tuple(begun), lambda seen: graph.network(agent._network.layers(), "Relu", seen)
    )
    c = agent._widened(mu, sigma)
    c = agent._moved_off(rows, c, agent._lacking(rows, c)).reshape(len(c), -1)
    seen = readings.inputs(task, agent.config.frame, {**rows, "obstacle": c})
    graph.output("action", _act(agent, graph, agent._clone._policy, *seen))
    for name, part in zip(STATE, after, strict=True):
        graph.output(_NEXT + name, part)
    return Exported(graph, 0, state=STATE)


def _act(agent: Any, graph: Graph, policy: Any, *seen: Any) -> Any:
    """Actions inside the bounds."""
    low, high = (bound.astype(np.float32) for bound in (agent.units.low, agent.units.high))
    return np.clip(graph.network(policy.layers(), "Relu", *seen), low, high)  # type: ignore[call-overload]


_KINDS: dict[str, Callable[[Any, Task, Graph, dict[str, Any]], Exported]] = {
    "rise": _rise,
    "pcbc": _pcbc,
    "cppo": _cppo,
    "rise-belief": _belief,
}
