"""Algorithm 1, line by line, against torch.distributions and hand-made cases."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.distributions import Independent, Normal, kl_divergence

from rise_agents import cloning, load_agent, make_agent
from rise_agents.networks import VAE, Encoder, gaussian_kl, mlp, policy_loss, reparameterise
from rise_agents.rise import Rise
from rise_agents.stages import to_arrays

VEHICLE = "RISE-GroundVehicle-v0"
BRIEF = {"updates": 40, "vae_updates": 40, "batch_size": 32, "vae_batch_size": 32, "n_samples": 3}


@pytest.fixture(scope="module")
def trained(vehicle_demonstrations):
    return make_agent("rise", VEHICLE, BRIEF, seed=1).learn(vehicle_demonstrations)


def test_kl_equals_torch_distributions():
    mu, log_sigma = torch.randn(50, 5), torch.randn(50, 5)
    posterior = Independent(Normal(mu, log_sigma.exp()), 1)
    prior = Independent(Normal(torch.zeros(50, 5), torch.ones(50, 5)), 1)
    torch.testing.assert_close(gaussian_kl(mu, log_sigma), kl_divergence(posterior, prior))


def test_elbo_is_gaussian_likelihood_plus_weighted_kl():
    """Up to the constant of the normal density, the loss is −log p(c | z) + β KL with unit deviation."""
    torch.manual_seed(0)
    vae, c, epsilon = VAE(5, (64, 64), 5), torch.randn(7, 5), torch.randn(7, 5)
    target = 3 * c + 1
    terms = vae.loss(c, target, epsilon, beta=0.3)
    mu, log_sigma = vae.encoder(c)
    z = mu + log_sigma.exp() * epsilon
    log_p = Normal(vae.decoder(z), 1.0).log_prob(target).sum(-1)
    constant = 2.5 * np.log(2 * np.pi)
    kl = kl_divergence(Normal(mu, log_sigma.exp()), Normal(0.0, 1.0)).sum(-1)
    torch.testing.assert_close(terms["loss"], (-log_p - constant + 0.3 * kl).mean())


def test_reparameterisation_has_the_posterior_s_moments():
    mu, log_sigma = torch.tensor([1.0, -2.0]), torch.tensor([0.3, -1.0])
    z = reparameterise(mu, log_sigma, torch.randn(200_000, 2, generator=torch.Generator().manual_seed(0)))
    torch.testing.assert_close(z.mean(0), mu, atol=0.01, rtol=0)
    torch.testing.assert_close(z.std(0), log_sigma.exp(), atol=0.01, rtol=0)


def test_policy_loss_is_the_mean_over_m_samples():
    torch.manual_seed(0)
    policy, robot, action = mlp(4 + 2, (8,), 3), torch.randn(6, 4), torch.randn(6, 3)
    mu, log_sigma, epsilon = torch.randn(6, 2), torch.randn(6, 2), torch.randn(5, 6, 2)
    total = 0.0
    policy.requires_grad_(False)
    for m in range(5):
        for row in range(6):
            z = mu[row] + log_sigma[row].exp() * epsilon[m, row]
            guess = policy(torch.cat((robot[row], z)))
            total += float(((guess - action[row]) ** 2).sum())
    loss = policy_loss(policy, robot, mu, log_sigma, action, epsilon, "mse")["loss"]
    assert float(loss) == pytest.approx(total / (5 * 6), rel=1e-5)


def test_nll_loss_equals_torch_distributions():
    output, action = torch.randn(4, 6), torch.randn(4, 3)
    mean, log_std = output.chunk(2, -1)
    expected = -Normal(mean, log_std.exp()).log_prob(action).sum(-1).mean() - 1.5 * np.log(2 * np.pi)
    torch.testing.assert_close(cloning.imitation_loss(output, action, "nll"), expected.float())


def test_stage_two_leaves_the_vae_as_it_was(vehicle_demonstrations, monkeypatch):
    """The weights right after stage 1 are the weights that are stored, and no gradient reaches them."""
    seen = {}
    fit_policy = Rise._fit_policy

    def spy(self, policy, lesson, posterior, progress):
        assert not any(part.requires_grad for part in posterior)
        fit_policy(self, policy, lesson, posterior, progress)

    fit_vae = Rise._fit_vae

    def remember(self, vae, *args):
        fit_vae(self, vae, *args)
        seen.update(to_arrays(vae, "vae"))

    monkeypatch.setattr(Rise, "_fit_policy", spy)
    monkeypatch.setattr(Rise, "_fit_vae", remember)
    agent = make_agent("rise", VEHICLE, BRIEF).learn(vehicle_demonstrations)
    assert len(seen) == 14  # encoder trunk, two heads, decoder: weights and biases
    for name, weights in seen.items():
        np.testing.assert_array_equal(agent._arrays[name], weights)


def test_encoder_in_numpy_equals_torch(trained):
    encoder = Encoder(5, trained.config.encoder_hidden, trained.config.latent)
    own = {
        k.removeprefix("vae.encoder."): v for k, v in trained._arrays.items() if k.startswith("vae.encoder.")
    }
    encoder.load_state_dict({key: torch.from_numpy(value) for key, value in own.items()})
    units = trained._eyes.reading
    reading = units.mean + units.scale * np.random.default_rng(0).normal(size=(20, 5))
    mu, sigma = trained.encode(reading)
    with torch.no_grad():
        expected_mu, expected_log_sigma = encoder(torch.from_numpy(units(reading)))
    np.testing.assert_allclose(mu, expected_mu, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(sigma, expected_log_sigma.exp(), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("loss", ["mse", "nll"])
def test_policy_in_numpy_equals_torch(vehicle_demonstrations, loss):
    """In the units of inputs, latent and actions: what training sees in standard units gives the same action."""
    agent = make_agent("rise", VEHICLE, {**BRIEF, "loss": loss}, seed=2).learn(vehicle_demonstrations)
    observation = vehicle_demonstrations.subsample(200)
    mu, _ = agent.encode(agent._eyes.inputs(observation)[1])
    robot, _ = agent._eyes(observation)
    policy = mlp(robot.shape[1] + mu.shape[1], agent.config.hidden, cloning.output_size(2, loss))
    own = {k.removeprefix("policy."): v for k, v in agent._arrays.items() if k.startswith("policy.")}
    policy.load_state_dict({key: torch.from_numpy(value) for key, value in own.items()})
    with torch.no_grad():
        unit = policy(torch.from_numpy(np.concatenate((robot, mu / agent._arrays["vae.spread"]), -1)))
    action, _ = agent.predict(observation, deterministic=True)
    expected = agent.units.to_action(unit.numpy()[:, :2])
    np.testing.assert_allclose(action, expected, rtol=1e-4, atol=1e-4)


def test_an_episode_alone_draws_what_it_draws_in_company(trained, vehicle_demonstrations):
    """The draws of a lone episode are computed ahead, step by step they are those of its own stream."""
    observation = {key: value[:3] for key, value in vehicle_demonstrations.observations.items()}
    lone = {key: value[1:2] for key, value in observation.items()}
    keys = np.array([7, 8, 9], np.uint64)
    together, alone = trained.initial_state(keys), trained.initial_state(keys[1:2])
    for step in range(150):
        actions, together = trained.predict(observation, together)
        action, alone = trained.predict(lone, alone)
        np.testing.assert_allclose(action[0], actions[1], rtol=1e-5, atol=1e-6)
        if step % 50 == 20:  # another stream in between changes nothing
            trained.predict(lone, trained.initial_state(keys[:1]))
            trained.predict(lone, (keys[:1], np.array([step], np.uint64)))


def test_inference_draws_z_from_the_posterior(trained, vehicle_demonstrations, monkeypatch):
    """z handed to the policy over many draws has the posterior's mean and deviation, and is standard normal inside."""
    rows = 20_000
    one = {key: np.repeat(value[:1], rows, 0) for key, value in vehicle_demonstrations.observations.items()}
    drawn = []
    act = trained._act
    monkeypatch.setattr(trained, "_act", lambda robot, z: drawn.append(z) or act(robot, z))
    trained.predict(one, state=trained.initial_state(np.arange(rows, dtype=np.uint64)))
    mu, sigma = trained.encode(trained._eyes.inputs(one)[1][:1])
    epsilon = (drawn[0] - mu) / sigma
    np.testing.assert_allclose(epsilon.mean(0), 0, atol=0.03)
    np.testing.assert_allclose(np.cov(epsilon.T), np.eye(epsilon.shape[1]), atol=0.03)


