"""The episodes that the report shows step by step: which they are, their jobs, and what the page gets of them.

Of every task: the most critical scenarios and as many that chance has drawn, the same for all agents, so that any two
of them can be watched side by side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from benchmarks import plots, results, trajectories
from benchmarks.jobs import Job, actor_of, evaluated
from benchmarks.labels import agent_label, env_label, is_reference, noise_label
from benchmarks.policies import make_policy
from benchmarks.protocol import Plan, digest
from benchmarks.recorded import recreated, require_registered
from benchmarks.trajectories import Trajectory
from rise_agents.agent import Progress
from rise_envs.task import Task, describes_task, task_of

EACH = 6  # critical scenarios, and drawn ones: of each at most
_EPISODES = 240  # of a task at most, that the page stays small
_NEAR = 1e-3  # m: on another machine an episode may come out with other last digits
_WHOLE = np.iinfo(np.int16)


def trajectory_jobs(plan: Plan, out: Path) -> list[Job]:
    """One job for each row that was asked for and noise level that is shown, of the first training seed and model."""
    model, headline = plan.headline()
    levels = sorted({min(plan.noise_levels), headline, max(plan.noise_levels)})
    jobs = []
    for env in filter(describes_task, plan.envs):  # the page draws what a task describes
        rows = plan.asked(env)
        each = max(1, min(EACH, _EPISODES // (2 * max(1, len(rows) * len(levels)))))
        judged = [evaluated(plan, out, env, row, model, headline) for row in rows]
        for row in rows:
            source, arguments = actor_of(plan, env, row, 0, out)
            for level in levels:
                own = evaluated(plan, out, env, row, model, level)
                mark = digest(
                    env, row, *source, model, level, each, [[p.name for p in paths] for paths in judged]
                )
                output = out / "trajectories" / f"{env}-{row}-{level:g}-{mark}.rise"
                chosen = {"noise_model": model, "noise_level": level, "episodes": plan.episodes}
                chosen |= {"own": own, "judged": judged, "each": each}
                trained = [arguments["checkpoint"]] if arguments["checkpoint"] else []
                needs = tuple(dict.fromkeys([*trained, *own, *(path for paths in judged for path in paths)]))
                name = f"trace {row} on {env} at noise {level:g}"
                jobs.append(Job(name, record, arguments | chosen, output, needs, weight=0.5))
    return jobs


def choose(rows: Sequence[pa.Table], each: int) -> dict[int, str]:
    """Scenarios and why they are shown: "critical" or "drawn".

    Args:
        rows: the episodes of each agent under one condition; agents take turns to name the scenario with their least
            clearance, references only where there is nobody else.
        each: of both kinds.
    """
    agents = [table for table in rows if not is_reference(table["agent"][0].as_py())] or list(rows)
    ranked = [
        table["scenario"].to_numpy()[np.argsort(table["min_clearance"].to_numpy(), kind="stable")]
        for table in agents
    ]
    turns = (int(order[place]) for place in range(min(map(len, ranked))) for order in ranked)
    critical = list(dict.fromkeys(turns))[:each]
    # Scenarios are independent draws, so the first ones are as good as any others, and the clips show them too.
    drawn = [n for n in sorted(rows[0]["scenario"].to_pylist()) if n not in critical][:each]
    return {**dict.fromkeys(critical, "critical"), **dict.fromkeys(drawn, "drawn")}


def record(
    output: Path,
    progress: Progress,
    env: str,
    row: str,
    checkpoint: Path | None,
    settings: dict[str, Any],
    noise_model: str,
    noise_level: float,
    episodes: int,
    own: list[Path],
    judged: list[list[Path]],
    each: int,
) -> None:
    """Write the trajectories of one row under one condition; a job of a run.

    Args:
        output: the file.
        progress: told after every episode.
        env: environment.
        row: who acts.
        checkpoint: of a trained agent.
        settings: how it acts.
        noise_model: of the readings.
        noise_level: of the readings.
        episodes: scenarios of the run.
        own: files with the rows of this condition.
        judged: files with the rows by which scenarios are chosen, for each agent.
        each: how many of each kind.
    """
    chosen = choose([pa.concat_tables([results.read_rows(path) for path in paths]) for paths in judged], each)
    stored = {
        r["scenario"]: r for r in pa.concat_tables([results.read_rows(path) for path in own]).to_pylist()
    }
    policy = make_policy(env, row, checkpoint, settings, noise_level)
    found: dict[int, Trajectory] = {}
    differing = []
    for place, number in enumerate(chosen):
        try:
            found[number] = recreated(policy, stored[number], episodes, tolerance=_NEAR)
        except ValueError:  # recorded elsewhere, where it came out otherwise: not what the tables count
            differing.append(number)
        progress((place + 1) / len(chosen), {})
    made = gym.make(env)
    places = made.observation_space["obstacle"]  # type: ignore[index]
    dim = task_of(env).dim
    facts = {"low": places.low[:dim].tolist(), "high": places.high[:dim].tolist()}
    made.close()
    facts |= {"env": env, "row": row, "noise_model": noise_model, "noise_level": noise_level}
    facts |= {"why": [chosen[number] for number in found], "differing": differing}
    trajectories.save(output, found, facts)


@dataclass
class Packed:
    """What the page gets: a description in plain values, and the numbers as one string of bytes.

    Attributes:
        tasks: a description of each task and its episodes.
        numbers: of all episodes, one after the other; :func:`_encoded` says how.
    """

    tasks: list[dict[str, Any]] = field(default_factory=list)
    numbers: bytearray = field(default_factory=bytearray)


def pack(files: Sequence[Path], rows: Sequence[str] = ()) -> Packed:
    """The trajectories of ``files`` for the page.

    Args:
        files: of :func:`record`.
        rows: in which order agents stand.

    Raises:
        ValueError: a file is damaged, or nobody has registered its environment.
    """
    packed = Packed()
    loaded = [trajectories.load(path) for path in files]
    order = {row: place for place, row in enumerate(rows)}
    loaded.sort(key=lambda each: (order.get(each[1]["row"], len(order)), each[1]["noise_level"]))
    for env in dict.fromkeys(facts["env"] for _, facts in loaded):
        of_env = [each for each in loaded if each[1]["env"] == env and each[0]]
        if of_env:
            packed.tasks.append(_packed_task(env, of_env, packed.numbers))
    return packed


def _packed_task(
    env: str, loaded: Sequence[tuple[dict[int, Trajectory], dict[str, Any]]], numbers: bytearray
) -> dict[str, Any]:
    """The description of a task and its episodes, whose numbers are added to ``numbers``."""
    require_registered(env)
    task, first = task_of(env), loaded[0][1]
    agents = list(dict.fromkeys(facts["row"] for _, facts in loaded))
    why = {n: kind for found, facts in loaded for n, kind in zip(found, facts["why"], strict=True)}
    goals = {n: trajectory.goal[0] for found, _ in loaded for n, trajectory in found.items()}
    tables = [(facts, n, each, channels(task, each)) for found, facts in loaded for n, each in found.items()]
    names = list(tables[0][3])
    scales = {name: max(float(np.abs(parts[name]).max()) for *_, parts in tables) or 1.0 for name in names}
    scales = {name: scale / _WHOLE.max for name, scale in scales.items()}
    episodes = []
    for facts, number, trajectory, parts in tables:
        outcomes = trajectory.outcomes
        episodes.append(
            {
                "agent": agents.index(facts["row"]),
                "level": facts["noise_level"],
                "scenario": number,
                "steps": outcomes["steps"],
                "arrived": outcomes["arrived"],
                "cost": outcomes["episode_cost"],
                "least": round(outcomes["min_clearance"], 4),
                "closest": trajectory.closest,
                "at": len(numbers),
            }
        )
        for name in names:
            numbers += _encoded(parts[name], scales[name])
    return {
        "env": env,
        "label": env_label(env),
        "dim": task.dim,
        "dt": task.dt,
        "goalRadius": task.goal_radius,
        "robotRadius": task.robot_radius,
        "radii": []
        if task.body is None
        else np.round(task.body(loaded[0][0][next(iter(loaded[0][0]))].state[:1])[1], 4).tolist(),
        "obstacles": task.n_obstacles,
        "low": first["low"],
        "high": first["high"],
        "noise": noise_label(first["noise_model"]),
        "levels": sorted({facts["noise_level"] for _, facts in loaded}),
        "agents": [
            {"row": row, "label": agent_label(row), "colour": plots.colour(agents, row)} for row in agents
        ],
        "scenarios": {n: {"why": why[n], "goal": np.round(goals[n], 4).tolist()} for n in sorted(why)},
        "parts": [
            {"name": name, "width": tables[0][3][name].shape[1], "scale": scales[name]} for name in names
        ],
        "episodes": episodes,
        "differing": sum(len(facts["differing"]) for _, facts in loaded),
    }


def channels(task: Task, trajectory: Trajectory) -> dict[str, NDArray[np.float64]]:
    """What the page draws of an episode, each (T + 1, ·): numbers of the last row that are of no step are zero."""
    position, rotation = task.pose(trajectory.state)
    heading = np.unwrap(np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]))
    rows = len(position)

    def padded(values: NDArray) -> NDArray[np.float64]:
        full = np.zeros((rows, *values.shape[1:]))
        full[: len(values)] = values
        return full.reshape(rows, -1)

    parts = {"position": position, "heading": heading[:, None], "true": trajectory.true}
    parts |= {"reading": trajectory.reading, "clearance": trajectory.clearance[:, None]}
    parts |= {"action": padded(trajectory.action), "cost": padded(trajectory.cost)}
    if task.body is not None:
        parts["body"] = task.body(trajectory.state)[0].reshape(rows, -1)
    return {name: np.asarray(values, np.float64) for name, values in parts.items()}


def _encoded(values: NDArray[np.float64], scale: float) -> bytes:
    """Values (T, C) in multiples of ``scale``, as differences in time, channel by channel: little-endian int16.

    Differences wrap around; what is slow in time becomes small numbers, which compress well.
    """
    whole = np.round(values / scale).astype(np.int64).T
    return np.diff(whole, axis=1, prepend=0).astype("<i2").tobytes()


def decoded(content: bytes, rows: int, width: int, scale: float) -> NDArray[np.float64]:
    """The values (T, C) that :func:`_encoded` holds, to half a ``scale``."""
    steps = np.frombuffer(content, "<i2", rows * width).reshape(width, rows)
    return np.cumsum(steps, axis=1, dtype=np.int16).T.astype(np.float64) * scale
