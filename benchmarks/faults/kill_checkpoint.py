"""``kill -9`` while a checkpoint is overwritten."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.faults import processes
from benchmarks.faults.measure import Effort, Fault, Findings, Tell
from rise_agents import checkpoint, files

ENV = "RISE-GroundVehicle-v0"
_MEGABYTE = 1 << 17  # float64
_LONGEST = 0.15  # s from the first write to the kill, a dozen writes

# What is killed: `python -c`, which writes again and again.
SAVER = "from benchmarks.faults.kill_checkpoint import overwrite; overwrite()"


def content(number: int) -> tuple[dict[str, np.ndarray], dict]:
    """What the ``number``-th write stores: the number, everywhere."""
    return {"weights": np.full(_MEGABYTE, float(number))}, {"agent": "none", "env": ENV, "number": number}


def overwrite(save: Callable = checkpoint.save) -> None:
    """Write the checkpoint that the last argument names for ever, and say when it was there first."""
    number = 0
    while True:
        save(Path(sys.argv[-1]), *content(number))
        if number == 0:
            print("there", flush=True)
        number += 1


def strays(folder: Path, *known: str) -> list[Fault]:
    """Files that should not be there."""
    return [Fault("stray file", path.name) for path in sorted(folder.iterdir()) if path.name not in known]


def check(path: Path) -> list[Fault]:
    """What is wrong with a checkpoint whose writer was killed."""
    faults = []
    try:
        arrays, description = checkpoint.load(path)
        if not (arrays["weights"] == description["number"]).all():
            faults.append(Fault("torn", "numbers of two writes in one file"))
    except checkpoint.CheckpointError as error:
        faults.append(Fault("unreadable", str(error)))
    files.sweep(path.parent)
    return faults + strays(path.parent, path.name)


def trial(number: int, effort: Effort, saver: str = SAVER) -> list[Fault]:
    """Start a writer, kill it, look at what is left, and write again."""
    rng = effort.rng(number)
    with effort.scratch(number) as place:
        path = place / "agent.rise"
        process = processes.start(["-c", saver, str(path)])
        process.stdout.read(1)  # type: ignore[union-attr]
        time.sleep(float(rng.uniform(0, _LONGEST)))
        processes.kill(process.pid)
        process.communicate()
        faults = check(path)
        checkpoint.save(path, *content(-1))  # whoever comes next is not disturbed
        faults += strays(place, path.name)
        if faults:
            effort.keep(place, str(number))
        return faults


def run(effort: Effort, tell: Tell) -> Findings:
    """Kills at random moments."""
    findings = Findings()
    tasks = [(number, effort) for number in effort.numbers(200)]
    for (number, _), faults in effort.each(trial, tasks):
        findings.add(number, faults)
        tell(findings.trials / len(tasks), {"faults": len(findings.faults)})
    return findings