def test_deterministic_acts_on_the_posterior_mean(trained, vehicle_demonstrations):
    observation = {key: value[:9] for key, value in vehicle_demonstrations.observations.items()}
    robot, reading = trained._eyes.inputs(observation)
    expected = trained._act(robot, trained.encode(reading)[0])
    action, _ = trained.predict(observation, deterministic=True)
    np.testing.assert_array_equal(action, expected)


def test_posterior_mean_draws_nothing_even_where_a_sample_is_asked_for(
    trained, vehicle_demonstrations, tmp_path
):
    trained.save(tmp_path / "agent.rise")
    agent = load_agent(tmp_path / "agent.rise", VEHICLE, "cpu", {"posterior": "mean"})
    observation = {key: value[:9] for key, value in vehicle_demonstrations.observations.items()}
    expected, _ = trained.predict(observation, deterministic=True)
    before = agent.initial_state(np.arange(9, dtype=np.uint64))
    action, after = agent.predict(observation, before, deterministic=False)
    np.testing.assert_array_equal(action, expected)
    assert after is before


def test_acting_settings_lie_over_stored_ones(trained, vehicle_demonstrations, tmp_path):
    """And only these: what training depended on cannot be told afterwards."""
    trained.save(tmp_path / "agent.rise")
    path = tmp_path / "agent.rise"
    agent = load_agent(path, None, "cpu", {"average": 16})
    assert agent.config == replace(trained.config, average=16)
    assert load_agent(path, None, "cpu", {}).config == trained.config
    for settings, reason in (
        ({"beta": 0.1}, "'beta' is no setting that a trained rise acts by; known: average, posterior"),
        ({"averag": 2}, "did you mean 'average'"),
        ({"average": 0}, "average must be at least 1"),
        ({"posterior": "mode"}, "posterior must be one of"),
    ):
        with pytest.raises(ValueError, match=reason):
            load_agent(path, None, "cpu", settings)
    pcbc = make_agent("pcbc", VEHICLE, {"updates": 2}).learn(vehicle_demonstrations)
    pcbc.save(tmp_path / "pcbc.rise")
    with pytest.raises(ValueError, match="'frame' is no setting that a trained pcbc acts by; it has none"):
        load_agent(tmp_path / "pcbc.rise", None, "cpu", {"frame": "body"})


