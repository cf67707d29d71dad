"""What is put in control: a checkpoint, a file that was exported, or an agent that comes with the package."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rise_agents import load_agent
from rise_agents.onnx_policy import OnnxPolicy
from rise_envs.task import Task


def load_policy(given: str, env_id: str) -> Any:
    """The policy that a path or a name stands for.

    Raises:
        ValueError: of another environment, or no weights of that name.
        rise_agents.checkpoint.CheckpointError: a checkpoint that cannot be used.
        ImportError: an exported file without onnxruntime.
    """
    if Path(given).suffix != ".onnx":
        return load_agent(given, env_id)
    policy = OnnxPolicy(given)
    if policy.env_id != env_id:
        raise ValueError(f"{given} is for {policy.env_id!r}, not {env_id!r}")
    return policy


def warm_up(policy: Any, task: Task, calls: int = 20) -> None:
    """Let a policy do once what takes long the first time only."""
    seen = {key: np.zeros(shape) for key, shape in task.shapes.items()}
    state = None
    for call in range(calls):
        _, state = policy.predict(seen, state, np.array([call == 0]), bool(call % 2))
