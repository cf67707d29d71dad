"""Checkpoints that were damaged or forged: all are refused, and none runs anything."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.faults import hostile
from benchmarks.faults.hostile import Forger, Marks, Sample
from benchmarks.faults.measure import Effort, Fault, Findings, Tell
from benchmarks.faults.training import BENCHMARKED, train
from rise_agents import AGENTS, agent_class, load_agent
from rise_agents.checkpoint import CheckpointError

Samples = list[Sample]
NOT_FILES = ("folder", "zero", "fifo", "absent")
_PORTION = 250  # trials of a process at a time
_RARE = 1_000  # trials, of which one of each kind is no regular file

HOSTILE_ENVS: tuple[Any, ...] = (
    f"{hostile.EVIL}:Env-v0", f"{hostile.EVIL}:RISE-GroundVehicle-v0", "No-Such-Env-v0", "", None, 3, [],
    {"entry_point": f"{hostile.EVIL}:Env"}, "../../etc/passwd", "RISE-GroundVehicle-v0\n", "CartPole-v1",
    "rise_envs:RISE-GroundVehicle-v0", "RISE-GroundVehicle-v99", "\x00",
)  # fmt: skip
_NAN, _INF = float("nan"), float("inf")
# No setting takes one of these, whatever its kind.
_NEVER: tuple[Any, ...] = ({}, {"a": 1}, _NAN, _INF, -_INF, [[1]], [{}], [_NAN], [None], 1e400)
_WRONG: dict[type, tuple[Any, ...]] = {
    int: (*_NEVER, "1", "x", True, 1.5, [1], None, []),
    float: (*_NEVER, "1", "x", True, [1.0], None, []),
    str: (*_NEVER, 1, True, None, [], "no such thing", "\x00", f"{hostile.EVIL}:Env-v0"),
    tuple: (*_NEVER, 1, True, None, "64", [], [0], [-1], [1.5], ["64"], [True], [10**30]),
}


def wrong_values(default: Any) -> tuple[Any, ...]:
    """Values that a setting with this default must refuse."""
    return _WRONG.get(type(default), _NEVER)


def wrong_setting(rng: np.random.Generator, sample: Sample) -> bytes:
    """A setting that is unknown, of the wrong kind, or not that of the arrays."""
    description = sample.description
    config = description["config"]
    kind = int(rng.integers(4))
    if kind == 0:
        config[str(rng.choice(["no_such", "__class__", "hiden", ""]))] = 1
    elif kind == 1 and any(isinstance(value, list) for value in config.values()):
        name = str(rng.choice([key for key, value in config.items() if isinstance(value, list)]))
        config[name] = [*config[name], 7]
    elif kind == 2:
        wrong: list[Any] = [None, [], "x", 3, [["updates", 3]], {"": {}}]
        return hostile.redescribed(sample, config=wrong[int(rng.integers(len(wrong)))])
    else:
        settings = fields(agent_class(description["agent"]).Config)
        setting = settings[int(rng.integers(len(settings)))]
        values = wrong_values(setting.default)
        config[setting.name] = values[int(rng.integers(len(values)))]
    return hostile.redescribed(sample, config=config)


def wrong_env(rng: np.random.Generator, sample: Sample) -> bytes:
    """Another environment, or one whose name asks for an import."""
    env = HOSTILE_ENVS[int(rng.integers(len(HOSTILE_ENVS)))]
    if env == sample.description["env"]:
        env = None
    return hostile.redescribed(sample, env=env)


def wrong_agent(rng: np.random.Generator, sample: Sample) -> bytes:
    """Another agent's name, or nobody's."""
    names: list[Any] = [name for name in AGENTS if name != sample.description["agent"]]
    names += [f"{hostile.EVIL}:Agent", "", None, 7, [], {"rise": 1}, ["rise"], "RISE", "expert"]
    return hostile.redescribed(sample, agent=names[int(rng.integers(len(names)))])


def wrong_entry(rng: np.random.Generator, sample: Sample) -> bytes:
    """An entry of the description is missing or of the wrong kind."""
    description = sample.description
    name = str(rng.choice([key for key in description if key != "versions"]))
    if rng.random() < 0.3:
        del description[name]
        return hostile.archive(sample.arrays, {**sample.header, "description": description})
    wrong = [None, "x", [], [3], {"a": {"b": 1}}, _NAN, 10**40, -1.5, True]
    return hostile.redescribed(sample, **{name: wrong[int(rng.integers(len(wrong)))]})


FORGERS: dict[str, Forger] = {
    **hostile.common_forgers("config"),
    "signed, setting": hostile.signed_with(wrong_setting),
    "signed, environment": hostile.signed_with(wrong_env),
    "signed, agent": hostile.signed_with(wrong_agent),
    "signed, entry": hostile.signed_with(wrong_entry),
}


def differs(content: bytes, sample: Sample) -> bool:
    """Whether a forged file says something else than the good one."""
    if content == sample.content:
        return False
    try:
        found = hostile.take_apart(content)
    except Exception:  # it says nothing
        return True
    if content != hostile.archive(found.arrays, found.header):  # its digest is wrong
        return True
    same = found.arrays.keys() == sample.arrays.keys() and found.header == sample.header
    return not (same and all(_equal(found.arrays[key], array) for key, array in sample.arrays.items()))


def _equal(a: np.ndarray, b: np.ndarray) -> bool:
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


def forge(
    number: int, rng: np.random.Generator, samples: Samples, marks: Marks, forgers: dict[str, Forger]
) -> tuple[str, bytes]:
    """The ``number``-th forged file, and how it was made; never one that says the same as the good one."""
    kind = list(forgers)[number % len(forgers)]
    while True:
        sample, other = (samples[int(i)] for i in rng.choice(len(samples), 2, replace=False))
        content = forgers[kind](rng, sample, other, marks)
        if differs(content, sample):
            return kind, content


def portion(
    numbers: list[int], effort: Effort, samples: Samples, load: Callable[[Path], Any] = load_agent
) -> list[tuple[int, list[Fault]]]:
    """Some trials, one after the other, in this process."""
    found = []
    with effort.scratch(f"from-{numbers[0]}") as place, Marks(place) as marks:
        path = place / "forged.rise"
        for number in numbers:
            kind, content = forge(number, effort.rng(number), samples, marks, FORGERS)
            path.write_bytes(content)
            faults = [
                Fault(what, f"{kind}: {why}")
                for what, why in hostile.judge(partial(load, path), CheckpointError, marks)
            ]
            if faults:
                effort.keep(path, f"{number}.rise")
            found.append((number, faults))
    return found


# What is no regular file is opened in a process that may neither take long nor much memory.
_OPEN = """
import resource, sys
resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))
from rise_agents import load_agent
from rise_agents.checkpoint import CheckpointError
try:
    load_agent(sys.argv[1])
