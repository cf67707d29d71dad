"""The belief over obstacles: what it remembers, how it is formed, what it learns from, and how it is acted on."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch

from rise_agents import load_agent, make_agent
from rise_agents.belief import history, posterior, practice
from rise_agents.belief.history import Readings
from rise_agents.belief.posterior import Estimates, Frame
from rise_agents.belief.shield import BINS, Shield
from rise_agents.cloning import ActionUnits, make_task
from rise_agents.rollout import rollout
from rise_agents.seeds import episode_seeds
from rise_envs.noise_wrappers import VectorObservationNoise

VEHICLE, PANDA, ARMS = "RISE-GroundVehicle-v0", "RISE-SafePanda-v0", "RISE-SafePandaKinematic-v0"
BRIEF = {"updates": 600, "belief_updates": 800, "belief_rows": 30_000, "belief_batch_size": 512}
MEMORIES = (1.0, 0.9, 0.7)


@pytest.fixture(scope="module")
def trained(vehicle_demonstrations):
    return make_agent("rise-belief", VEHICLE, BRIEF, seed=1).learn(vehicle_demonstrations)


def sequence(steps, dim, rng, rows=3):
    """Readings of some rows that follow one another."""
    draw = rng.normal
    return [
        Readings(draw(size=(rows, dim)) * 5, draw(size=(rows, dim)), draw(size=rows)) for _ in range(steps)
    ]


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("steps", [2, 3, 40])
def test_memories_are_weighted_means_and_least_squares_lines(dim, steps):
    """Against NumPy's polynomial fit with the weights λ^age written out."""
    dt, seen = 0.1, sequence(steps, dim, np.random.default_rng(steps))
    sums = history.nothing(3, len(MEMORIES), dim)
    for reading in seen:
        sums = history.remembered(sums, reading, dt, MEMORIES)
    found = history.evidence(sums, dim)
    times = -dt * np.arange(steps)[::-1]  # now is 0
    p, v, r = (np.stack([getattr(reading, name) for reading in seen]) for name in Readings._fields)
    for i, memory in enumerate(MEMORIES):
        weights = memory ** np.arange(steps)[::-1]
        share = weights / weights.sum()
        for row in range(3):
            mean_v = share @ v[:, row]
            np.testing.assert_allclose(found.velocity[row, i], mean_v, atol=1e-9)
            np.testing.assert_allclose(found.carried[row, i], share @ (p[:, row] - times[:, None] * mean_v))
            slope, now = np.polyfit(times, p[:, row], 1, w=np.sqrt(weights))
            np.testing.assert_allclose(found.slope[row, i], slope, rtol=1e-6, atol=1e-6)
            np.testing.assert_allclose(found.fitted[row, i], now, rtol=1e-6, atol=1e-6)
            about_line = (p[:, row] - now - times[:, None] * slope) ** 2
            expected = [share @ about_line.mean(-1), share @ ((v[:, row] - mean_v) ** 2).mean(-1)]
            expected.append(share @ (r[:, row] - share @ r[:, row]) ** 2)
            np.testing.assert_allclose(found.scatter[row, i], np.sqrt(expected), rtol=1e-5, atol=1e-6)
            assert found.radius[row, i] == pytest.approx(share @ r[:, row])
        np.testing.assert_allclose(found.weight[:, i], weights.sum())


def test_after_one_reading_it_is_all_there_is():
    (reading,) = sequence(1, 2, np.random.default_rng(0))
    found = history.evidence(history.remembered(history.nothing(3, 3, 2), reading, 0.1, MEMORIES), 2)
    for estimate in (found.carried, found.fitted):
        np.testing.assert_allclose(estimate, np.repeat(reading.position[:, None], 3, 1))
    for estimate in (found.velocity, found.slope):
        np.testing.assert_allclose(estimate, np.repeat(reading.velocity[:, None], 3, 1))
    assert not found.scatter.any()


