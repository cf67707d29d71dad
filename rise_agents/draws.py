"""What an agent draws at the steps of its episodes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rise_envs import streams

_AHEAD = 64  # steps whose draws are computed together where one episode acts alone


class NormalDraws:
    """``size`` standard normal numbers a step: a pure function of the episode's key and the number of the step.

    Args:
        size: how many.
        precision: in which they are handed out.
    """

    def __init__(self, size: int, precision: type = np.float32) -> None:
        self.size, self.precision = size, precision
        self._ahead: tuple[tuple[int, int], NDArray] = (0, -1), np.zeros(0)

    def __call__(self, keys: NDArray[np.uint64], counter: NDArray[np.uint64]) -> NDArray:
        """The draws of steps ``counter`` (B,) of the streams ``keys`` (B,): (B, size)."""
        if len(keys) != 1 or not counter[0]:
            return self._draw(keys, counter)
        # An episode on its own: its next steps' draws together cost little more than one step's.
        block, place = divmod(int(counter[0]), _AHEAD)
        mark = int(keys[0]), block
        ahead = self._ahead  # another thread may change it meanwhile
        if ahead[0] != mark:
            ahead = mark, self._draw(keys, block * _AHEAD + np.arange(_AHEAD, dtype=np.uint64))
            self._ahead = ahead
        return ahead[1][place : place + 1]

    def _draw(self, keys: NDArray[np.uint64], steps: NDArray[np.uint64]) -> NDArray:
        """Numbers step · size and following, (T, size), of the streams; keys are (T,), or (1,) for all steps."""
        numbers = steps[:, None] * np.uint64(self.size) + np.arange(self.size, dtype=np.uint64)
        return streams.normal(keys[:, None], numbers).astype(self.precision)