except CheckpointError:
    print("refused")
"""


def not_a_file(kind: str, effort: Effort) -> list[Fault]:
    """A path at which there is something else than a file."""
    with effort.scratch(kind) as place:
        path = Path("/dev/zero") if kind == "zero" else place / kind
        if kind == "folder":
            path.mkdir()
        elif kind == "fifo":
            os.mkfifo(path)
        command = [sys.executable, "-c", _OPEN, str(path)]
        try:
            done = subprocess.run(  # noqa: S603
                command, capture_output=True, text=True, timeout=3 * hostile.PATIENCE
            )
        except subprocess.TimeoutExpired:
            return [Fault("hang", f"{kind}: more than {3 * hostile.PATIENCE:g} s")]
        if done.stdout.strip() == "refused":
            return []
        tail = done.stderr.strip().splitlines()[-1:] or ["no error"]
        return [Fault("other exception", f"{kind}: {tail[0]}")]


def samples_of(place: Path) -> Samples:
    """A trained agent of every kind for every benchmarked environment."""
    found = []
    for env in BENCHMARKED:
        for name in AGENTS:
            path = place / f"{name}-{env}.rise"
            train(name, env).save(path)
            found.append(hostile.take_apart(path.read_bytes()))
    return found


def run(effort: Effort, tell: Tell) -> Findings:
    """Forged files of every kind in turn."""
    findings = Findings()
    numbers = list(effort.numbers(10_000, len(FORGERS)))
    with effort.scratch("samples") as place:
        samples = samples_of(place)
    size = min(_PORTION, -(-len(numbers) // effort.workers))
    tasks = [(numbers[i : i + size], effort, samples) for i in range(0, len(numbers), size)]
    for done, (_, found) in enumerate(effort.each(portion, tasks)):
        for number, faults in found:
            findings.add(number, faults)
        tell((done + 1) / (len(tasks) + 1), {"faults": len(findings.faults)})
    if effort.only is None:
        for kind in NOT_FILES * max(1, len(numbers) // _RARE):
            findings.add(0, not_a_file(kind, effort))
    return findings
