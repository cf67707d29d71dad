"""The networks of the paper, and what they minimise: Gaussian encoder and decoder of readings, policy.

Shapes: B batch, M samples, R robot inputs, C reading inputs, Z latent, A actions.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from rise_agents.cloning import imitation_loss
from rise_agents.forward import LOG_SIGMA_RANGE


class FirstLinear(nn.Linear):
    """A layer of few inputs and many rows: ``nn.Linear`` with its weights in the other order of memory.

    The gradient of the weights is then inputsᵀ · gradients instead of the transpose of gradientsᵀ · inputs, the
    same product, which libraries of linear algebra are five times slower at: a tenth of a whole update.
    """

    def forward(self, x: Tensor) -> Tensor:
        """(…, inputs) → (…, outputs)."""
        return nn.functional.linear(x, self.weight.t().contiguous().t(), self.bias)


def mlp(inputs: int, hidden: Sequence[int], outputs: int) -> nn.Sequential:
    """Fully connected layers with ReLU between them, (…, inputs) → (…, outputs)."""
    widths = [inputs, *hidden]
    layers: list[nn.Module] = []
    for width, following in itertools.pairwise(widths):
        kind = nn.Linear if layers else FirstLinear
        layers += [kind(width, following), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(widths[-1], outputs))


class Encoder(nn.Module):
    """q_φ(z | c): ReLU layers that culminate in parallel outputs for μ and log σ (paper, section III-B)."""

    def __init__(self, inputs: int, hidden: Sequence[int], latent: int) -> None:
        super().__init__()
        self.trunk = nn.Sequential(*list(mlp(inputs, hidden[:-1], hidden[-1])), nn.ReLU())
        self.mu, self.log_sigma = nn.Linear(hidden[-1], latent), nn.Linear(hidden[-1], latent)

    def forward(self, c: Tensor) -> tuple[Tensor, Tensor]:
        """Readings (…, C) to μ and log σ, each (…, Z)."""
        features = self.trunk(c)
        return self.mu(features), self.log_sigma(features).clamp(*LOG_SIGMA_RANGE)


def reparameterise(mu: Tensor, log_sigma: Tensor, epsilon: Tensor) -> Tensor:
    """The sample z = μ + σ ⊙ ε (paper, equation 2)."""
    return mu + log_sigma.exp() * epsilon


def gaussian_kl(mu: Tensor, log_sigma: Tensor) -> Tensor:
    """KL[N(μ, σ²) ‖ N(0, I)], summed over the latent: (…, Z) → (…)."""
    return 0.5 * (mu**2 + (2 * log_sigma).exp() - 1 - 2 * log_sigma).sum(-1)


class VAE(nn.Module):
    """Encoder and decoder of readings; the decoder answers in units of the reading noise."""

    def __init__(self, inputs: int, hidden: Sequence[int], latent: int) -> None:
        super().__init__()
        self.encoder = Encoder(inputs, hidden, latent)
        self.decoder = mlp(latent, hidden[::-1], inputs)

    def loss(self, c: Tensor, target: Tensor, epsilon: Tensor, beta: float) -> dict[str, Tensor]:
        """Negative ELBO (Algorithm 1, line 7).

        Args:
            c: readings in standard units, (B, C).
            target: the same readings in units of the reading noise, (B, C).
            epsilon: standard normal draws, (B, Z).
            beta: weight of the KL term.
        """
        mu, log_sigma = self.encoder(c)
        decoded = self.decoder(reparameterise(mu, log_sigma, epsilon))
        reconstruction = 0.5 * ((decoded - target) ** 2).sum(-1).mean()
        kl = gaussian_kl(mu, log_sigma).mean()
        return {"loss": reconstruction + beta * kl, "reconstruction": reconstruction, "kl": kl}


def policy_loss(
    policy: nn.Module,
    robot: Tensor,
    mu: Tensor,
    log_sigma: Tensor,
    action: Tensor,
    epsilon: Tensor,
    kind: str,
) -> dict[str, Tensor]:
    """The loss of RISE's stage 2, averaged over M posterior samples (Algorithm 1, lines 16 to 22).

    Args:
        policy: π_θ on (s, g, z).
        robot: (B, R).
        mu: (B, Z), without gradient.
        log_sigma: (B, Z), without gradient.
        action: (B, A).
        epsilon: standard normal draws, (M, B, Z).
        kind: the imitation loss.
    """
    z = reparameterise(mu, log_sigma, epsilon)
    output = policy(torch.cat((robot.expand(len(epsilon), *robot.shape), z), -1))
    return {"loss": imitation_loss(output, action, kind)}
