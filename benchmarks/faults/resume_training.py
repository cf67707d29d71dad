"""A training that is killed and goes on ends with the weights of one that was not."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from benchmarks.faults import processes
from benchmarks.faults.measure import Effort, Fault, Findings, Tell
from benchmarks.faults.training import source_of
from rise_agents import AGENTS, agent_class, checkpoint, make_agent
from rise_agents.resume import Resume

ENVS = ("RISE-GroundVehicle-v0", "RISE-SafePandaKinematic-v0")
KILLS = 3
TRIALS = 4  # of each agent and environment
_PATIENCE = 300.0  # s for a training
_LEARNER = "import sys; from benchmarks.faults.resume_training import learn; learn(*sys.argv[1:])"


def learn(name: str, env: str, output: str, state: str = "") -> None:
    """Train an agent; with ``state``, the file from which the training goes on, written as often as can be."""
    agent = make_agent(name, env, agent_class(name).BRIEF, seed=1)
    agent.learn(source_of(agent, env), resume=Resume(state or None, every=0.0))
    agent.save(output)


def command(name: str, env: str, output: Path, state: Path | None) -> list[str]:
    """:func:`learn` in a process of its own."""
    return ["-c", _LEARNER, name, env, str(output), *([str(state)] if state else [])]


def undisturbed(name: str, env: str, place: Path) -> tuple[Path, float]:
    """A training that writes no state, and how long one that does goes on writing it."""
    output = place / f"{name}-{env}.rise"
    subprocess.run([sys.executable, *command(name, env, output, None)], check=True, timeout=_PATIENCE)  # noqa: S603
    state = place / f"{name}-{env}.training"
    process = processes.start(command(name, env, place / "timed.rise", state), place / "log")
    wait_for(state, process)
    started = time.monotonic()
    process.wait(_PATIENCE)
    return output, time.monotonic() - started


def wait_for(path: Path, process: subprocess.Popen[bytes]) -> None:
    """Wait until a file is there, or the process has ended."""
    until = time.monotonic() + _PATIENCE
    while not path.exists() and process.poll() is None and time.monotonic() < until:
        time.sleep(0.005)


def killed_and_resumed(
    start: list[str], state: Path, log: Path, rng: np.random.Generator, seconds: float, kills: int = KILLS
) -> tuple[int, int]:
    """Run a training to its end, killed up to ``kills`` times at random moments once its state is stored.

    Returns:
        How often it was killed, and the exit code in the end.
    """
    done = 0
    while True:
        process = processes.start(start, log)
        if done < kills:
            wait_for(state, process)
            try:
                process.wait(float(rng.uniform(0, 1.5 * seconds / kills)))
            except subprocess.TimeoutExpired:
                processes.end(process.pid)
                process.wait()
                done += 1
                continue
        return done, process.wait(_PATIENCE)


def compare(first: Path, second: Path) -> list[Fault]:
    """Where two trained agents differ."""
    (a, _), (b, _) = checkpoint.load(first), checkpoint.load(second)
    if a.keys() != b.keys():
        return [Fault("other weights", f"{sorted(a.keys() ^ b.keys())} in one of them only")]
    wrong = [name for name in a if a[name].tobytes() != b[name].tobytes()]
    return (
        [Fault("other weights", f"{len(wrong)} of {len(a)} arrays: {', '.join(wrong[:3])}")] if wrong else []
    )


def trial(
    number: int, name: str, env: str, made: tuple[Path, float], effort: Effort
) -> tuple[int, list[Fault]]:
    """One training that is killed; how often, and what is wrong with it."""
    expected, seconds = made
    with effort.scratch(number) as place:
        output, state = place / "agent.rise", place / "agent.training"
        start = command(name, env, output, state)
        killed, code = killed_and_resumed(start, state, place / "log", effort.rng(number), seconds)
        if code:
            tail = (place / "log").read_text(errors="replace").strip().splitlines()[-1:]
            faults = [Fault("training failed", " ".join(tail))]
        else:
            faults = compare(expected, output)
        faults = [Fault(kind, f"{name} on {env}, {killed} kills: {why}") for kind, why in faults]
        if faults:
            effort.keep(place, str(number))
    return killed, faults


def run(effort: Effort, tell: Tell) -> Findings:
    """Every agent, in both kinds of environments."""
    findings, kills = Findings(), 0
    pairs = [(name, env) for env in ENVS for name in AGENTS]
    numbers = effort.numbers(TRIALS * len(pairs), len(pairs))
    with effort.scratch("undisturbed") as place:
        needed = sorted({number % len(pairs) for number in numbers})
        tasks = [(*pairs[i], place) for i in needed]
        made = dict(zip(needed, (each for _, each in effort.each(undisturbed, tasks)), strict=True))
        tell(0.2, {})
        trials = [(n, *pairs[n % len(pairs)], made[n % len(pairs)], effort) for n in numbers]
        for done, ((number, *_), (killed, faults)) in enumerate(effort.each(trial, trials)):
            findings.add(number, faults)
            kills += killed
            tell(0.2 + 0.8 * (done + 1) / len(trials), {"kills": kills, "faults": len(findings.faults)})
    findings.note = f"{kills} kills"
    return findings
