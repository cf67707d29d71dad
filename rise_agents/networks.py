"""The three networks of the paper: multilayer perceptron, Gaussian encoder, decoder.

Shapes: B batch, M samples, C reading inputs, Z latent.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from torch import Tensor, nn

# σ stays in [e⁻⁷, e³]: wide enough for any unit, finite in float32 whatever the reading.
LOG_SIGMA_RANGE = (-7.0, 3.0)


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
