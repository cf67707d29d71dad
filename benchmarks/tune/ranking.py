"""Which settings are better: the one rule, the same for all agents.

The score is the mean of Safety and Reach Rate on noisy readings, among settings that lose next to nothing on true ones:
robustness must not be bought with what a policy does when it sees well.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

CLEAN, NOISY = 0.0, 1.0  # the noise levels that settings are judged at
MODEL = "step"
KEPT = 4  # one in so many settings goes on to the second round
SURE = 1.645  # standard errors: a loss is shown with one-sided confidence 95 %
_DIGITS = 9  # of losses that matter: rates are quotients, and 0.99 - 0.98 is not 0.01


class Rates(NamedTuple):
    """Safety and Reach Rate on true readings and at noise level 1, all in [0, 1]."""

    clean_safety: float
    clean_reach: float
    safety: float
    reach: float

    @property
    def clean(self) -> float:
        """Mean of both rates on true readings."""
        return (self.clean_safety + self.clean_reach) / 2

    @property
    def score(self) -> float:
        """Mean of both rates at noise level 1."""
        return (self.safety + self.reach) / 2


def mean(rates: Sequence[Rates]) -> Rates:
    """The mean of each rate over training seeds."""
    return Rates(*(math.fsum(column) / len(rates) for column in zip(*rates, strict=True)))


def best_clean(rates: Iterable[Rates]) -> Rates:
    """Those that are best on true readings, by the mean of both rates there; of equal ones the higher score.

    Raises:
        ValueError: none are given.
    """
    return max(rates, key=lambda rate: (rate.clean, rate.score))


def shown_loss(rate: float, best: float, episodes: int) -> float:
    """How far a rate lies below the best one for sure: the lower one-sided 95 % limit of the difference (Wald).

    A rate near 99 % of 1,000 episodes is known to half a point, and the best of many is one that was lucky: judged by
    the bare difference, settings that lose less than a point are thrown out.

    Args:
        rate: in [0, 1].
        best: another one, in [0, 1].
        episodes: that each of the two was measured in.
    """
    return best - rate - SURE * math.sqrt((rate * (1 - rate) + best * (1 - best)) / episodes)


def ranked(rates: Mapping[int, Rates], clean_loss: float, best: Rates, episodes: int) -> list[int]:
    """Trials, best first.

    Those come first of which no rate on true readings is shown to lie more than ``clean_loss`` below that of ``best``;
    among them the higher score is better. The others follow, who lose less before who lose more (the feasibility rule
    of Deb, "An efficient constraint handling method for genetic algorithms", 2000). Of equal trials the one with the
    lower number is better: trial 0 has the agent's defaults.

    Args:
        rates: of each trial of one round, by its number.
        clean_loss: in [0, 1].
        best: the best on true readings of all agents that are searched for an environment: what one agent can do when
            it sees well no other one may give up for robustness.
        episodes: that each rate was measured in: scenarios times training seeds.
    """

    def excess(rate: Rates) -> float:
        """How much more is lost than may be."""
        pairs = (rate.clean_safety, best.clean_safety), (rate.clean_reach, best.clean_reach)
        loss = max(shown_loss(own, other, episodes) for own, other in pairs)
        return round(max(loss - clean_loss, 0.0), _DIGITS)

    return sorted(rates, key=lambda n: (excess(rates[n]), -rates[n].score, n))


def finalists(
    rates: Mapping[int, Rates], clean_loss: float, best: Rates, episodes: int, trials: int
) -> list[int]:
    """The best quarter of ``trials``, rounded up; fewer only if fewer were measured."""
    return ranked(rates, clean_loss, best, episodes)[: -(-trials // KEPT)]
