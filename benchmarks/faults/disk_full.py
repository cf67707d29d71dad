"""Disks that are full: a write that fails part way leaves the old file, nothing else, and says so."""

from __future__ import annotations

import errno
import functools
import json
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.faults import kill_run
from benchmarks.faults.measure import Effort, Fault, Findings, Tell, Unavailable

ENV = "RISE-GroundVehicle-v0"
OFFSETS = 20
DISKS = ("limit", "tmpfs")
_SIZE = 16 << 20  # bytes of the disk that is filled up
_FULL = (errno.EFBIG, errno.ENOSPC)

# Writes a file (or a folder of files) at a path, in one of two versions.
Writer = Callable[[Path, int], None]


def write_checkpoint(path: Path, version: int) -> None:
    """A checkpoint of 200 kB."""
    from rise_agents import checkpoint

    weights = np.random.default_rng(version).random(25_000)
    checkpoint.save(path, {"weights": weights}, {"agent": "none", "env": ENV, "config": {}, "seed": version})


def write_part(path: Path, version: int) -> None:
    """The results of 4,000 episodes."""
    from benchmarks import results

    rng = np.random.default_rng(version)
    columns: dict[str, Any] = {"env": ENV, "agent": "none", "noise_model": "step", "noise_level": 1.0}
    columns |= {name: np.arange(4_000) for name in ("scenario", "env_seed", "noise_seed", "steps")}
    columns |= {name: rng.random(4_000) for name in ("episode_cost", "min_clearance", "episode_return")}
    columns |= {"train_seed": version, "safe": True, "arrived": True, "reached": True}
    results.write_rows(path, results.from_columns(columns))


def write_demonstrations(path: Path, version: int) -> None:
    """Four episodes of an expert."""
    _demonstrations(version).save(path)


@functools.cache
def _demonstrations(version: int) -> Any:
    from rise_agents.demonstrations import generate

    return generate(ENV, "cbf", 4, seed=version)


WRITERS: dict[str, Writer] = {
    "checkpoint": write_checkpoint,
    "part": write_part,
    "demonstrations": write_demonstrations,
}


def files(place: Path) -> dict[str, bytes]:
    """All files below a folder."""
    return {str(path.relative_to(place)): path.read_bytes() for path in place.rglob("*") if path.is_file()}