@pytest.mark.parametrize("env_id", [VEHICLE, PANDA])
def test_frames_lead_to_the_world_and_back(env_id):
    task, rng = make_task(env_id), np.random.default_rng(1)
    state, goal = rng.normal(size=(50, task.state_size)), rng.normal(size=(50, task.dim))
    c = rng.normal(size=(50, 2 * task.dim + 1))
    frame = Frame.of(task, state, goal)
    seen = np.concatenate([part.reshape(50, -1) for part in frame.readings(task, c)], -1)
    np.testing.assert_allclose(frame.to_world(seen), c, atol=1e-12)
    ahead = frame.point(goal)
    np.testing.assert_allclose(ahead[:, 1], 0.0, atol=1e-12)  # the first axis leads to the goal ...
    assert (ahead[:, 0] >= 0).all()
    origin, _ = task.pose(state)
    np.testing.assert_allclose(np.linalg.norm(ahead, axis=-1), np.linalg.norm(goal - origin, axis=-1))
    if task.dim == 3:  # ... and up stays up
        np.testing.assert_allclose(ahead[:, 2], (goal - origin)[:, 2])


def test_a_goal_straight_above_leaves_the_frame_unturned():
    task = make_task(PANDA)
    state = np.zeros((1, task.state_size))
    np.testing.assert_array_equal(Frame.of(task, state, np.array([[0.0, 0.0, 0.3]])).rotation[0], np.eye(3))


def answer_for(chosen, memories=3, dim=2, correction=0.0, log_sigma=0.0):
    """An answer of the network that is sure of one estimate of each kind."""
    parts = [
        np.where(np.arange(n) == k, 50.0, 0.0)
        for n, k in zip(posterior.counts(memories), chosen, strict=True)
    ]
    channels = 2 * dim + 1
    return np.concatenate((*parts, np.full(channels, correction), np.full(channels, log_sigma)))[None]


def test_the_belief_weighs_estimates_corrects_and_bounds():
    rng, scale = np.random.default_rng(2), np.array([0.5, 0.5, 2.0, 2.0, 1.0])
    offered = Estimates(
        *(rng.normal(size=(1, n, d)) for n, d in zip(posterior.counts(3), (2, 2, 1), strict=True))
    )
    mu, sigma = posterior.posterior(answer_for((4, 7, 2), correction=1.5, log_sigma=-1.0), offered, scale, 3)
    chosen = np.concatenate((offered.position[:, 4], offered.velocity[:, 7], offered.radius[:, 2]), -1)
    np.testing.assert_allclose(sigma[0], np.exp(-1.0) * scale)
    np.testing.assert_allclose(mu, chosen + 1.5 * sigma)
    even, _ = posterior.posterior(np.zeros((1, posterior.outputs(3, 2))), offered, scale, 3)
    np.testing.assert_allclose(even[0, :2], offered.position[0].mean(0))
    wild = posterior.posterior(answer_for((0, 0, 0), correction=1e9, log_sigma=1e9), offered, scale, 3)
    first = np.concatenate([part[:, 0] for part in offered], -1)
    np.testing.assert_allclose(wild[1][0], np.exp(2.0) * scale)
    np.testing.assert_allclose(wild[0], first + 5.0 * wild[1])


def test_numpy_and_torch_believe_the_same():
    rng = np.random.default_rng(3)
    answer, scale = rng.normal(size=(7, posterior.outputs(3, 3))) * 4, rng.uniform(0.1, 1, 7)
    offered = Estimates(
        *(rng.normal(size=(7, n, d)) for n, d in zip(posterior.counts(3), (3, 3, 1), strict=True))
    )
    ours = posterior.posterior(answer, offered, scale, 3)
    theirs = posterior.posterior(
        torch.from_numpy(answer), Estimates(*map(torch.from_numpy, offered)), torch.from_numpy(scale), 3
    )
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, b.numpy(), rtol=1e-12)


def test_errors_are_of_all_kinds_and_sizes():
    """Shares and ranges as stated: clean, constant, fresh and mixed sequences; channels alike or not."""
    scale = np.array([2.0, 2.0, 1.0, 1.0, 0.5])
    drawn = practice.errors(np.random.default_rng(0), 4_000, 60, scale, 2) / scale
    scatter = drawn.std(1)  # (E, C)
    white = (np.ptp(drawn, axis=1) > 0).any(-1)
    assert (~white).mean() == pytest.approx(practice.CLEAN, abs=0.02)
    bias = np.abs(drawn[~white][:, 0]) > 0  # where nothing is fresh, the error is the bias
    assert (~bias.any(-1)).mean() == pytest.approx(practice.UNBIASED, abs=0.06)
    assert (drawn[~white] == drawn[~white][:, :1]).all()
    # Two channels of one quantity share their size; over 60 steps it is known to a tenth.
    ratio = scatter[white][:, 0] / np.where(scatter[white][:, 1] > 0, scatter[white][:, 1], 1.0)
    assert 0.9 < np.median(ratio[ratio > 0]) < 1.1
    size = scatter[white].max(-1)
    assert size.min() < 0.06
    assert 2.0 < size.max() < 12.0


