"""An agent whose networks are torch's again: rebuilt from the stored arrays, in standard units, as in training."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rise_agents.readings import Standardiser


def in_torch(agent: Any) -> Any:
    """A copy of a trained agent that acts by networks in torch."""
    twin = copy.copy(agent)
    _KINDS[agent.name](twin, agent._arrays)
    return twin


def _module(arrays: dict[str, NDArray], name: str, make: Callable[[], Any]) -> Callable[..., NDArray]:
    """The network stored under ``name``, of arrays (B, ·) in standard units, float32."""
    import torch

    module = make()
    module.load_state_dict(
        {
            key.removeprefix(f"{name}."): torch.from_numpy(np.array(array, np.float32))
            for key, array in arrays.items()
            if key.startswith(f"{name}.") and key.endswith((".weight", ".bias"))
        }
    )

    def act(*parts: NDArray) -> Any:
        x = torch.from_numpy(np.concatenate(parts, -1, dtype=np.float32, casting="same_kind"))
        with torch.no_grad():
            given = module(x)
        return tuple(part.numpy() for part in given) if isinstance(given, tuple) else given.numpy()

    return act


def _policy(twin: Any, arrays: dict[str, NDArray], inputs: int) -> Callable[..., NDArray]:
    """Actions of the cloned policy on inputs in standard units; of a Gaussian one the means."""
    from rise_agents.cloning import output_size
    from rise_agents.networks import mlp

    size = twin.units.size
    network = _module(
        arrays, "policy", lambda: mlp(inputs, twin.config.hidden, output_size(size, twin.config.loss))
    )
    return lambda *parts: twin.units.to_action(network(*parts)[:, :size].astype(np.float64))


def _rise(twin: Any, arrays: dict[str, NDArray]) -> None:
    from rise_agents.networks import Encoder

    c, eyes, spread = twin.config, twin._eyes, arrays["vae.spread"]
    encode = _module(
        arrays, "vae.encoder", lambda: Encoder(len(eyes.reading.mean), c.encoder_hidden, c.latent)
    )
    act = _policy(twin, arrays, len(eyes.robot.mean) + c.latent)
    twin._encoder = lambda reading: np.concatenate(encode(eyes.reading(reading)), -1)
    twin._policy = lambda robot, z: act(eyes.robot(robot), (z / spread).astype(np.float32))


def _clone(twin: Any, arrays: dict[str, NDArray]) -> None:
    twin._clone = copy.copy(twin._clone)
    eyes = twin._clone.eyes
    act = _policy(twin, arrays, len(eyes.robot.mean) + len(eyes.reading.mean))
    twin._clone._policy = lambda robot, reading: act(eyes.robot(robot), eyes.reading(reading))


def _belief(twin: Any, arrays: dict[str, NDArray]) -> None:
    from rise_agents.networks import mlp

    _clone(twin, arrays)
    units = Standardiser.from_arrays(arrays, "belief.units")
    network = _module(arrays, "belief", lambda: mlp(*twin._sizes()))
    twin._network = lambda seen: network(units(seen))


def _cppo(twin: Any, arrays: dict[str, NDArray]) -> None:
    import torch
    from torch import nn

    actor = twin._actor = copy.copy(twin._actor)
    layers: list[nn.Module] = []
    for weight, bias in actor.layers:
        layer = nn.Linear(*weight.shape)
        layer.load_state_dict({"weight": torch.from_numpy(weight.T), "bias": torch.from_numpy(bias)})
        layers += [layer, nn.Tanh()]
    network = nn.Sequential(*layers[:-1])

    def output(inputs: NDArray) -> NDArray[np.float64]:
        with torch.no_grad():
            return network(torch.from_numpy(actor.units(inputs))).double().numpy()

    actor.output = output


_KINDS: dict[str, Callable[[Any, dict[str, NDArray]], None]] = {
    "rise": _rise,
    "pcbc": _clone,
    "cppo": _cppo,
    "rise-belief": _belief,
}
