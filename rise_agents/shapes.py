"""Names and shapes of what trained networks store, told without making one: loading an agent takes no torch.

Shapes: K network inputs, A action dimensions or number of discrete actions, Z latent.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence

Shapes = dict[str, tuple[int, ...]]


def linear(name: str, inputs: int, outputs: int) -> Shapes:
    """Of one fully connected layer."""
    return {f"{name}.weight": (outputs, inputs), f"{name}.bias": (outputs,)}


def sequential(name: str, widths: Sequence[int]) -> Shapes:
    """Of fully connected layers in a ``Sequential``, each with an activation after it but perhaps the last one."""
    layers = [linear(f"{name}.{2 * i}", *pair) for i, pair in enumerate(itertools.pairwise(widths))]
    return {key: shape for layer in layers for key, shape in layer.items()}


def mlp(name: str, inputs: int, hidden: Sequence[int], outputs: int) -> Shapes:
    """Of :func:`rise_agents.networks.mlp`."""
    return sequential(name, [inputs, *hidden, outputs])


def vae(name: str, inputs: int, hidden: Sequence[int], latent: int) -> Shapes:
    """Of :class:`rise_agents.networks.VAE`."""
    return {
        **sequential(f"{name}.encoder.trunk", [inputs, *hidden]),
        **linear(f"{name}.encoder.mu", hidden[-1], latent),
        **linear(f"{name}.encoder.log_sigma", hidden[-1], latent),
        **mlp(f"{name}.decoder", latent, hidden[::-1], inputs),
    }


def adam(name: str, parameters: Iterable[tuple[int, ...]]) -> Shapes:
    """Of :func:`rise_agents.stages.moments` of an Adam over ``parameters``."""
    shapes: Shapes = {}
    for i, shape in enumerate(parameters):
        shapes |= {f"{name}.{i}.exp_avg": shape, f"{name}.{i}.exp_avg_sq": shape, f"{name}.{i}.step": ()}
    return shapes


def constrained_ppo(inputs: int, outputs: int, hidden: Sequence[int], boxes: bool) -> Shapes:
    """Of the floats that :meth:`rise_agents.constrained_ppo.ConstrainedPPO.snapshot` gives.

    Args:
        inputs: how many: K.
        outputs: how many: A.
        hidden: widths of all three networks.
        boxes: whether actions are continuous.
    """
    policy: Shapes = {
        **({"policy.log_std": (outputs,)} if boxes else {}),
        **sequential("policy.mlp_extractor.policy_net", [inputs, *hidden]),
        **sequential("policy.mlp_extractor.value_net", [inputs, *hidden]),
        **linear("policy.action_net", hidden[-1], outputs),
        **linear("policy.value_net", hidden[-1], 1),
    }
    critic = mlp("cost_critic", inputs, hidden, 1)
    moments = {**adam("optimizer", policy.values()), **adam("cost_optimizer", critic.values())}
    return {**policy, **critic, **moments}