def test_practice_shows_what_acting_will_show(vehicle_demonstrations, trained, monkeypatch):
    """Rows made for training are what the agent sees of the same readings in an episode, truth included."""
    monkeypatch.setattr(practice, "errors", lambda rng, e, t, scale, dim: np.zeros((e, t, len(scale))))
    monkeypatch.setattr(practice, "EARLY", 10**9)  # keep every step
    one = vehicle_demonstrations.first(1)
    made = practice.practise(trained.task, one, MEMORIES, len(one.actions), seed=0)
    assert len(made.truth) == len(one.actions)
    seen = []
    monkeypatch.setattr(trained, "_network", lambda x: (seen.append(x), trained_network(x))[1])
    state = None
    for t in range(len(one.actions)):
        row = {key: value[t : t + 1] for key, value in one.observations.items()}
        _, _, state = trained.believe(row, state)
        frame = Frame(state[0], state[1])
        c = frame.readings(trained.task, row["obstacle"])
        expected = np.concatenate([part.reshape(1, -1) for part in c], -1)
        np.testing.assert_allclose(made.truth[t : t + 1], expected, atol=1e-5)
    np.testing.assert_allclose(np.concatenate(seen), made.inputs, rtol=1e-4, atol=1e-4)


def trained_network(x):
    return np.zeros((len(x), posterior.outputs(3, 2)), np.float32)


def beliefs(agent, noise, level, episodes=64, steps=25):
    """Readings, beliefs and truth of the discs after some steps of standing still, and the belief's deviations."""
    env = gym.make_vec(VEHICLE, episodes, vectorization_mode="vector_entry_point")
    wrapped = VectorObservationNoise(env, noise, noise_level=level) if level else env
    observation, info = wrapped.reset(seed=5)
    state = None
    for step in range(steps):
        mu, sigma, state = agent.believe(observation, state)
        if step + 1 < steps:
            observation, *_, info = wrapped.step(np.zeros((episodes, 2), np.float32))
    truth = (info["clean_observation"] if level else observation)["obstacle"]
    if level and not isinstance(truth, np.ndarray):
        truth = np.stack(list(truth))
    wrapped.close()
    return observation["obstacle"], mu[:, 0], sigma[:, 0], truth


def test_the_belief_is_nearer_the_truth_than_the_reading_and_knows_how_near(trained):
    reading, mu, sigma, truth = beliefs(trained, "step", 1.0)
    error, before = (np.sqrt(((x - truth) ** 2).mean(0)) for x in (mu, reading))
    assert (error < 0.55 * before).all(), (error, before)
    spread = ((mu - truth) / sigma) ** 2
    assert 0.3 < spread[:, 4].mean() < 3.0  # radii are not turned between frames
    clean, mu, sigma_clean, truth = beliefs(trained, "step", 0.0)
    np.testing.assert_array_equal(clean, truth)
    assert np.abs(mu - truth).mean() < 0.15
    assert sigma_clean.mean() < 0.5 * sigma.mean()


def test_a_bias_shows_where_readings_contradict_the_motion(trained):
    """A constant error of the velocity: after a while the slope of the positions is believed more."""
    reading, mu, _, truth = beliefs(trained, "episode", 1.0, steps=40)
    velocity = slice(2, 4)
    error, before = (np.sqrt(((x - truth)[:, velocity] ** 2).mean()) for x in (mu, reading))
    assert error < 0.75 * before


