"""What holds of every Gymnasium environment with ``info["cost"]`` whose episodes are named by seeds."""

from __future__ import annotations

import copy
import warnings

import gymnasium as gym
import numpy as np
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RescaleAction

import rise_envs
from rise_envs.task import metadata_of
from rise_envs.testing.subject import Subject, actions, assert_same, hold, record, record_batch, refused

# Gymnasium would like actions in [−1, 1], where some tasks have them in SI units on purpose.
WISH = "symmetric and normalized"


def checker(s: Subject) -> None:
    """Gymnasium's own checker has no complaint, pictures included."""
    env = s.make()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env.unwrapped)
        if s.task is not None:
            scaled = RescaleAction(env, np.float32(-1), np.float32(1))
            check_env(scaled, skip_render_check=True, skip_close_check=True)
    known = (WISH, "different from the unwrapped version")
    heard = [str(w.message) for w in caught if not any(text in str(w.message) for text in known)]
    hold(s.task is None or not heard, f"Gymnasium's checker says: {heard}")
    env.close()


def time_limit(s: Subject) -> None:
    """The time limit is that of the registry."""
    env = s.make()
    hold(env.spec.max_episode_steps == rise_envs.ENVS[s.env_id][2], "another time limit than in the registry")
    env.close()


def seeds(s: Subject) -> None:
    """Seeds name different episodes."""
    keys = [key for key in s.records[0] if key not in ("reward", "cost", "clearance", "is_success")]
    firsts = np.array([np.concatenate([np.ravel(r[key][0]) for key in keys]) for r in s.records])
    hold(len(np.unique(firsts, axis=0)) == len(firsts), "two seeds start the same episode")


def replay(s: Subject) -> None:
    """Backwards, in a used environment, after episodes of no seed and an action that was refused."""
    env = s.make()
    for seed in reversed(range(s.episodes)):
        if seed % 10 == 0:
            env.reset()
            if s.task is not None:
                refused(env, np.full(env.action_space.shape, np.nan))
            env.step(env.action_space.sample())
        assert_same(record(env, seed), s.records[seed])
    env.close()


def unseeded(s: Subject) -> None:
    """Resets without a seed go on with the seeded generator."""
    env, twin = s.make(), s.make()
    env.reset(seed=1), twin.reset(seed=1)
    for _ in range(3):
        np.testing.assert_equal(env.reset()[0], twin.reset()[0])
    env.close(), twin.close()


def vectors(s: Subject) -> None:
    """Gymnasium's vector environment, and the native one if there is one, replay the same episodes."""
    native = gym.spec(s.env_id).vector_entry_point is not None
    for mode, count in (
        ("sync", min(s.episodes, 10)),
        *([("vector_entry_point", s.episodes)] if native else []),
    ):
        env = gym.make_vec(s.env_id, count, vectorization_mode=mode)
        for made, single in zip(record_batch(env, list(range(count))), s.records[:count], strict=True):
            assert_same(made, single)
        env.close()


def ownership(s: Subject) -> None:
    """What is handed out is the caller's: scribbling over it changes no episode, and it does not change later."""
    env, twin = s.make(), s.make()
    a, b = env.reset(seed=4), twin.reset(seed=4)
    history = []
    for action in actions(env.action_space, 4):
        history.append((a, copy.deepcopy(a)))
        for part in (b[0] if isinstance(b[0], dict) else {"": b[0]}, b[-1]):
            for value in part.values():
                if isinstance(value, np.ndarray):
                    value[...] = 99
        a, b = env.step(action), twin.step(action)
        np.testing.assert_equal(a[0], b[0])
    for handed_out, then in history:
        np.testing.assert_equal(handed_out, then)
    env.close(), twin.close()


def drawing(s: Subject) -> None:
    """Drawing changes no episode, and an unchanged scene is drawn alike."""
    if "rgb_array" not in metadata_of(s.env_id)["render_modes"]:
        return
    env = s.make(render_mode="rgb_array")
    env.reset(seed=0)
    pictures, rows = [], []
    for action in actions(env.action_space, 0, 4):
        if s.task is not None:
            env.unwrapped.perceived = env.observation_space["obstacle"].low
        pictures += [env.render(), env.render()]
        rows.append(env.step(action)[0])
    for step, observation in enumerate(rows, start=1):
        for key, part in (observation if isinstance(observation, dict) else {"": observation}).items():
            np.testing.assert_array_equal(part, s.records[0][key][step], err_msg=key)
    for picture in pictures:
        right = picture.dtype == np.uint8 and picture.ndim == 3 and picture.shape[2] == 3
        hold(right, "a picture is no array (H, W, 3) of uint8")
    np.testing.assert_array_equal(pictures[0], pictures[1])
    hold((pictures[0] != pictures[-1]).any(), "pictures of different steps are the same")
    env.close()


def close(s: Subject) -> None:
    """Closing twice is allowed."""
    env = s.make()
    env.reset(seed=0)
    env.close()
    env.close()
