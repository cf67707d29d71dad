"""``mpc`` expert of the ground vehicle: nonlinear model-predictive control, solved at every step.

Over K steps, with the exact unicycle arc as its model and the discs o_k predicted at constant velocity::

    minimise   Σ |q_k − q̂_k|² + w·ω_k² + λ·(s_k + s_k²)
    subject to x_{k+1} = arc(x_k, v_k, ω_k),  actions inside their bounds,  s_k ≥ 0,
               |q_k − o_k| ≥ r + vehicle radius + margin − s_k   for every disc.

q̂ is the path of a vehicle that follows the field of :mod:`~rise_agents.experts.vehicle_guidance` without
regard to clearance. It is the warm start too, so the plan passes every disc on the side that the field
chooses, the same as the other expert. The slack s makes the problem feasible whatever the readings say; λ is
large enough that it stays zero wherever it can.

The program is built once per process in CasADi and solved by fatrop, an interior-point method that uses its
stage structure; where that fails by IPOPT; where that fails too the action is the ``cbf`` expert's.

Sources: Rawlings, Mayne & Diehl, "Model Predictive Control", 2nd ed. 2017; Vanroye, Sathya, De Schutter &
Decré, "FATROP: A fast constrained optimal control problem solver for robot trajectory optimization and
control", IROS 2023; Andersson et al., "CasADi", Mathematical Programming Computation 2019.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rise_agents.experts import vehicle_cbf
from rise_agents.experts.vehicle_guidance import Discs
from rise_agents.readings import checked_batch
from rise_envs.geometry import unicycle
from rise_envs.settings import check_fields
from rise_envs.task import Task

Array = NDArray[np.float64]

_STAGE = 6  # variables of a stage: x, y, θ, v, ω, s


@dataclass(frozen=True)
class Config:
    """Settings of the program, in SI units.

    Attributes:
        steps: K, length of the horizon.
        margin: clearance that the plan keeps (m).
        turn_weight: w, price of turning.
        slack_weight: λ, price of a clearance below the margin.
        tolerance: of the solver.
        max_iterations: of the solver; after that it counts as failed.
        cbf: the expert whose nominal action lays the reference and whose action is the last resort.
    """

    steps: int = 20
    margin: float = 0.3
    turn_weight: float = 0.01
    slack_weight: float = 100.0
    tolerance: float = 1e-4
    max_iterations: int = 60
    cbf: vehicle_cbf.Config = field(default_factory=vehicle_cbf.Config)

    def __post_init__(self) -> None:
        check_fields(type(self), vars(self))
        for name in ("steps", "slack_weight", "tolerance", "max_iterations"):
            if not getattr(self, name) > 0:
                raise ValueError(f"vehicle_mpc.Config.{name} must be positive, got {getattr(self, name)!r}")


class VehicleMPC:
    """The expert: memoryless, deterministic, reads the observation only.

    Args:
        task: description of the ground-vehicle task, with any number of discs.
        seed: ignored (nothing is random); there so that all experts are made alike.
        config: settings.
    """

    def __init__(self, task: Task, seed: int = 0, config: Config = Config()) -> None:
        self.task, self.config = task, config
        self.cbf = vehicle_cbf.VehicleCBF(task, seed, config.cbf)

    def predict(
        self,
        observation: Mapping[str, Array],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Array, None]:
        """Actions (v, ω), (2,) or (B, 2), and None: every step is planned afresh."""
        rows, single = checked_batch(self.task, observation)
        discs = self.cbf.read(rows)
        guess = self.rollout(rows["observation"], rows["desired_goal"], discs)
        action = self.cbf.filtered(rows["observation"], discs, guess[:, 0, 3:5])
        for row in range(len(action)):
            parameters = np.concatenate(
                (
                    rows["observation"][row],
                    guess[row, 1:, :2].ravel(),
                    discs.centre[row].ravel(),
                    discs.velocity[row].ravel(),
                    discs.keep_off[row],
                )
            )
            plan = self.solve(guess[row], parameters)
            if plan is not None:
                action[row] = np.clip(plan[3:5], self.cbf.low, self.cbf.high)
        return (action[0] if single else action), None

    def rollout(self, state: Array, goal: Array, discs: Discs) -> Array:
        """The field's path from states (B, 3): stages (B, K + 1, 6) of state, action and no slack."""
        task, stages = self.task, np.zeros((len(state), self.config.steps + 1, _STAGE))
        heading = state[:, 2]
        for k in range(self.config.steps + 1):
            action = self.cbf.nominal(state, goal, discs.after(k * task.dt))
            stages[:, k, :2], stages[:, k, 2], stages[:, k, 3:5] = state[:, :2], heading, action
            state = unicycle(state, action, task.dt)
            heading = heading + task.dt * action[:, 1]  # not wrapped: the program's heading is continuous
        return stages

    def solve(self, guess: Array, parameters: Array) -> Array | None:
        """The plan (6·K + 3,) by the first solver that succeeds, None if none does.

        Args:
            guess: stages to start from, (K + 1, 6).
            parameters: state, path q̂, centres, velocities and touching distances of the discs, flat.
        """
        task = self.task
        for solver in ("fatrop", "ipopt"):
            program = _program(
                solver, task.n_obstacles, task.dt, tuple(self.cbf.low), tuple(self.cbf.high), self.config
            )
            plan = program(guess.ravel()[: -(_STAGE - 3)], parameters)
            if plan is not None:
                return plan
        return None


