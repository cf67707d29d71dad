"""What holds of environments with a task description, on which agents, experts and filters rely."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

import rise_envs
from rise_envs.task import env_class
from rise_envs.testing.subject import ContractError, Subject, actions, hold, refused

KEYS = ("observation", "achieved_goal", "desired_goal", "obstacle")


def spaces_fit(s: Subject) -> None:
    """The four keys, finite bounds, float64; actions float32; observations inside."""
    env = s.make()
    space = env.observation_space
    right = isinstance(space, spaces.Dict) and set(space) == set(KEYS)
    hold(right, f"the observation must be a Dict with the keys {KEYS}, got {space}")
    for key, part in space.items():
        flat = isinstance(part, spaces.Box) and part.dtype == np.float64 and len(part.shape) == 1
        hold(flat, f"{key} must be a flat Box of float64, got {part}")
        hold(np.isfinite(part.low).all() and np.isfinite(part.high).all(), f"{key} needs finite bounds")
    box = isinstance(env.action_space, spaces.Box) and env.action_space.dtype == np.float32
    hold(box, f"actions must be a Box of float32, got {env.action_space}")
    for seed in range(5):
        for observation, _ in _episode(env, seed):
            hold(observation in space, f"an observation lies outside its space: {observation}")
    env.close()


def _episode(env: Any, seed: int) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Observations and infos of a few steps."""
    observation, info = env.reset(seed=seed)
    yield observation, info
    for action in actions(env.action_space, seed):
        observation, _, terminated, _, info = env.step(action)
        hold(
            terminated == info["is_success"],
            "an episode that is not at its goal has terminated, or the reverse",
        )
        yield observation, info


def task_agrees(s: Subject) -> None:
    """The task description agrees with what is observed."""
    task, env = s.task, s.make()
    unwrapped = env.unwrapped
    observation, _ = env.reset(seed=0)
    for key, width in task.widths.items():
        hold(observation[key].shape == (width,), f"{key} has not the {width} numbers that the task says")
    np.testing.assert_array_equal(unwrapped.noise_scale["obstacle"], task.noise_scale)
    grouped = sorted(c for group in unwrapped.noise_channels["obstacle"].values() for c in group)
    hold(
        grouped == list(range(len(observation["obstacle"]))),
        "noise_channels leave out a channel, or repeat one",
    )
    position, rotation = task.pose(observation["observation"][None])
    np.testing.assert_allclose(position[0], observation["achieved_goal"])
    np.testing.assert_allclose(rotation[0] @ rotation[0].T, np.eye(task.dim), atol=1e-12)
    position, velocity, radius = task.split(observation["obstacle"])
    after = env.step(np.zeros(env.action_space.shape))[0]["obstacle"]
    moved = task.split(after)[0]
    message = "the reading's velocity must be that of the coming step"
    np.testing.assert_allclose(moved, position + task.dt * velocity, atol=1e-12, err_msg=message)
    hold((radius > 0).all(), "a radius is not positive")
    env.close()


def infos(s: Subject) -> None:
    """Cost, clearance, success and where the step began."""
    env = s.make()
    for seed in range(3):
        before = None
        for step, (observation, info) in enumerate(_episode(env, seed)):
            kinds = type(info["cost"]), type(info["clearance"]), type(info["is_success"])
            hold(
                kinds == (float, float, bool),
                f"cost, clearance, is_success are {kinds}, not float, float, bool",
            )
            hold(
                info["cost"] == (1.0 if info["clearance"] < 0 else 0.0), "cost must be 1 where clearance < 0"
            )
            hold(step > 0 or info["cost"] == 0.0, "an episode starts with a cost")
            if before is not None:
                np.testing.assert_array_equal(info["previous_achieved_goal"], before)
            before = observation["achieved_goal"].copy()
    env.close()


def perceived(s: Subject) -> None:
    """``perceived`` is where a noise wrapper leaves the reading."""
    env = s.make()
    env.reset(seed=0)
    hold(env.unwrapped.perceived is None, "perceived must be None after a reset")
    observation, _ = rise_envs.ObservationNoise(env, "step").reset(seed=0)
    np.testing.assert_array_equal(env.unwrapped.perceived, observation["obstacle"])
    env.reset()
    hold(env.unwrapped.perceived is None, "perceived must be None after a reset")
    env.close()