def test_each_seed_learns_from_its_own_part(vehicle_demonstrations):
    """Seeds take disjoint blocks of the demonstrations, so that what they differ in includes the data."""
    agents = [make_agent("rise", VEHICLE, {"transitions": 500}, seed=seed) for seed in range(3)]
    parts = [cloning.check_source(vehicle_demonstrations, agent) for agent in agents]
    seeds = [set(part.seeds.tolist()) for part in parts]
    assert all(len(part.actions) <= 500 for part in parts)
    assert not (seeds[0] & seeds[1] or seeds[0] & seeds[2] or seeds[1] & seeds[2])
    everything = cloning.check_source(vehicle_demonstrations, make_agent("rise", VEHICLE, seed=1))
    assert everything is vehicle_demonstrations


def test_average_of_many_samples_has_less_spread(vehicle_demonstrations):
    """The K-sample average: the spread of the action over draws falls as 1/√K where nothing is clipped."""
    one = {key: np.repeat(value[:1], 4_000, 0) for key, value in vehicle_demonstrations.observations.items()}
    spreads = []
    for average in (1, 16):
        config = {**BRIEF, "beta": 1.0, "average": average}  # which changes nothing that is learned
        agent = make_agent("rise", VEHICLE, config).learn(vehicle_demonstrations)
        action, _ = agent.predict(one, state=agent.initial_state(np.arange(4_000, dtype=np.uint64)))
        spreads.append(action[:, 1].std())
    assert spreads[1] == pytest.approx(spreads[0] / 4, rel=0.1)


def test_decoder_answers_in_units_of_the_reading_noise(trained, vehicle_demonstrations):
    """Standard units times the stored ratio are SI units over the noise scale (1 on the vehicle), but for the mean."""
    observation = vehicle_demonstrations.subsample(50)
    c = trained._eyes(observation)[1] * trained._arrays["vae.ratio"]
    from rise_agents.readings import inputs

    raw = inputs(trained.task, "body", observation)[1]
    np.testing.assert_allclose(c - c.mean(0), raw - raw.mean(0), atol=1e-4)


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("beta", -1),
        ("latent", 0),
        ("n_samples", 0),
        ("frame", "moon"),
        ("loss", "mae"),
        ("learning_rate", 0.0),
        ("posterior", "mode"),
        ("hidden", ("a",)),
        ("transitions", "x"),
    ],
)
def test_settings_out_of_range_are_refused(setting, value):
    with pytest.raises(ValueError, match=setting):
        make_agent("rise", VEHICLE, {setting: value})


def test_a_collapsed_latent_reaches_the_policy_with_unit_scale(vehicle_demonstrations):
    """With β so large that the posterior is the prior, what the policy sees is N(0, 1), not noise blown up."""
    agent = make_agent("rise", VEHICLE, {**BRIEF, "beta": 1e4, "vae_updates": 400}).learn(
        vehicle_demonstrations
    )
    mu, sigma = agent.encode(agent._eyes.inputs(vehicle_demonstrations.observations)[1])
    spread = np.sqrt(mu.var(0) + (sigma**2).mean(0))
    np.testing.assert_allclose(agent._arrays["vae.spread"], spread, rtol=1e-3)
