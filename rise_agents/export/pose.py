"""The robot's frame in a form that can be traced: which numbers of the state are its place and its heading."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from rise_agents.export.trace import NotExportable
from rise_envs.task import Task

_PROBES = 256


def traceable(task: Task) -> Task:
    """``task`` with a ``pose`` that can be traced: recognised by what the task's own does with random states.

    Raises:
        NotExportable: the origin is no part of the state, or the rotation neither none nor by an angle of the state.
    """
    states = np.random.default_rng(0).uniform(-3.0, 3.0, (_PROBES, task.state_size))
    origin, rotation = task.pose(states)
    place: list[Any] = [_column(states, origin[:, axis]) for axis in range(task.dim)]
    if None in place:
        raise NotExportable("the robot's place is no part of its state: its frame has no form in ONNX here")
    if (rotation == np.eye(task.dim)).all():
        return replace(task, pose=lambda state: (state[:, place], np.eye(task.dim)[None]))
    heading = _heading(states, rotation) if task.dim == 2 else None
    if heading is None:
        raise NotExportable("the robot's rotation is by no angle of its state: it has no form in ONNX here")

    def pose(state: Any) -> tuple[Any, Any]:
        cos, sin = np.cos(state[:, heading]), np.sin(state[:, heading])
        return state[:, place], np.stack((cos, -sin, sin, cos), -1).reshape(-1, 2, 2)

    return replace(task, pose=pose)


def _column(states: Any, values: Any) -> int | None:
    same = np.flatnonzero((states == values[:, None]).all(0))
    return int(same[0]) if len(same) else None


def _heading(states: Any, rotation: Any) -> int | None:
    """The column of the state that a rotation of the plane is by."""
    for column, angle in enumerate(states.T):
        turned = np.stack((np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)), -1)
        if np.allclose(rotation.reshape(-1, 4), turned, rtol=0, atol=1e-12):
            return column
    return None