def test_the_margin_follows_the_uncertainty(trained, vehicle_demonstrations, tmp_path):
    trained.save(tmp_path / "belief.rise")
    wide = load_agent(tmp_path / "belief.rise", VEHICLE, "cpu", {"margin": 1.5})
    rows = {key: value[:20].copy() for key, value in vehicle_demonstrations.observations.items()}
    rows["obstacle"][:, :2] += 30.0  # far off: nothing is moved away
    mu, sigma, _ = wide.believe(rows)
    c = wide._careful(rows, mu, sigma)
    np.testing.assert_allclose(c[:, :4], mu[:, 0, :4])
    uncertain = np.sqrt((sigma[:, 0, 0] ** 2 + sigma[:, 0, 1] ** 2) / 2 + sigma[:, 0, 4] ** 2)
    np.testing.assert_allclose(c[:, 4] - mu[:, 0, 4], 1.5 * uncertain)
    with pytest.raises(ValueError, match="updates"):
        load_agent(tmp_path / "belief.rise", VEHICLE, "cpu", {"updates": 3})


def test_nobody_is_nearer_than_demonstrations_were(trained, vehicle_demonstrations):
    d = vehicle_demonstrations
    position, _, radius = trained.task.split(d.observations["obstacle"])
    gap = np.linalg.norm(position[:, 0] - d.observations["observation"][:, :2], axis=-1) - radius[:, 0] - 0.5
    rows = {key: value[:100].copy() for key, value in d.observations.items()}
    rng = np.random.default_rng(4)
    mu = np.concatenate(
        (rows["observation"][:, :2] + rng.normal(size=(100, 2)), rng.normal(size=(100, 2))), -1
    )
    mu = np.concatenate((mu, rng.uniform(0.1, 4.0, (100, 1))), -1)[:, None]
    c = trained._careful(rows, mu, np.full((100, 1, 5), 0.3))
    held = np.linalg.norm(c[:, :2] - rows["observation"][:, :2], axis=-1) - c[:, 4] - 0.5
    assert held.min() >= gap.min() - 1e-9
    assert (c[:, 4] >= np.minimum(radius.min(), mu[:, 0, 4]) - 1e-9).all()
    cross = (c[:, :2] - rows["observation"][:, :2]) * (mu[:, 0, :2] - rows["observation"][:, :2])[:, ::-1]
    np.testing.assert_allclose(cross[:, 0], cross[:, 1], atol=1e-9)  # moved straight away, not aside


def test_episodes_begin_anew_where_told(trained, vehicle_demonstrations):
    rows = {key: value[:4] for key, value in vehicle_demonstrations.observations.items()}
    later = {key: value[10:14] for key, value in vehicle_demonstrations.observations.items()}
    _, state = trained.predict(rows)
    starts = np.array([True, False, True, False])
    mixed, after = trained.predict(later, state, starts)
    fresh, _ = trained.predict(later)
    carried, _ = trained.predict(later, state)
    np.testing.assert_allclose(mixed[starts], fresh[starts], atol=1e-6)
    np.testing.assert_allclose(mixed[~starts], carried[~starts], atol=1e-6)
    assert (carried != fresh).any()
    np.testing.assert_array_equal(after[3], [1, 2, 1, 2])


def test_many_discs_are_believed_each_for_itself(trained, monkeypatch):
    """A disc's belief does not depend on the others', whichever place it has in the reading."""
    from dataclasses import replace

    task = make_task(VEHICLE)
    rng = np.random.default_rng(6)
    state, goal = rng.normal(size=(5, 3)), rng.normal(size=(5, 2)) * 5
    discs = rng.uniform(0.5, 3.0, (5, 3, 5))

    def belief(reading, n):
        monkeypatch.setattr(trained, "task", replace(task, n_obstacles=n, noise_scale=(1.0,) * 5 * n))
        rows = {"observation": state, "desired_goal": goal, "obstacle": reading.reshape(5, -1)}
        return trained.believe(rows)[0]

    together = belief(discs, 3)
    for i in range(3):
        np.testing.assert_allclose(together[:, i], belief(discs[:, i], 1)[:, 0], atol=1e-5)


def test_the_vehicle_s_kinematics_are_those_of_the_environment():
    env = gym.make_vec(VEHICLE, 200, vectorization_mode="vector_entry_point")
    before, _ = env.reset(seed=1)
    env.action_space.seed(2)
    action = env.action_space.sample()
    moved = make_task(VEHICLE).moved(before["observation"], action[:, None].astype(float), 0.1)
    after, *_ = env.step(action)
    np.testing.assert_allclose(moved[:, 0], after["observation"][:, :2], atol=1e-9)
    env.close()


