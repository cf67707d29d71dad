"""An exported agent as it acts: what :mod:`rise_agents.export` writes, run by onnxruntime; nothing else is loaded."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rise_agents.agent import State, draw_state, fresh_state
from rise_agents.draws import NormalDraws
from rise_agents.files import StrPath
from rise_agents.readings import checked_batch
from rise_envs.task import task_of

FORMAT = "1"
NEXT = "next_"
_PRECISIONS = {"float32": np.float32, "float64": np.float64}


class OnnxPolicy:
    """A policy out of a file, with the ``predict`` of every agent.

    It draws as its agent does: for the same key of an episode, the same numbers.

    Args:
        path: what ``python -m rise_agents.export`` wrote.
        threads: of the runtime; a second one makes networks of this size slower.
        seed: of the draws of episodes that are given no key.

    Attributes:
        name: of the agent.
        env_id: of its environment.
        session: onnxruntime's, for who wants to do without the rest.
        metadata: all that the file says of itself.

    Raises:
        ImportError: onnxruntime is not installed.
        ValueError: a file that cannot be read, is no ONNX, or is none of ours.
    """

    def __init__(self, path: StrPath, threads: int = 1, seed: int = 0) -> None:
        import rise_envs  # noqa: F401  registers the environments

        self.session = _session(Path(path), threads)
        self.metadata: dict[str, str] = dict(self.session.get_modelmeta().custom_metadata_map)
        try:
            if self.metadata["format"] != FORMAT:
                raise ValueError(f"format {self.metadata['format']!r} is not {FORMAT!r}")
            self.name, self.env_id = self.metadata["agent"], self.metadata["env"]
            self.settings = json.loads(self.metadata["settings"])
            self.evaluate_deterministic = bool(json.loads(self.metadata["evaluate_deterministic"]))
            draws = json.loads(self.metadata["draws"])
            self._size, self._precision = int(draws["size"]), _PRECISIONS[draws["precision"]]
            self._memory = tuple(json.loads(self.metadata["state"]))
            self.task = task_of(self.env_id)
            self._check_signature()
        except Exception as error:  # whatever is wrong with what the file says of itself
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
            raise ValueError(f"{path}: is no exported agent ({reason}); export it again") from None
        self._draws = NormalDraws(self._size, self._precision)
        self._zeros = np.zeros((1, self._size), self._precision)
        self._rng = np.random.default_rng(seed)

    def _check_signature(self) -> None:
        """Raise ``ValueError`` unless the graph takes what its description says."""
        given = {node.name: tuple(node.shape[1:]) for node in self.session.get_inputs()}
        wanted = dict(self.task.shapes)
        if self._size:
            wanted["epsilon"] = (self._size,)
        self._shapes = {name: given[name] for name in self._memory}
        if given != wanted | self._shapes:
            raise ValueError(f"inputs {given}, {self.env_id} has {wanted}")
        outputs = [node.name for node in self.session.get_outputs()]
        if outputs != ["action", *(NEXT + name for name in self._memory)]:
            raise ValueError(f"outputs {outputs}")

    def initial_state(self, keys: NDArray[np.uint64]) -> State:
        """The state at the start of episodes with the given keys (B,)."""
        if self._memory:
            return tuple(np.zeros((len(keys), *shape)) for shape in self._shapes.values())
        return fresh_state(keys)

    def predict(
        self,
        observation: Any,
        state: State = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.float32], State]:
        """Actions (B, A) for a batch of observations, or (A,) for one.

        Args:
            observation: with the keys of the environment.
            state: what the last call returned, or :meth:`initial_state`.
            episode_start: (B,), rows whose episode begins.
            deterministic: act on ``epsilon = 0``.

        Raises:
            ValueError: a part of the observation that is missing, of another shape or not finite.
        """
        rows, single = checked_batch(self.task, observation)
        count = len(rows["desired_goal"])
        if self._memory:
            rows |= self._remembered(state, episode_start, count)
        elif self._size and deterministic:
            rows["epsilon"] = self._zeros if count == 1 else np.repeat(self._zeros, count, 0)
        elif self._size:
            keys, counter = draw_state(state, episode_start, count, self._rng)
            rows["epsilon"] = self._draws(keys, counter)
            state = keys, counter + np.uint64(1)
        action, *after = self.session.run(None, rows)
        return (action[0] if single else action), (tuple(after) if self._memory else state)

    def _remembered(
        self, state: State, episode_start: NDArray[np.bool_] | None, count: int
    ) -> dict[str, NDArray]:
        if state is None:
            state = self.initial_state(np.zeros(count, np.uint64)) or ()
        parts = dict(zip(self._memory, state, strict=True))
        if episode_start is not None:  # without a reading so far, the graph begins anew
            parts["steps"] = np.where(np.atleast_1d(episode_start), 0.0, parts["steps"])
        return parts


def runtime() -> Any:
    """The module onnxruntime; raises ``ImportError`` that says how to get it."""
    try:
        import onnxruntime
    except ImportError:
        raise ImportError("onnxruntime is not installed: pip install 'rise-suite[onnx]'") from None
    return onnxruntime


def _session(path: Path, threads: int) -> Any:
    """A session of one file's content: handed over as bytes, it cannot name other files to be read."""
    ort = runtime()
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = threads
    options.log_severity_level = 4  # what is wrong is raised
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from None
    try:
        return ort.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # the runtime's own kinds share no base
        raise ValueError(f"{path}: is no ONNX file that can be run ({str(error).splitlines()[0]})") from None
