"""``kill -9`` while the benchmark runs, and the same command once more, until it ends."""

from __future__ import annotations

import hashlib
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.faults import processes
from benchmarks.faults.measure import Effort, Fault, Findings, Tell

TARGETS = ("parent", "worker", "group")
RESULTS = ("episodes.parquet", "summary.csv", "comparisons.csv")
# What is added to the command, folder by folder: most run the vehicle, one in four an arm.
OPTIONS: tuple[tuple[str, ...], ...] = ((), (), (), ("--envs", "RISE-SafePandaKinematic-v0"))
_FINISHED = ("demonstrations/*/*.rise", "agents/*/*.rise", "parts/*/*.parquet")
_LONGEST = 20  # runs of a chain that were killed; then it may end
_PATIENCE = 600.0  # s for a run to end

Seen = dict[str, tuple[str, int]]  # path -> (SHA-256, modified)


@dataclass(frozen=True)
class Reference:
    """What a run that nobody disturbed made, and how long it took."""

    seconds: float
    results: dict[str, bytes]
    files: frozenset[str]


def command(out: Path, options: tuple[str, ...] = ()) -> list[str]:
    """The benchmark in miniature."""
    small = ["--preset", "smoke", "--no-videos", "--envs", "RISE-GroundVehicle-v0", "--workers", "2"]
    return ["-m", "benchmarks.run", "--agents", "rise", "pcbc", "cppo", *small, *options, "--out", str(out)]


def finished(out: Path) -> Seen:
    """The outputs of finished jobs."""
    return {
        str(path.relative_to(out)): (hashlib.sha256(path.read_bytes()).hexdigest(), path.stat().st_mtime_ns)
        for pattern in _FINISHED
        for path in out.glob(pattern)
        if not path.name.startswith(".")
    }


def listing(out: Path) -> frozenset[str]:
    """All files of a run folder but its lock."""
    return frozenset(
        str(p.relative_to(out)) for p in out.rglob("*") if p.is_file() and p.name not in (".lock", "log")
    )


def reference(place: Path, options: tuple[str, ...] = ()) -> Reference:
    """Run without disturbance; the second time, when all caches are warm, counts."""
    for name in ("cold", "warm"):
        out = place / name
        out.mkdir(parents=True)
        started = time.perf_counter()
        process = processes.start(command(out, options), place / "log")
        if process.wait(_PATIENCE):
            tail = (place / "log").read_text().strip().splitlines()[-1:]
            raise RuntimeError(f"the undisturbed run fails: {' '.join(tail)}")
        seconds = time.perf_counter() - started
    return Reference(seconds, {name: (out / name).read_bytes() for name in RESULTS}, listing(out))


def changed(before: Seen, after: Seen) -> list[Fault]:
    """Finished work that is gone or was done again."""
    return [
        Fault("finished job lost" if name not in after else "finished job done again", name)
        for name, content in before.items()
        if after.get(name) != content
    ]


def disturb(
    process: subprocess.Popen[bytes], target: str, delay: float, choice: float
) -> tuple[str, list[Fault]]:
    """Let a run go on for ``delay`` seconds, then kill.

    Args:
        process: the run, leader of its session.
        target: of :data:`TARGETS`.
        delay: s.
        choice: which worker, in [0, 1).

    Returns:
        What was killed ("" if the run had ended before), and what was wrong afterwards.
    """
    try:
        process.wait(delay)
        return "", []
    except subprocess.TimeoutExpired:
        pass
    workers = processes.children(process.pid)
    if target == "worker" and workers:
        processes.kill(workers[int(choice * len(workers))])
        return "worker", []
    if target == "group":
        processes.end(process.pid)
    processes.kill(process.pid)
    process.wait()
    left = processes.orphans(process.pid)
    processes.end(process.pid)
    faults = [
        Fault("orphan", f"{len(left)} processes {processes.PATIENCE:g} s after the {target} was killed")
    ]
    return "group" if target == "group" else "parent", faults if left else []


def compare(out: Path, code: int, made: Reference) -> list[Fault]:
    """What is wrong with a run that came to its end."""
    faults = []
    if code:
        tail = (out / "log").read_text(errors="replace").strip().splitlines()[-1:]
        faults.append(Fault("run failed", f"exit code {code}: {' '.join(tail)}"))
    for name, content in made.results.items():
        path = out / name
        if not path.exists() or path.read_bytes() != content:
            faults.append(Fault("different result", f"{name} is not that of an undisturbed run"))
    there = listing(out)
    faults += [Fault("stray file", name) for name in sorted(there - made.files)]
    faults += [Fault("missing file", name) for name in sorted(made.files - there)]
    return faults


def chain(
    rng: np.random.Generator, out: Path, made: Reference, most: int = _LONGEST, options: tuple[str, ...] = ()
) -> tuple[list[str], list[Fault]]:
    """Run and kill in one folder until a run ends.

    Returns:
        What was killed each time, and all faults.
    """
    killed: list[str] = []
    faults: list[Fault] = []
    before: Seen = {}
    while True:
        delay = float(rng.uniform(0, made.seconds)) if len(killed) < most else _PATIENCE
        target = TARGETS[int(rng.integers(len(TARGETS)))]
        process = processes.start(command(out, options), out / "log")
        what, wrong = disturb(process, target, delay, float(rng.uniform()))
        if what == "worker":  # the run itself lives on
            code = process.wait(_PATIENCE)
            wrong = [Fault("run failed", f"a worker was killed: exit code {code}")] if code else []
        after = finished(out)
        where = f"after {len(killed)} kills; {what or 'nothing'} killed after {delay:.2f} s: "
        faults += [Fault(kind, where + details) for kind, details in [*wrong, *changed(before, after)]]
        before = after
        if what:
            killed.append(what)
        if what in ("parent", "group"):
            continue
        if process.returncode == 0 or not what:
            return killed, faults + compare(out, process.returncode, made)


def run(effort: Effort, tell: Tell) -> Findings:
    """Chains of runs in one folder each, until there were enough kills."""
    findings, wanted, chains = Findings(), effort.count(100), 0
    made: dict[tuple[str, ...], Reference] = {}
    counted = dict.fromkeys(TARGETS, 0)
    while findings.trials < wanted:
        number = chains if effort.only is None else effort.only
        options = OPTIONS[number % len(OPTIONS)]
        if options not in made:
            with effort.scratch("reference") as place:
                made[options] = reference(place, options)
        most = min(_LONGEST, wanted - findings.trials)
        with effort.scratch(number) as out:
            killed, faults = chain(effort.rng(number), out, made[options], most, options)
            findings.add(number, faults, len(killed))
            if faults:
                effort.keep(out, str(number))
        chains += 1
        for what in killed:
            counted[what] += 1
        tell(min(1.0, findings.trials / wanted), {"kills": findings.trials, "faults": len(findings.faults)})
        if effort.only is not None:
            break
    words = ", ".join(f"{count} of the {what}" for what, count in counted.items())
    undisturbed = " or ".join(f"{each.seconds:.0f} s" for each in made.values())
    findings.note = f"{words}; {chains} folders, one in {len(OPTIONS)} of an arm, undisturbed {undisturbed}"
    return findings