def wrong_actions(shape: tuple[int, ...]) -> dict[str, Any]:
    """Actions that no environment may take."""
    return {
        "shape": np.zeros(shape[0] + 1),
        "row": np.zeros((1, *shape)),
        "nan": np.full(shape, np.nan),
        "inf": np.array([np.inf] + [0.0] * (shape[0] - 1)),
        "ragged": [[0.0], [0.0, 0.0], []][: shape[0]],
        "text": ["left"] * shape[0],
        "digits": ["1"] * shape[0],
        "complex": np.zeros(shape, complex),
        "none": None,
    }


def misuse(s: Subject) -> None:
    """Actions that make no sense are refused and change nothing; those beyond the bounds are clipped."""
    env, twin = s.make(), s.make()
    try:
        s.make().unwrapped.step(env.action_space.sample())
    except (gym.error.ResetNeeded, RuntimeError) as error:
        hold("reset" in str(error), f"a step before the reset is refused by {error}")
    else:
        raise ContractError("a step before the reset is not refused")
    env.reset(seed=2), twin.reset(seed=2)
    good = actions(env.action_space, 2, 1)[0]
    for wrong in wrong_actions(env.action_space.shape).values():
        refused(env.unwrapped, wrong)
    np.testing.assert_equal(env.step(good)[:2], twin.step(good)[:2])
    beyond = env.action_space.high * 3 + 1
    np.testing.assert_equal(env.step(beyond)[0], twin.step(env.action_space.high)[0])
    env.close(), twin.close()


def goals(s: Subject) -> None:
    """The goal API takes one goal or a batch, and agrees with the steps, whatever the reward."""
    known = inspect.signature(env_class(s.env_id)).parameters
    kinds = [{"reward_type": kind} for kind in ("dense", "sparse")] if "reward_type" in known else [{}]
    ends = [False, True] if "terminate_on_collision" in known else [None]
    for kind in kinds:
        for end in ends:
            _goal_api(s.make(**kind, **({} if end is None else {"terminate_on_collision": end})))


def _goal_api(made: Any) -> None:
    env = made.unwrapped
    achieved: list[Any] = []
    desired: list[Any] = []
    infos: list[Any] = []
    rewards: list[float] = []
    ends: list[bool] = []
    for seed in range(4):
        env.reset(seed=seed)
        for action in actions(env.action_space, seed):
            observation, reward, terminated, truncated, info = env.step(action)
            kinds = type(reward), type(terminated), truncated
            hold(kinds == (float, bool, False), f"reward, terminated, truncated are {kinds}")
            goal = (observation["achieved_goal"], observation["desired_goal"], info)
            hold(env.compute_reward(*goal) == reward, "compute_reward and the step disagree")
            hold(env.compute_terminated(*goal) == terminated, "compute_terminated and the step disagree")
            hold(not env.compute_truncated(*goal), "compute_truncated and the step disagree")
            for values, value in zip((achieved, desired, infos), goal, strict=True):
                values.append(value)
            rewards.append(reward)
            ends.append(terminated)
    batch = (np.array(achieved), np.array(desired), np.array(infos))
    hold(env.compute_reward(*batch).tolist() == rewards, "compute_reward of a batch is not that of its rows")
    hold(
        env.compute_terminated(*batch).tolist() == ends,
        "compute_terminated of a batch is not that of its rows",
    )
    hold(env.compute_truncated(*batch).tolist() == [False] * len(rewards), "compute_truncated of a batch")
    reached = (np.array(achieved), np.array(achieved), np.array(infos))  # as hindsight relabels
    hold(env.compute_terminated(*reached).all(), "a goal that is reached does not terminate")
    least = 0 if getattr(env, "reward_type", "dense") == "sparse" else 1
    hold((env.compute_reward(*reached) >= least).all(), "a goal that is reached pays less than it must")
    made.close()