@contextmanager
def size_limit(place: Path, offset: int) -> Iterator[None]:
    """In this block no file can become larger than ``offset`` bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (offset, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@contextmanager
def no_space(place: Path, offset: int) -> Iterator[None]:
    """In this block the small disk that holds ``place`` has ``offset`` bytes left, to the page."""
    filler = place.parent / "filler"
    with filler.open("wb") as file:
        file.write(bytes(max(0, shutil.disk_usage(place).free - offset)))
    try:
        yield
    finally:
        filler.unlink()


LIMITS = {"limit": size_limit, "tmpfs": no_space}


def attempt(write: Writer, target: Path, offset: int, limit: Callable[[Path, int], Any]) -> list[Fault]:
    """One write that fails at ``offset``, over a first version that is there."""
    write(target, 0)
    before = files(target.parent)
    told: BaseException | None = None
    try:
        with limit(target.parent, offset):
            write(target, 1)
    except BaseException as error:
        told = error
    after, faults = files(target.parent), []
    for name in sorted(before.keys() | after.keys()):
        if name not in before:
            faults.append(Fault("stray file", f"{name} at {offset}"))
        elif after.get(name) != before[name]:
            faults.append(Fault("old file damaged", f"{name} at {offset}"))
    if told is None:
        faults.append(Fault("not told", f"the write at {offset} ended without an error"))
    elif not isinstance(told, OSError) or told.errno not in _FULL or "\n" in str(told):
        faults.append(Fault("unclear error", f"at {offset}: {type(told).__name__}: {told}"))
    elif target.name not in str(told):
        faults.append(Fault("error without path", f"at {offset}: {told}"))
    return faults


def attempts(kind: str, disk: str, shares: list[float], place: Path) -> list[list[Fault]]:
    """Writes of one kind that fail at the given shares of the largest file; what was wrong with each."""
    target, write = place / kind, WRITERS[kind]
    place.mkdir(parents=True, exist_ok=True)
    write(target, 1)
    largest = max(len(content) for content in files(place).values())
    # A disk has pages: the last one is kept out of it, or the write would succeed.
    largest -= 8_192 if disk == "tmpfs" else 1
    return [attempt(write, target, int(share * largest), LIMITS[disk]) for share in shares]


def space_needed(place: Path) -> int:
    """Bytes of all files below a folder."""
    return sum(len(content) for content in files(place).values())


def benchmark(share: float, made: kill_run.Reference, needed: int, place: Path) -> list[Fault]:
    """The benchmark on a disk with a share of the space that it needs, and once more with enough."""
    out = place / "out"
    out.mkdir(parents=True)
    with no_space(out, int(share * needed)):
        done = _benchmark(out)
    faults = []
    words = done.stderr + done.stdout
    if done.returncode != 1:
        faults.append(Fault("wrong exit code", f"{done.returncode} with {share:.2f} of the space"))
    if "Traceback" in words:
        faults.append(Fault("traceback", f"with {share:.2f} of the space"))
    told = [line for line in done.stderr.splitlines() if line.startswith("benchmarks.run: ")]
    jobs = [line.split(": ")[2] if ": failed: " in line else line for line in told]
    if not told or len(set(jobs)) != len(jobs):
        faults.append(Fault("failures not told in a line each", f"{told} with {share:.2f} of the space"))
    again = _benchmark(out)
    log = out / "log"
    log.write_text(again.stderr)
    return faults + kill_run.compare(out, again.returncode, made)


def _benchmark(out: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(  # noqa: S603
        [sys.executable, *kill_run.command(out)], capture_output=True, text=True, timeout=600
    )


def main(request: str) -> None:
    """In a process of its own: the request as JSON, the faults as JSON on standard output."""
    asked = json.loads(request)
    place = Path(asked["place"])
    if asked["disk"] == "tmpfs":
        mount = ["mount", "-t", "tmpfs", "-o", f"size={_SIZE}", "tmpfs", str(place)]
        subprocess.run(mount, check=True)  # noqa: S603
    if asked["kind"] == "benchmark":
        made = kill_run.Reference(0.0, {k: Path(v).read_bytes() for k, v in asked["results"].items()},
                                  frozenset(asked["files"]))  # fmt: skip
        found = [
            benchmark(share, made, asked["needed"], place / str(i)) for i, share in enumerate(asked["shares"])
        ]
    else:
        found = attempts(asked["kind"], asked["disk"], asked["shares"], place / "files")
    print(json.dumps(found))


def ask(request: dict[str, Any]) -> list[list[Fault]]:
    """:func:`main` in a process of its own; on a disk of its own, where one is asked for.

    Raises:
        Unavailable: this machine lets nobody mount one.
    """
    command = [
        sys.executable,
        "-c",
        "import sys; from benchmarks.faults.disk_full import main; main(sys.argv[1])",
    ]
    if request["disk"] == "tmpfs":
        if not may_mount():
            raise Unavailable("no user namespaces with a tmpfs here")
        command = [shutil.which("unshare") or "unshare", "-rm", *command]
    done = subprocess.run([*command, json.dumps(request)], capture_output=True, text=True)  # noqa: S603
    if done.returncode:
        raise RuntimeError(done.stderr.strip().splitlines()[-1] if done.stderr else f"exit {done.returncode}")
    return [[Fault(*fault) for fault in faults] for faults in json.loads(done.stdout.splitlines()[-1])]


def may_mount() -> bool:
    """Whether this machine lets us fill up a disk of our own."""
    unshare = shutil.which("unshare")
    if not unshare:
        return False
    with tempfile.TemporaryDirectory() as place:
        command = [unshare, "-rm", "mount", "-t", "tmpfs", "tmpfs", place]
        return subprocess.run(command, capture_output=True).returncode == 0  # noqa: S603


def run(effort: Effort, tell: Tell) -> Findings:
    """Every kind of file at every offset, with a limit and on a full disk, and the benchmark itself."""
    findings = Findings()
    disks = DISKS if may_mount() else DISKS[:1]
    if len(disks) < len(DISKS):
        findings.note = "no full disk: this machine lets nobody mount one"
    count = effort.count(OFFSETS, 2)
    shares = [float(share) for share in np.linspace(0, 1, count)]
    number = 0
    for disk in disks:
        for kind in WRITERS:
            with effort.scratch(f"{disk}-{kind}") as place:
                request = {"kind": kind, "disk": disk, "place": str(place), "shares": shares}
                chosen = [share for i, share in enumerate(shares) if effort.only in (None, number + i)]
                results = ask({**request, "shares": chosen}) if chosen else []
            first = number if effort.only is None else effort.only
            for place_in_row, faults in enumerate(results):
                findings.add(
                    first + place_in_row, [Fault(f.kind, f"{kind}, {disk}: {f.details}") for f in faults]
                )
            number += count
            tell(0.5 * number / (len(disks) * len(WRITERS) * count), {"faults": len(findings.faults)})
    if "tmpfs" in disks:
        _try_benchmark(effort, tell, findings, number)
    return findings


def _try_benchmark(effort: Effort, tell: Tell, findings: Findings, number: int) -> None:
    count = effort.count(6)
    shares = [float(share) for share in (np.arange(count) + 0.5) / count]
    chosen = [(number + i, share) for i, share in enumerate(shares) if effort.only in (None, number + i)]
    if not chosen:
        return
    with effort.scratch("reference") as kept:
        made = kill_run.reference(kept)
        for name, content in made.results.items():
            (kept / name).write_bytes(content)
        request: dict[str, Any] = {"kind": "benchmark", "disk": "tmpfs", "files": sorted(made.files)}
        request |= {"needed": space_needed(kept / "warm")}
        request |= {"results": {name: str(kept / name) for name in made.results}}
        for which, share in chosen:
            with effort.scratch(which) as place:
                faults = ask({**request, "place": str(place), "shares": [share]})[0]
            findings.add(which, [Fault(f.kind, f"benchmark: {f.details}") for f in faults])
            tell(0.5 + 0.5 * (which - number + 1) / count, {"faults": len(findings.faults)})
