"""What happens in an episode, step by step, re-created from its seeds; and the files that keep a selection of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from rise_agents import archive
from rise_agents.agent import initial_state
from rise_agents.rollout import policy_keys, rollout
from rise_envs.noise_wrappers import ObservationNoise
from rise_envs.task import describes_task, metadata_of, task_of

Array = NDArray[np.float64]
Act = Callable[[Any], NDArray]  # from an observation to an action; called once a step, in order
KIND = "trajectories"  # of the files
OUTCOMES = ("safe", "arrived", "steps", "episode_cost", "min_clearance", "episode_return")


@dataclass(frozen=True)
class Trajectory:
    """One episode of T steps; what has T + 1 rows begins with the start.

    Attributes:
        state: of the robot, (T + 1, S).
        goal: (T + 1, D), m.
        true: the true readings, (T + 1, C).
        reading: the readings as the policy got them, (T + 1, C).
        action: as the policy gave them, (T, A).
        clearance: least signed distance within the step that led here (m), (T + 1,).
        cost: of each step, (T,).
        reward: of each step, (T,).
        arrived: whether the episode ended at the goal, ().
    """

    state: Array
    goal: Array
    true: Array
    reading: Array
    action: NDArray
    clearance: Array
    cost: Array
    reward: Array
    arrived: NDArray[np.bool_]

    def __post_init__(self) -> None:
        steps = len(self.action)
        for field in fields(self)[:-1]:
            rows = steps + (field.name in ("state", "goal", "true", "reading", "clearance"))
            if len(getattr(self, field.name)) != rows:
                raise ValueError(
                    f"an episode of {steps} steps has {rows} rows of {field.name!r}, "
                    f"got {len(getattr(self, field.name))}"
                )

    @property
    def outcomes(self) -> dict[str, Any]:
        """The columns of its row of results (:data:`OUTCOMES`), computed as the roll-out does."""
        cost = total = 0.0
        for one, reward in zip(self.cost.tolist(), self.reward.tolist(), strict=True):
            cost, total = cost + one, total + reward  # one by one: a sum of pairs has other last digits
        least = float(self.clearance[1:].min(initial=np.inf))  # the start counts to no step
        return dict(
            zip(OUTCOMES, (cost == 0, bool(self.arrived), len(self.action), cost, least, total), strict=True)
        )

    @property
    def closest(self) -> int:
        """The step in which the clearance was least; 0 is the start."""
        return 1 + int(self.clearance[1:].argmin()) if len(self.action) else 0


def play(
    act: Act,
    env_id: str,
    seed: int,
    noise_model: str = "step",
    noise_level: float = 0.0,
    *,
    noise_seed: int | None = None,
    watch: Callable[[gym.Env], None] | None = None,
) -> Trajectory:
    """The episode that ``seed`` names, with the noise that the benchmark gives it, in the single environment.

    Args:
        act: who acts.
        env_id: a registered environment.
        seed: of the environment.
        noise_model: a noise model's text.
        noise_level: multiplies the environment's noise scale; 0 gives true readings.
        noise_seed: of the noise; by default ``seed``.
        watch: called with the environment, which can draw itself then, at the start and after each step.

    Raises:
        ValueError: ``watch`` in an environment that draws no pictures.
    """
    if watch is not None and not draws(env_id):
        raise ValueError(f"{env_id} draws no pictures")
    # Not every environment knows the argument.
    how: dict[str, Any] = {} if watch is None else {"render_mode": "rgb_array"}
    env: gym.Env = gym.make(env_id, **how)
    options = None
    if noise_level > 0:
        env = ObservationNoise(env, noise_model, noise_level=noise_level)
        options = {"noise_seed": seed if noise_seed is None else noise_seed}
    look, log = watch or (lambda _: None), _Log()
    try:
        observation, info = env.reset(seed=seed, options=options)
        log.note(observation, info)
        look(env)
        over = False
        while not over:
            action = act(observation)
            observation, reward, terminated, truncated, info = env.step(action)
            log.note(observation, info, np.array(action), float(reward))
            look(env)
            over = terminated or truncated
    finally:
        env.close()
    return log.trajectory(bool(info["is_success"]))


def draws(env_id: str) -> bool:
    """Whether an environment draws pictures."""
    return "rgb_array" in metadata_of(env_id)["render_modes"]


def step_seconds(env_id: str) -> float:
    """How long a step is; of an environment that describes no task: one of its pictures."""
    if describes_task(env_id):
        return task_of(env_id).dt
    return 1.0 / metadata_of(env_id).get("render_fps", 10)


def _parts(observation: Any) -> tuple[NDArray, NDArray, NDArray]:
    """State, goal and reading; of an environment that does not tell them apart all is state."""
    if isinstance(observation, Mapping):
        if {"observation", "desired_goal", "obstacle"} <= observation.keys():
            return observation["observation"], observation["desired_goal"], observation["obstacle"]
        observation = np.concatenate([np.ravel(part) for part in observation.values()])
    return np.ravel(observation), np.zeros(0), np.zeros(0)


class _Log:
    """Rows in the order they happen."""

    def __init__(self) -> None:
        self.rows: dict[str, list[Any]] = {field.name: [] for field in fields(Trajectory)[:-1]}

    def note(
        self,
        observation: Any,
        info: Mapping[str, Any],
        action: NDArray | None = None,
        reward: float = 0.0,
    ) -> None:
        state, goal, reading = _parts(observation)
        true = _parts(info.get("clean_observation", observation))[2]
        seen = {
            "state": state,
            "goal": goal,
            "true": true,
            "reading": reading,
            "clearance": info.get("clearance", np.nan) if action is None else info["clearance"],
        }
        if action is not None:
            seen |= {"action": action, "reward": reward, "cost": info["cost"]}
        for name, value in seen.items():
            self.rows[name].append(np.array(value))

    def trajectory(self, arrived: bool) -> Trajectory:
        return Trajectory(
            **{name: np.stack(rows) for name, rows in self.rows.items()}, arrived=np.array(arrived)
        )


def acting(policy: Any, noise_seed: int, rows: int = 1) -> Act:
    """``policy`` alone in the episode whose noise ``noise_seed`` names, as it is evaluated.

    Args:
        policy: who acts.
        noise_seed: of the episode.
        rows: so many copies of the episode are handed to the policy, whose first action counts: the last digits of
            a network's output depend on how many rows are computed together.
    """
    deterministic = getattr(policy, "evaluate_deterministic", True)
    state, start = initial_state(policy, policy_keys([noise_seed] * rows)), np.ones(rows, bool)

    def repeated(part: NDArray) -> NDArray:
        return np.repeat(np.asarray(part)[None], rows, axis=0)

    def act(observation: Any) -> NDArray:
        nonlocal state, start
        named = isinstance(observation, Mapping)
        batch = {key: repeated(part) for key, part in observation.items()} if named else repeated(observation)
        actions, state = policy.predict(batch, state, start, deterministic)
        start = np.zeros(rows, bool)
        return actions[0]

    return act


def repeating(actions: NDArray) -> Act:
    """Who gives ``actions`` (T, A), whatever is read."""
    left = iter(actions)
    return lambda _: next(left)


def trace(
    policy: Any, env_id: str, seed: int, noise_model: str = "step", noise_level: float = 0.0, rows: int = 1
) -> Trajectory:
    """The episode that ``seed`` names, with ``policy`` alone in it (:func:`acting`): all that :func:`play` sees."""
    return play(acting(policy, seed, rows), env_id, seed, noise_model, noise_level)


def trace_among(
    policy: Any, env_id: str, seeds: NDArray[np.int64], place: int, noise_model: str, noise_level: float
) -> Trajectory:
    """Episode ``place`` of ``seeds`` (E,) as it runs when all of them run side by side.

    A network's output for a row differs in its last digits with the rows that are computed together: what was
    evaluated side by side comes out to the last digit only like this.
    """
    _, log = rollout(
        policy,
        env_id,
        seeds,
        noise=noise_model,
        noise_level=noise_level,
        deterministic=getattr(policy, "evaluate_deterministic", True),
        record=True,
    )
    if log is None:
        raise RuntimeError("the roll-out kept no transitions")
    actions = log.actions[log.offsets[place] : log.offsets[place + 1]]
    return play(repeating(actions), env_id, int(seeds[place]), noise_model, noise_level)


def save(path: Path, episodes: Mapping[int, Trajectory], description: Mapping[str, Any]) -> None:
    """Store trajectories by scenario, and what they are.

    Raises:
        OSError: the file cannot be written; an earlier one is intact.
    """
    arrays = {
        f"{scenario}.{field.name}": getattr(trajectory, field.name)
        for scenario, trajectory in episodes.items()
        for field in fields(Trajectory)
    }
    archive.write(path, KIND, arrays, {**description, "scenarios": list(episodes)})


def load(path: Path) -> tuple[dict[int, Trajectory], dict[str, Any]]:
    """What :func:`save` stored.

    Raises:
        ValueError: missing, damaged or something else.
    """
    try:
        arrays, description = archive.read(path, KIND)
        episodes = {
            int(scenario): Trajectory(*(arrays[f"{scenario}.{field.name}"] for field in fields(Trajectory)))
            for scenario in description["scenarios"]
        }
    except (archive.ArchiveError, LookupError, TypeError, ValueError) as error:
        raise ValueError(
            f"{path} cannot be read as trajectories ({error}); remove it to trace again"
        ) from None
    return episodes, description
