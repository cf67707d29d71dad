"""What a belief learns from: the obstacles of demonstrations, read with errors of many sizes and kinds.

The demonstrations hold true readings only. Here they are read again and again, each sequence with noise of its own: a
fresh error in every step, an error that stays, both or neither, of random size, in all channels alike or in some
more than in others. No level is preferred, so that whoever learns from this has to infer it.

Shapes: E sequences, T steps, N balls, D dimensions, C = 2D + 1 channels.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rise_agents.belief import history, posterior
from rise_agents.belief.history import Readings
from rise_agents.belief.posterior import Estimates, Frame
from rise_agents.demonstrations import Demonstrations
from rise_envs.task import Task

Array = NDArray[np.float64]

WHITE = (0.03, 3.0)  # fresh errors, log-uniform in units of the noise scale ...
CLEAN = 0.12  # ... but in this share of the sequences
BIAS = 1.6  # errors that stay, uniform up to this, in units of the noise scale ...
UNBIASED = 0.5  # ... but in this share of the sequences
ALIKE = 0.4  # share of sequences with errors of one size in all channels; in the others ...
SPREAD, NO_WHITE, NO_BIAS = 0.3, 0.1, 0.25  # ... log-normal factors of each quantity, or none at all of it
EARLY = 15  # steps of an episode of which all are learned from, of later ones every third: they are alike
_SEQUENCES = 512  # that are read side by side


class Practice(NamedTuple):
    """Rows to learn from, float32: inputs (R, K), estimates (R, ·, ·), truth (R, C) in the frames of the episodes."""

    inputs: NDArray[np.float32]
    estimates: Estimates
    truth: NDArray[np.float32]


def errors(rng: np.random.Generator, sequences: int, steps: int, scale: Array, dim: int) -> Array:
    """Errors of readings, (E, T, C), in the units of ``scale`` (C,)."""
    white = np.exp(rng.uniform(math.log(WHITE[0]), math.log(WHITE[1]), sequences))
    white[rng.random(sequences) < CLEAN] = 0.0
    bias = rng.uniform(0.0, BIAS, sequences)
    bias[rng.random(sequences) < UNBIASED] = 0.0
    quantity = np.repeat([0, 1, 2], (dim, dim, 1))  # position, velocity, radius
    alike = rng.random((sequences, 1)) < ALIKE

    def factors(none: float) -> Array:
        drawn = np.exp(rng.normal(0.0, SPREAD, (sequences, 3))) * (rng.random((sequences, 3)) > none)
        return np.where(alike, 1.0, drawn)[:, quantity]

    fresh = rng.normal(size=(sequences, steps, len(scale))) * (white[:, None] * factors(NO_WHITE))[:, None]
    kept = rng.normal(size=(sequences, 1, len(scale))) * (bias[:, None] * factors(NO_BIAS))[:, None]
    return (fresh + kept) * scale


def practise(
    task: Task, demonstrations: Demonstrations, memories: tuple[float, ...], rows: int, seed: int
) -> Practice:
    """About ``rows`` rows: the same for the same arguments."""
    rng = np.random.default_rng(seed)
    blocks: list[Practice] = []
    made = 0
    while made < rows:
        order = rng.permutation(len(demonstrations))
        for start in range(0, len(order), _SEQUENCES):
            blocks.append(_block(task, demonstrations, order[start : start + _SEQUENCES], memories, rng))
            made += len(blocks[-1].truth)
            if made >= rows:
                break
    joined = [np.concatenate(parts)[:rows] for parts in zip(*(_flat(block) for block in blocks), strict=True)]
    return Practice(joined[0], Estimates(*joined[1:4]), joined[4])


def _flat(block: Practice) -> tuple[NDArray, ...]:
    return block.inputs, *block.estimates, block.truth


def _block(
    task: Task, d: Demonstrations, episodes: NDArray, memories: tuple[float, ...], rng: np.random.Generator
) -> Practice:
    """Rows of some episodes, each ball of which is a sequence."""
    first, lengths = d.offsets[:-1][episodes], np.diff(d.offsets)[episodes]
    steps = int(lengths.max())
    rows = first[:, None] + np.minimum(
        np.arange(steps), lengths[:, None] - 1
    )  # (E, T); past the end: the last
    state, goal = d.observations["observation"][first], d.observations["desired_goal"][first]
    n, channels = task.n_obstacles, 2 * task.dim + 1
    frame = Frame.of(task, *(np.repeat(part, n, 0) for part in (state, goal)))
    goal, lengths = frame.point(np.repeat(goal, n, 0)), np.repeat(lengths, n)
    true = d.observations["obstacle"][rows].reshape(len(rows), steps, n, channels)
    true = true.swapaxes(1, 2).reshape(-1, steps, channels)
    noisy = true + errors(rng, len(true), steps, np.asarray(task.noise_scale[:channels]), task.dim)

    sums, found = history.nothing(len(true), len(memories), task.dim), []
    for step in range(steps):
        reading = frame.readings(task, noisy[:, step])
        sums = history.remembered(sums, reading, task.dt, memories)
        kept = np.flatnonzero((step < lengths) & (rng.random(len(true)) < (1.0 if step < EARLY else 1 / 3)))
        if not kept.size:
            continue
        seen = history.evidence(sums[kept], task.dim)
        reading = Readings(*(part[kept] for part in reading))
        truth = np.concatenate(
            [part.reshape(len(kept), -1) for part in _kept(frame, task, true[:, step], kept)], -1
        )
        x = posterior.inputs(task, reading, seen, np.full(len(kept), step + 1.0), goal[kept])
        found.append((x, *posterior.estimates(reading, seen), truth))
    parts = [np.concatenate(column).astype(np.float32) for column in zip(*found, strict=True)]
    return Practice(parts[0], Estimates(*parts[1:4]), parts[4])


def _kept(frame: Frame, task: Task, c: Array, rows: NDArray) -> Readings:
    """Readings (E, C) of some rows in their frames."""
    return Frame(frame.origin[rows], frame.rotation[rows]).readings(task, c[rows])