class _Program:
    """One nonlinear program with its solver and bounds."""

    def __init__(self, solver: Any, bounds: dict[str, Array]) -> None:
        self.solver, self.bounds = solver, bounds

    def __call__(self, guess: Array, parameters: Array) -> Array | None:
        solution = self.solver(x0=guess, p=parameters, **self.bounds)["x"].full().ravel()
        return solution if self.solver.stats()["success"] and np.isfinite(solution).all() else None


@functools.cache
def _program(
    solver: str, n: int, dt: float, low: tuple[float, ...], high: tuple[float, ...], config: Config
) -> _Program:
    """The program for N discs; variables and constraints stage by stage, as fatrop wants them."""
    import casadi as ca  # here, so that the other experts do without

    steps = config.steps
    states = [ca.SX.sym(f"x{k}", 3) for k in range(steps + 1)]
    controls = [ca.SX.sym(f"u{k}", 3) for k in range(steps)]  # v, ω, s
    start, path = ca.SX.sym("start", 3), ca.SX.sym("path", 2, steps)
    centre, velocity, keep_off = ca.SX.sym("o", 2, n), ca.SX.sym("vo", 2, n), ca.SX.sym("r", n)

    cost: Any = 0
    constraints, equality = [], []
    for k in range(steps):
        x, u = states[k], controls[k]
        constraints.append(states[k + 1] - _arc(ca, x, u, dt))
        equality += [True] * 3
        if k == 0:
            constraints.append(x - start)
            equality += [True] * 3
        for i in range(n if k else 0):  # where the vehicle is now no plan can change
            offset = x[:2] - centre[:, i] - k * dt * velocity[:, i]
            # The tiny term keeps the gradient finite on top of a disc.
            constraints.append(ca.sqrt(ca.sumsqr(offset) + 1e-6) - keep_off[i] - config.margin + u[2])
            equality.append(False)
        cost += ca.sumsqr(states[k + 1][:2] - path[:, k]) + config.turn_weight * u[1] ** 2
        cost += config.slack_weight * (u[2] + u[2] ** 2)

    variables = [part for pair in zip(states, controls, strict=False) for part in pair] + [states[-1]]
    parameters = ca.vertcat(start, ca.vec(path), ca.vec(centre), ca.vec(velocity), keep_off)
    nlp = {"x": ca.vertcat(*variables), "p": parameters, "f": cost, "g": ca.vertcat(*constraints)}
    free, stage_low, stage_high = [np.inf] * 3, [*low, 0.0], [*high, np.inf]
    bounds = {
        "lbg": np.zeros(len(equality)),
        "ubg": np.where(equality, 0.0, np.inf),
        "lbx": np.array(([-b for b in free] + stage_low) * steps + [-b for b in free]),
        "ubx": np.array((free + stage_high) * steps + free),
    }
    return _Program(ca.nlpsol("nmpc", solver, nlp, _options(solver, equality, config)), bounds)


def _arc(ca: Any, x: Any, u: Any, dt: float) -> Any:
    """The state after one step: :func:`rise_envs.geometry.unicycle`, with sin(h)/h to fourth order."""
    half_turn = u[1] * dt / 2
    chord = u[0] * dt * (1 - half_turn**2 / 6 + half_turn**4 / 120)
    course = x[2] + half_turn
    return ca.vertcat(x[0] + chord * ca.cos(course), x[1] + chord * ca.sin(course), course + half_turn)


def _options(solver: str, equality: list[bool], config: Config) -> dict[str, Any]:
    common = {"expand": True, "print_time": False}
    limits = {"print_level": 0, "tol": config.tolerance, "max_iter": config.max_iterations}
    if solver == "fatrop":
        return {**common, "structure_detection": "auto", "equality": equality, "fatrop": limits}
    return {**common, "ipopt": {**limits, "sb": "yes", "max_iter": 5 * config.max_iterations}}
