"""Episodes step by step: what a plain loop sees, what the roll-out counts, and what files keep."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from benchmarks import trajectories
from benchmarks.policies import Random, make_policy
from benchmarks.trajectories import OUTCOMES, Trajectory, acting, play, repeating, trace, trace_among
from rise_agents.plugins import import_modules
from rise_agents.rollout import rollout
from rise_agents.seeds import episode_seeds
from rise_envs import panda_kinematics
from rise_envs.noise_wrappers import ObservationNoise
from rise_envs.task import task_of

VEHICLE, KINEMATIC = "RISE-GroundVehicle-v0", "RISE-SafePandaKinematic-v0"
COLUMNS = dict(
    zip(OUTCOMES, ("safe", "arrived", "steps", "cost", "min_clearance", "episode_return"), strict=True)
)


def same(one: Trajectory, other: Trajectory) -> bool:
    return all(np.array_equal(getattr(one, f.name), getattr(other, f.name)) for f in fields(Trajectory))


@pytest.mark.parametrize("env_id", [VEHICLE, KINEMATIC])
def test_a_trace_is_what_a_plain_loop_sees(env_id):
    policy, seed = Random(env_id), int(episode_seeds("validation", 0, 3, 1)[0])
    found = trace(policy, env_id, seed, "step", 1.0)
    env = ObservationNoise(gym.make(env_id), "step", noise_level=1.0)
    observation, info = env.reset(seed=seed, options={"noise_seed": seed})
    for t, action in enumerate(found.action):
        np.testing.assert_array_equal(found.state[t], observation["observation"])
        np.testing.assert_array_equal(found.reading[t], observation["obstacle"])
        np.testing.assert_array_equal(found.true[t], info["clean_observation"]["obstacle"])
        np.testing.assert_array_equal(found.goal[t], observation["desired_goal"])
        assert found.clearance[t] == info["clearance"]
        observation, reward, terminated, truncated, info = env.step(action)
        assert (found.reward[t], found.cost[t]) == (reward, info["cost"])
        assert (terminated or truncated) == (t + 1 == len(found.action))
    np.testing.assert_array_equal(found.state[-1], observation["observation"])
    assert found.clearance[-1] == info["clearance"]
    assert not np.array_equal(found.true, found.reading)
    env.close()


def test_an_environment_need_not_say_how_clear_its_start_is(own_names):
    """As any Gymnasium environment, whose ``reset`` knows nothing of ours; the start counts to no step."""
    import_modules([str(Path(__file__).parents[1] / "docs" / "examples" / "calm_pendulum.py")])
    found = trace(Random("CalmPendulum-v0"), "CalmPendulum-v0", 3)
    assert np.isnan(found.clearance[0]) and found.outcomes["min_clearance"] == found.clearance[1:].min()
    assert found.clearance[found.closest] == found.outcomes["min_clearance"]


def test_outcomes_are_those_that_the_roll_out_counts():
    policy, seeds = Random(VEHICLE), episode_seeds("validation", 0, 0, 6)
    episodes, _ = rollout(policy, VEHICLE, seeds, noise="step", noise_level=1.0, deterministic=False)
    for i, seed in enumerate(seeds):
        outcomes = trace(policy, VEHICLE, int(seed), "step", 1.0).outcomes
        assert outcomes == {name: getattr(episodes, column)[i] for name, column in COLUMNS.items()}


def test_an_expert_on_true_readings_reads_the_truth():
    expert = make_policy(VEHICLE, "expert-cbf", None)
    found = trace(expert, VEHICLE, int(episode_seeds("validation", 0, 0, 1)[0]))
    np.testing.assert_array_equal(found.true, found.reading)
    assert found.outcomes["safe"] and found.outcomes["arrived"]
    assert found.clearance[found.closest] == found.clearance[1:].min()


def test_the_same_actions_make_the_same_episode_and_every_moment_is_watched():
    seed = int(episode_seeds("validation", 0, 1, 1)[0])
    found = play(acting(Random(VEHICLE), seed), VEHICLE, seed, "step", 2.0)
    seen: list[int] = []
    again = play(
        repeating(found.action), VEHICLE, seed, "step", 2.0, watch=lambda env: seen.append(env.render().ndim)
    )
    assert same(found, again)
    assert seen == [3] * (len(found.action) + 1)


def test_an_episode_among_others_is_the_one_that_the_roll_out_runs():
    policy, seeds = Random(VEHICLE), episode_seeds("validation", 0, 0, 4)
    episodes, _ = rollout(policy, VEHICLE, seeds, noise="episode", noise_level=1.0, deterministic=False)
    among = trace_among(policy, VEHICLE, seeds, 2, "episode", 1.0)
    assert among.outcomes["min_clearance"] == episodes.min_clearance[2]
    assert same(among, trace(policy, VEHICLE, int(seeds[2]), "episode", 1.0))  # chance computes no matrices


def made(steps: int = 3) -> Trajectory:
    rng = np.random.default_rng(steps)
    rows = {"state": 3, "goal": 2, "true": 5, "reading": 5}
    arrays = {name: rng.normal(size=(steps + 1, width)) for name, width in rows.items()}
    one = {"cost": np.zeros(steps), "reward": np.arange(steps) / 3, "arrived": np.array(True)}
    return Trajectory(
        **arrays, action=rng.normal(size=(steps, 2)), clearance=np.arange(steps + 1.0) - 0.5, **one
    )


def test_files_keep_trajectories_to_the_last_digit(tmp_path):
    path = tmp_path / "a.rise"
    trajectories.save(path, {7: made(), 2: made(5)}, {"row": "rise"})
    episodes, description = trajectories.load(path)
    assert list(episodes) == [7, 2] and description["row"] == "rise"
    assert same(episodes[7], made()) and same(episodes[2], made(5))


def test_files_that_are_none_are_refused(tmp_path):
    path = tmp_path / "a.rise"
    with pytest.raises(ValueError, match=r"a\.rise cannot be read as trajectories .*does not exist"):
        trajectories.load(path)
    trajectories.save(path, {7: made()}, {})
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    with pytest.raises(ValueError, match="damaged"):
        trajectories.load(path)


def test_uneven_rows_are_refused():
    whole = made()
    parts = {field.name: getattr(whole, field.name) for field in fields(Trajectory)} | {"cost": np.zeros(2)}
    with pytest.raises(ValueError, match="3 steps has 3 rows of 'cost', got 2"):
        Trajectory(**parts)


def test_the_start_counts_to_no_step():
    parts = {f.name: getattr(made(), f.name) for f in fields(Trajectory)}
    parts["clearance"] = np.array([0.1, 0.9, 0.3, 0.4])
    found = Trajectory(**parts)
    assert found.outcomes["min_clearance"] == 0.3 and found.closest == 2


def test_the_body_of_the_arm_is_what_its_clearance_is_measured_from():
    """Distance of a point to the segments, less their radii, against the compiled search for the nearest capsule."""
    rng = np.random.default_rng(0)
    q = rng.uniform(panda_kinematics.JOINT_LOW, panda_kinematics.JOINT_HIGH, (20, 7))
    points = rng.uniform([-0.8, -0.5, 0.0], [0.4, 0.5, 0.9], (20, 3))
    body = task_of("RISE-SafePanda-v0").body
    assert body is not None
    ends, radii = body(np.concatenate((np.zeros((20, 6)), q), axis=1))
    a, edge = ends[:, :, 0], ends[:, :, 1] - ends[:, :, 0]
    along = ((points[:, None] - a) * edge).sum(-1) / (edge**2).sum(-1)
    nearest = a + np.clip(along, 0, 1)[..., None] * edge
    distance = np.linalg.norm(points[:, None] - nearest, axis=-1) - radii
    expected, _ = panda_kinematics.clearance(q, points, np.zeros(20))
    np.testing.assert_allclose(distance.min(1), expected, atol=1e-12)
    assert task_of(VEHICLE).body is None
