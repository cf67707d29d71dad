"""A finished run as it lies in its folder: its episodes, who acted in them, and any of them re-created."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from benchmarks import results
from benchmarks.labels import TRUE, is_reference, split_row
from benchmarks.policies import make_policy
from benchmarks.protocol import portions
from benchmarks.report import EPISODES, RECORD, read_run
from benchmarks.trajectories import Trajectory, trace, trace_among
from rise_agents import AGENTS, agent_class, checkpoint, pretrained
from rise_agents.agent import acting_settings, nearest
from rise_agents.rollout import side_by_side
from rise_envs.task import env_class

Row = dict[str, Any]  # a row of episodes.parquet
_SHIPPED = " of rise_agents.pretrained, SHA-256 "  # between name and digest, as run.json names such weights


@dataclass(frozen=True)
class Run:
    """What a run folder holds.

    Attributes:
        folder: of the run, or of what is published of one.
        record: ``run.json``.
        rows: the episodes.
        episodes: scenarios per condition.
        noise_models: of the run, in their order.
    """

    folder: Path
    record: Mapping[str, Any]
    rows: pa.Table
    episodes: int
    noise_models: tuple[str, ...]

    @cached_property
    def rounded(self) -> bool:
        """Whether clearances and returns are rounded, as in what is published of a run."""
        return results.rounded(self.rows).equals(self.rows)

    def find(self, **key: Any) -> Row:
        """The one row with these values of the columns of :data:`benchmarks.results.KEY`.

        Raises:
            ValueError: there is none; says which value does not fit, and what there is.
        """
        rows = self.rows
        for column, value in key.items():
            kept = rows.filter(pc.equal(rows[column], pa.scalar(value, results.SCHEMA.field(column).type)))
            if not kept.num_rows:
                what = column.replace("_", " ").replace("train ", "training ")
                raise ValueError(
                    f"{self.folder} has no episode with {what} {value}: {_known(rows, column, value)}"
                )
            rows = kept
        return dict(rows.slice(0, 1).to_pylist()[0])

    def select(self, **values: Any) -> Iterator[Row]:
        """All rows with these values; None: any."""
        rows = self.rows
        for column, value in values.items():
            if value is not None:
                scalar = pa.scalar(value, results.SCHEMA.field(column).type)
                rows = rows.filter(pc.equal(rows[column], scalar))
        yield from rows.to_pylist()

    def policy(self, row: Row) -> Any:
        """Who acted in the episode of ``row``.

        Raises:
            ValueError: what it takes is not there any more, or is another one now.
        """
        env, name, seed = row["env"], row["agent"], row["train_seed"]
        require_registered(env)
        level = row["noise_level"]
        if is_reference(name):
            return make_policy(env, name, None, None, level)
        base, _ = split_row(name)
        try:
            entry = str(self.record["agents"][env][f"{name}-seed{seed}"])
            stored = dict(self.record["settings"][f"{base}@{env}"])
            variant = self.record["plan"].get("variants", {}).get(base)
            agent = str(variant["agent"] if variant else base)
        except (LookupError, TypeError, ValueError, AttributeError):
            raise ValueError(f"{self.folder / RECORD} does not say how {name} acted in {env}") from None
        if agent not in AGENTS:
            known = f"one of yours needs its --import; {nearest(agent, AGENTS)}"
            raise ValueError(f"{self.folder / RECORD} names an unknown agent {agent!r}: {known}")
        acting = acting_settings(agent_class(agent))
        settings = {key: value for key, value in stored.items() if key in acting}
        try:
            return make_policy(env, name, self._weights(entry), settings, level)
        except checkpoint.CheckpointError as error:
            raise ValueError(str(error)) from None

    def _weights(self, entry: str) -> Path:
        """The checkpoint that ``run.json`` names."""
        name, shipped, digest = entry.partition(_SHIPPED)
        path = pretrained.FOLDER / Path(name).name if shipped else self.folder / name
        if not path.is_file() and shipped:
            raise ValueError(f"{path} is missing: this package lacks the weights that the run evaluated")
        if not path.is_file():
            raise ValueError(
                f"{path} is missing: an episode of a trained agent can be re-created only in the run folder, where the "
                "agents are; of what is published, only episodes of experts and of chance can"
            )
        if shipped and pretrained.sha256(path) != digest:
            raise ValueError(
                f"{path} holds other weights than those that the run evaluated (SHA-256 {digest})"
            )
        return path

    def recreate(self, row: Row) -> Trajectory:
        """The episode of ``row`` again, equal to it in every outcome.

        Raises:
            ValueError: it comes out differently, or lacks what it takes.
        """
        policy = self.policy(row)
        return recreated(policy, row, self.episodes, self.rounded, self._versions())

    def _versions(self) -> str:
        """How the versions of libraries differ from those of the run, in words."""
        then, now = dict(self.record.get("versions", {})), checkpoint.versions()
        changed = [f"{name} {old}, now {now.get(name)}" for name, old in then.items() if now.get(name) != old]
        return (
            f"the run had {'; '.join(changed)}"
            if changed
            else "versions are the same; another kind of processor?"
        )


def recreated(
    policy: Any,
    row: Row,
    episodes: int,
    rounded: bool = False,
    versions: str = "",
    tolerance: float = 0.0,
) -> Trajectory:
    """The episode of ``row`` with ``policy``, as :meth:`Run.recreate`.

    Args:
        policy: who acted.
        row: of results.
        episodes: scenarios of the run, which were evaluated in portions.
        rounded: whether the row holds rounded numbers.
        versions: what may explain a difference.
        tolerance: differences of clearance (m) and return that do not matter.

    Raises:
        ValueError: it comes out differently.
    """
    env, seed, model = row["env"], int(row["env_seed"]), row["noise_model"]
    level = 0.0 if split_row(row["agent"])[1] == TRUE else row["noise_level"]
    (portion,) = (each for each in portions(env, episodes) if 0 <= row["scenario"] - each.start < each.count)
    rows = side_by_side(env, portion.count)
    found = trace(policy, env, seed, model, level, rows)
    if differences(
        found, row, rounded, tolerance
    ):  # last digits of a network may depend on the place among these rows, too
        found = trace_among(policy, env, portion.seeds(), row["scenario"] - portion.start, model, level)
    different = differences(found, row, rounded, tolerance)
    if different:
        raise ValueError(f"{describe(row)} comes out differently: {'; '.join(different)} ({versions})")
    return found


def differences(trajectory: Trajectory, row: Row, rounded: bool = False, tolerance: float = 0.0) -> list[str]:
    """In which outcomes an episode is not that of a row, in words; arguments as for :func:`recreated`.

    Rounded rows are met to their last digit.
    """
    found = []
    for name, value in trajectory.outcomes.items():
        if rounded and isinstance(value, float):
            value = results.rounded_values(name, np.array([value]))[0]
        if not math.isclose(value, row[name], rel_tol=0.0, abs_tol=tolerance):
            found.append(f"{name} {value}, stored {row[name]}")
    return found


def require_registered(env: str) -> None:
    """Raise ``ValueError`` if no such environment is registered here."""
    try:
        env_class(env)
    except gym.error.Error:
        raise ValueError(
            f"no environment {env!r} is registered: --import the module that registers it"
        ) from None


def describe(row: Row) -> str:
    """An episode in words."""
    return (
        f"scenario {row['scenario']} of {row['agent']} on {row['env']} at {row['noise_model']} "
        f"{row['noise_level']:g}, training seed {row['train_seed']}"
    )


def open_run(folder: Path) -> Run:
    """The run in a folder.

    Raises:
        ValueError: there is none, or it is damaged.
    """
    if not folder.is_dir():
        raise ValueError(f"{str(folder)!r} is not a folder")
    if not read_run(folder):
        raise ValueError(f"{folder / RECORD} is missing: {str(folder)!r} is not the folder of a run")
    record = json.loads((folder / RECORD).read_bytes())
    try:
        episodes, models = int(record["plan"]["episodes"]), tuple(map(str, record["plan"]["noise_models"]))
    except (LookupError, TypeError, ValueError) as error:
        raise ValueError(f"{folder / RECORD} is not the record of a run ({error})") from None
    return Run(folder, record, results.read_rows(folder / EPISODES), episodes, models)


def _known(rows: pa.Table, column: str, value: Any) -> str:
    """What there is in a column, the nearest if these are names."""
    there = pc.unique(rows[column]).to_pylist()
    if isinstance(value, str):
        return nearest(value, there)
    if len(there) > 8:
        return f"there are {min(there)} to {max(there)}"
    return f"there are {', '.join(f'{each:g}' for each in sorted(there))}"