def test_the_hand_s_kinematics_are_near_those_of_the_arm():
    """A linear model: a centimetre at most in the mean while an expert drives, far less than the hand moves."""
    from rise_agents.experts import make_expert

    _, rows = rollout(make_expert("cbf", PANDA), ARMS, episode_seeds("validation", 0, 0, 30), record=True)
    task, last = make_task(PANDA), rows.offsets[1:] - 1
    state = rows.observations["observation"]
    moved = task.moved(state, rows.actions[:, None], task.dt)[:, 0]
    inner = np.setdiff1d(np.arange(len(state)), last)
    error = np.linalg.norm(moved[inner] - state[inner + 1, :3], axis=-1)
    still = np.linalg.norm(state[inner, :3] - state[inner + 1, :3], axis=-1)
    assert error.mean() < 0.01
    assert error.mean() < 0.4 * still.mean()


def test_the_shield_lets_good_actions_pass_and_replaces_bad_ones(vehicle_demonstrations):
    task, units = make_task(VEHICLE), ActionUnits.of(VEHICLE)
    arrays = Shield.fit(task, units, vehicle_demonstrations)
    shield = Shield(task, units, arrays)
    d = vehicle_demonstrations
    rows, expert = d.observations, d.actions.astype(np.float32)
    kept = (shield(rows, expert) == expert).all(-1)
    assert kept.mean() > 0.9  # the quantile is 3 %, between the middles of its ranges a little more
    # A disc right ahead at arm's length, full speed: the replacement keeps what the experts kept.
    state, goal = np.zeros((1, 3)), np.array([[15.0, 0.0]])
    ahead = {"observation": state, "desired_goal": goal, "obstacle": np.array([[1.7, 0.0, -0.5, 0.0, 1.0]])}
    wanted = np.array([[2.5, 0.0]], np.float32)
    action = shield(ahead, wanted)
    assert not np.array_equal(action, wanted)

    def gap(a):
        at = task.moved(state, a[:, None].astype(float), task.dt)[:, 0]
        return np.linalg.norm(at - [1.65, 0.0]) - 1.5

    assert gap(action) > gap(wanted) + 0.1
    far = {**ahead, "obstacle": np.array([[30.0, 0.0, 0.0, 0.0, 1.0]])}
    np.testing.assert_array_equal(shield(far, wanted), wanted)


def test_the_shield_s_floor_is_the_quantile_of_each_range():
    """Obstacles that stand still and a robot that goes straight at known speeds: the floor follows by hand."""
    task, units = make_task(VEHICLE), ActionUnits.of(VEHICLE)
    rng, rows = np.random.default_rng(7), 20_000
    away, speed = rng.uniform(2.0, 12.0, rows), rng.uniform(0.0, 2.0, rows)

    class Straight:
        actions = np.stack((speed, np.zeros(rows)), -1)

        @staticmethod
        def subsample(count):
            still = np.zeros(rows)
            disc = np.stack((away, still, still, still, np.ones(rows)), -1)
            return {"observation": np.zeros((rows, 3)), "obstacle": disc}

    arrays = Shield.fit(task, units, Straight())
    order = np.array_split(np.argsort(away), BINS)
    gap = away - 1.5
    expected = [np.quantile((gap - 0.1 * speed)[part], 0.03) for part in order]
    np.testing.assert_allclose(arrays["shield.clearance"], [np.median(gap[part]) for part in order])
    np.testing.assert_allclose(arrays["shield.floor"], expected, atol=1e-9)


def test_settings_are_checked():
    for wrong, words in (
        ({"margin": -1.0}, "margin must not be negative"),
        ({"memories": []}, "memories must be numbers above 0"),
        ({"memories": [1.5]}, "memories must be numbers above 0"),
        ({"belief_hidden": [0]}, "belief_hidden"),
        ({"belief_rows": 0}, "belief_rows must be at least 1"),
    ):
        with pytest.raises(ValueError, match=words):
            make_agent("rise-belief", VEHICLE, wrong)
