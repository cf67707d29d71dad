"""Trained networks in NumPy against torch, with the units of inputs and outputs folded into their layers."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rise_agents import make_agent, shapes
from rise_agents.cloning import output_size
from rise_agents.forward import Forward, layers_of, rescaled, standardised
from rise_agents.networks import VAE, FirstLinear, mlp
from rise_agents.stages import to_arrays

VEHICLE = "RISE-GroundVehicle-v0"


@pytest.mark.parametrize("hidden", [(8,), (16, 5), (7, 7, 7)])
@pytest.mark.parametrize("rows", [1, 9])
def test_forward_equals_torch(hidden, rows):
    torch.manual_seed(0)
    network = mlp(4, hidden, 6)
    rng = np.random.default_rng(1)
    x, mean, scale = rng.normal(size=(rows, 4)), rng.normal(size=4), rng.uniform(0.5, 2, 4)
    gain, shift = rng.normal(size=2), rng.normal(size=2)
    first, *rest, last = layers_of(to_arrays(network, "net"), "net")
    forward = Forward([standardised(first, mean, scale), *rest, rescaled(last, gain, shift)])
    with torch.no_grad():
        y = network(torch.from_numpy((x - mean) / scale).float()).numpy()
    expected = gain * y[:, :2] + shift
    np.testing.assert_allclose(forward(x), expected, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(forward(x[:, :1], x[:, 1:]), expected, rtol=1e-5, atol=1e-5)
    assert forward(x).dtype == np.float32


@pytest.mark.parametrize("hidden", [(8,), (16, 5), (7, 6, 5)])
def test_shapes_are_known_without_torch(hidden):
    for network, expected in (
        (mlp(4, hidden, 3), shapes.mlp("net", 4, hidden, 3)),
        (VAE(4, hidden, 2), shapes.vae("net", 4, hidden, 2)),
    ):
        assert {key: array.shape for key, array in to_arrays(network, "net").items()} == expected


@pytest.mark.parametrize("shape", [(5,), (2, 5)])
def test_first_layer_is_a_linear_layer(shape):
    torch.manual_seed(0)
    ours, theirs, x = FirstLinear(3, 4), torch.nn.Linear(3, 4), torch.randn(*shape, 3)
    theirs.load_state_dict(ours.state_dict())
    for layer in (ours, theirs):
        (layer(x) ** 2).sum().backward()
    torch.testing.assert_close(ours(x), theirs(x))
    torch.testing.assert_close(ours.weight.grad, theirs.weight.grad)
    torch.testing.assert_close(ours.bias.grad, theirs.bias.grad)


def test_layers_are_found_in_order_and_by_their_whole_name():
    """Eleven layers sort by number, not by letter; a name that begins alike is another network."""
    arrays = {}
    for i in range(11):
        arrays |= {f"net.{i}.weight": np.full((1, 1), i), f"net.{i}.bias": np.zeros(1)}
    arrays |= {"net2.0.weight": np.zeros((1, 1)), "net.mu.weight": np.zeros((1, 1))}
    assert [weight[0, 0] for weight, _ in layers_of(arrays, "net")] == list(range(11))


@pytest.mark.parametrize("loss", ["mse", "nll"])
def test_pcbc_acts_as_its_network_in_torch(vehicle_demonstrations, loss):
    agent = make_agent("pcbc", VEHICLE, {"updates": 30, "loss": loss}).learn(vehicle_demonstrations)
    observation = vehicle_demonstrations.subsample(200)
    seen = np.concatenate(agent._clone.eyes(observation), -1)
    policy = mlp(seen.shape[1], agent.config.hidden, output_size(2, loss))
    own = {k.removeprefix("policy."): v for k, v in agent._arrays.items() if k.startswith("policy.")}
    policy.load_state_dict({key: torch.from_numpy(value) for key, value in own.items()})
    with torch.no_grad():
        expected = agent.units.to_action(policy(torch.from_numpy(seen)).numpy()[:, :2])
    np.testing.assert_allclose(agent.predict(observation)[0], expected, rtol=1e-4, atol=1e-4)
