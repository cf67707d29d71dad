"""A last check on an action, by what the robot's known kinematics say of the next step.

How near the expert lets an obstacle come is read off the demonstrations: in each of ``BINS`` ranges of clearance (of
equal numbers of steps) the quantile ``QUANTILE`` of the clearance one step later, predicted under the expert's own
actions. An action that would fall below it is replaced by the nearest one that does not, among a grid of actions;
where there is none, by the one that keeps farthest. Clearance is that of the robot's reference ball, and an
obstacle keeps its velocity within a step.

Shapes: B batch, N obstacles, K candidate actions, A actions.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rise_envs.task import Task

if TYPE_CHECKING:
    from rise_agents.cloning import ActionUnits
    from rise_agents.demonstrations import Demonstrations

Array = NDArray[np.float64]

BINS, QUANTILE = 40, 0.03
_GRID = {1: 41, 2: 17, 3: 9}  # candidates along each of A actions


class Shield:
    """The check, fitted to demonstrations.

    Args:
        task: with ``moved``, the kinematics of the robot's reference point.
        units: of the actions.
        arrays: what :meth:`fit` gave.
    """

    def __init__(self, task: Task, units: ActionUnits, arrays: dict[str, NDArray]) -> None:
        self.task, self.units = task, units
        self.clearance, self.floor = arrays["shield.clearance"], arrays["shield.floor"]
        axes = [np.linspace(-1.0, 1.0, _GRID.get(units.size, 5))] * units.size
        self._grid = np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], -1)
        self._actions = units.to_action(self._grid).astype(np.float64)

    @classmethod
    def shapes(cls) -> dict[str, tuple[int, ...]]:
        """Of what it stores."""
        return {"shield.clearance": (BINS,), "shield.floor": (BINS,)}

    @classmethod
    def fit(cls, task: Task, units: ActionUnits, demonstrations: Demonstrations) -> dict[str, NDArray]:
        """How near the experts let obstacles come, as arrays to store."""
        d = demonstrations.subsample(200_000)
        step = -(-len(demonstrations.actions) // len(d["obstacle"]))
        actions = demonstrations.actions[::step]
        now = _clearance(task, task.pose(d["observation"])[0][:, None], d["obstacle"], 0.0)[:, 0]
        then = _clearance(
            task, task.moved(d["observation"], actions[:, None], task.dt), d["obstacle"], task.dt
        )[:, 0]
        order = np.array_split(np.argsort(now, kind="stable"), BINS)
        middle = [np.median(now[part]) if len(part) else now.max() for part in order]
        floor = [np.quantile(then[part], QUANTILE) if len(part) else then.min() for part in order]
        return {"shield.clearance": np.asarray(middle), "shield.floor": np.asarray(floor)}

    def __call__(self, rows: dict[str, Array], action: NDArray[np.float32]) -> NDArray[np.float32]:
        """Actions (B, A), replaced where the next step would come nearer than experts let it."""
        task, state, c = self.task, rows["observation"], rows["obstacle"]
        now = _clearance(task, task.pose(state)[0][:, None], c, 0.0)[:, 0]
        floor = np.interp(now, self.clearance, self.floor)
        then = _clearance(task, task.moved(state, action[:, None].astype(np.float64), task.dt), c, task.dt)[
            :, 0
        ]
        low = np.flatnonzero(then < floor)
        if not low.size:
            return action
        actions = np.broadcast_to(self._actions, (len(low), *self._actions.shape))
        ahead = _clearance(task, task.moved(state[low], actions, task.dt), c[low], task.dt)  # (B, K)
        away = ((self._grid - self.units.to_unit(action[low])[:, None]) ** 2).sum(-1)
        lacking = np.maximum(floor[low, None] - ahead, 0.0)
        # First by what is lacking, then by how far it is from the action that was wanted.
        best = np.lexsort((away, lacking), axis=-1)[:, 0]
        action = action.copy()
        action[low] = self._actions[best]
        return action


def _clearance(task: Task, positions: Array, reading: Array, ahead: float) -> Array:
    """Least clearance (m) of reference points (B, K, D) from obstacles that move on for ``ahead`` s: (B, K)."""
    centre, velocity, radius = task.split(reading)
    centre = centre + ahead * velocity
    distance = np.linalg.norm(positions[:, :, None] - centre[:, None], axis=-1)
    return (distance - radius[:, None]).min(-1) - task.robot_radius
