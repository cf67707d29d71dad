"""Whether an exported file acts as its agent: on what the agent meets, against itself and against torch.

The agent's ``predict`` is one reference. The other are its networks in torch, rebuilt from the stored arrays, fed in
standard units as in training: they share neither the folding of units into weights nor the matrix products with what is
checked.

Networks act in float32. A sum over a few hundred terms of size 1 to 10, three layers deep, is exact to about 10⁻⁵,
and less where standard units magnify an input; what is wrong (a weight, a unit, an angle) shows as 10⁻² and more.
``TOLERANCE`` stands between both, in units of half the range of each action: 10⁻⁴ is 5 µm of the Panda's commanded
displacement.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rise_agents.agent import initial_state
from rise_agents.cloning import ActionUnits
from rise_agents.export.reference import in_torch
from rise_agents.files import StrPath
from rise_agents.onnx_policy import OnnxPolicy
from rise_agents.rollout import policy_keys, rollout
from rise_agents.seeds import episode_seeds

TOLERANCE = 1e-4
LANES, STEPS = 50, 20  # 1,000 inputs
_EPISODES = 64

Rows = dict[str, NDArray]


@dataclass(frozen=True)
class Sample:
    """Observations in the order of episodes, in lanes side by side.

    Attributes:
        observations: parts (lanes, steps, ·).
        starts: whether an episode begins there, (lanes, steps).
        keys: to draw from, (lanes,).
    """

    observations: Rows
    starts: NDArray[np.bool_]
    keys: NDArray[np.uint64]

    def __iter__(self) -> Iterator[tuple[Rows, NDArray[np.bool_]]]:
        for step in range(self.starts.shape[1]):
            yield {key: part[:, step] for key, part in self.observations.items()}, self.starts[:, step]


@dataclass(frozen=True)
class Differences:
    """Largest differences of actions over a sample.

    Attributes:
        count: of observations.
        agent: to the agent's ``predict``, drawing, in units of each action, (A,).
        deterministic: the same, deterministic.
        torch: to the networks in torch.
        half_range: of each action, (A,).
    """

    count: int
    agent: NDArray
    deterministic: NDArray
    torch: NDArray
    half_range: NDArray

    @property
    def largest(self) -> float:
        """In units of half the actions' ranges."""
        return float((np.stack((self.agent, self.deterministic, self.torch)) / self.half_range).max())


def sample(agent: Any, lanes: int = LANES, steps: int = STEPS) -> Sample:
    """What an agent meets in validation episodes under noise of level 1: pieces of them, evenly spread."""
    seeds = episode_seeds("validation", 0, 0, _EPISODES)
    _, transitions = rollout(
        agent, agent.env_id, seeds, noise="step", noise_level=1.0, deterministic=False, record=True
    )
    assert transitions is not None  # noqa: S101  asked for with record
    total = len(transitions.actions)
    first = np.zeros(total, bool)
    first[transitions.offsets[:-1]] = True
    begin = np.linspace(0, max(total - steps, 0), lanes).astype(int)
    place = np.minimum(begin[:, None] + np.arange(steps), total - 1)
    starts = first[place]
    starts[:, 0] = True  # whatever was before, the lane begins here
    return Sample(
        {k: v[place] for k, v in transitions.observations.items()}, starts, policy_keys(seeds)[:lanes]
    )


def compare(agent: Any, path: StrPath, seen: Sample) -> Differences:
    """How far the file at ``path`` is from ``agent``."""
    policy = OnnxPolicy(path)
    drawn = actions(policy, seen, False)
    units = ActionUnits.of(agent.env_id)
    return Differences(
        seen.starts.size,
        _largest(drawn, actions(agent, seen, False)),
        _largest(actions(policy, seen, True), actions(agent, seen, True)),
        _largest(drawn, actions(in_torch(agent), seen, False)),
        0.5 * (units.high - units.low),
    )


def actions(policy: Any, seen: Sample, deterministic: bool) -> NDArray[np.float64]:
    """What a policy does, (steps, lanes, A)."""
    state, done = initial_state(policy, seen.keys), []
    for observation, starts in seen:
        action, state = policy.predict(observation, state, starts, deterministic)
        done.append(action.astype(np.float64))
    return np.stack(done)


def _largest(one: NDArray, other: NDArray) -> NDArray:
    return np.abs(one - other).max((0, 1))
