"""Command lines and settings that make no sense: one line that says so, exit code 2, at once."""

from __future__ import annotations

import contextlib
import io
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.faults import hostile
from benchmarks.faults.checkpoints import wrong_values
from benchmarks.faults.measure import Effort, Fault, Findings, Tell
from benchmarks.faults.programs import PROGRAMS, Program, name_of, words
from benchmarks.faults.training import BENCHMARKED
from benchmarks.presets import VEHICLE
from rise_agents import AGENTS, agent_class, make_agent

LIMIT = 1.0  # s
_CONFIGS = (3, 6, 9)  # last digits of the trials that are settings
_REAL = 100  # one command line in so many is given to a process of its own
_PATIENCE = 30.0  # s
JSON = ("{}", '{"a": 1}', "NaN", "Infinity", "-Infinity", "1e400", "[[1]]", "[{}]", "[NaN]", "[null]",
        "[" * 3_000, "9" * 5_000, '"' + "x" * 10_000 + '"', '{"a":' * 3_000)  # fmt: skip

Line = list[str]


class Places(NamedTuple):
    """Folders of trials: one to write to, and one of a run."""

    place: Path
    run: Path


class Wrong(NamedTuple):
    """What is wrong in a command line, and the names of what else is not to be in it; None: of all but some."""

    line: Line
    instead: tuple[str, ...] | None = ()


def pick(rng: np.random.Generator, things: Sequence[Any]) -> Any:
    """One of some things, whatever they are."""
    return things[int(rng.integers(len(things)))]


def bad_path(rng: np.random.Generator, place: Path) -> str:
    """A path at which nothing can be written or read."""
    file = place / "file"
    file.touch()
    return pick(
        rng,
        (
            f"{file}/x",
            f"{file}/é\n/x",
            "/proc/no/such",
            f"{place}/{'x' * 300}",
            f"{place}/\x00",
            "/dev/null/x",
        ),
    )


def unknown_option(rng: np.random.Generator, program: Program, places: Places) -> Wrong:
    """The name of an option with a slip in it."""
    known = [option for action in program.options() for option in action.option_strings]
    while True:
        name = list(pick(rng, known))
        at = int(rng.integers(2, len(name)))
        slip = pick(rng, ("drop", "double", "swap", "other"))
        if slip == "drop":
            del name[at]
        elif slip == "double":
            name.insert(at, name[at])
        elif slip == "swap":
            name[at - 1], name[at] = name[at], name[at - 1]
        else:
            name[at] = pick(rng, "xq_é7\n")
        text = "".join(name)
        if text not in (*known, "--", "--help", "--hel", "--h", "--he") and text.startswith("--"):
            return Wrong([text, *pick(rng, ([], ["1"], ["x", "y"]))])


def missing_value(rng: np.random.Generator, program: Program, places: Places) -> Wrong:
    """An option at the end, without what it takes."""
    name = name_of(pick(rng, [a for a in program.options() if a.nargs != 0 and a.option_strings]))
    return Wrong([name], (name,))


def bad_value(rng: np.random.Generator, program: Program, places: Places) -> Wrong:
    """An option with a value that it cannot have."""
    option = pick(rng, [a for a in program.options() if a.type is Path or program.refused(a)])
    text = bad_path(rng, places.place) if option.type is Path else pick(rng, program.refused(option))
    name = name_of(option)
    return Wrong([name, text] if option.option_strings else [text], (name,))


def too_many(rng: np.random.Generator, program: Program, places: Places) -> Wrong:
    """Words that belong to no option, or a value for a switch."""
    switches = [name_of(a) for a in program.options() if a.nargs == 0]
    word = pick(rng, ("run", "é", "x" * 10_000, "RISE-GroundVehicle-v0", "0", "a\nb", "\U0001f916"))
    return Wrong(pick(rng, ([word], [pick(rng, switches), word] if switches else [word], ["--", word])))


def bad_setting(rng: np.random.Generator, program: Program, places: Places) -> Wrong:
    """``--set`` with an unknown agent or field, hostile JSON, or another form."""
    agent = pick(rng, list(AGENTS))
    settings = fields(agent_class(agent).Config)
    field = pick(rng, settings)
    kind = int(rng.integers(4))
    if kind == 0:
        forms = (
            "",
            "=",
            ".",
            "x",
            "rise",
            "rise.",
            "rise=1",
            ".beta=1",
            "rise.beta",
            "=1",
            "rise.=1",
            "é.é",
            "\x00",
        )
        text = pick(rng, forms)
    elif kind == 1:
        name = pick(rng, ("ris", "", "expert", f"{agent}@", f"{agent}@nowhere", "random", "é", "a\nb", "@"))
        text = f"{name if name != f'{agent}@' else agent + '@x'}.{field.name}=1"
    elif kind == 2:
        text = f"{agent}.{field.name}x={pick(rng, ('1', 'x', *JSON))}"
    else:
        wrong = [json.dumps(value) for value in wrong_values(field.default) if not isinstance(value, str)]
        text = f"{agent}.{field.name}={pick(rng, [*wrong, *JSON])}"
        if isinstance(field.default, str):
            text = f"{agent}.{field.name}={pick(rng, wrong)}"
    return Wrong(["--agents", agent, "--set", text], ("--agents", "--set"))


def conflict(rng: np.random.Generator, program: Program, places: Places) -> Wrong:
    """Options that each make sense, but not together or not here."""
    line = pick(rng, program.conflicts).format(**places._asdict()).split("|")
    return Wrong(line, None)


KINDS: tuple[Callable[[np.random.Generator, Program, Places], Wrong], ...] = (
    unknown_option, missing_value, bad_value, bad_value, too_many, conflict,
)  # fmt: skip


def command_line(rng: np.random.Generator, places: Places) -> tuple[Program, Line]:
    """A program and arguments of which at least one is wrong, among others that are right."""
    program = pick(rng, PROGRAMS)
    settings = (bad_setting,) if program.module in ("benchmarks.run", "benchmarks.tune") else ()
    wrong = pick(rng, (*KINDS, *settings, *settings))(rng, program, places)
    # A valid one must not come after a wrong one of the same name and take its place.
    names = [
        name for name in program.valid
        if (name in program.beside if wrong.instead is None else name not in wrong.instead)
    ]  # fmt: skip
    valid = [word for name in names for word in words(name, program.valid[name], *places)]
    return program, [*valid, *wrong.line]


def complaint(code: Any, output: str, errors: str, seconds: float | None) -> list[tuple[str, str]]:
    """What is wrong with how a program answered."""
    faults = []
    lines = errors.splitlines()
    if "Traceback" in errors:
        faults.append(("traceback", lines[-1][:200]))
    if code != 2:
        faults.append(("wrong exit code", f"{code} {errors[-200:]!r}"))
    if len(lines) != 1 and "Traceback" not in errors:
        faults.append(("not one line", repr(errors[:300])))
    if output:
        faults.append(("output", repr(output[:100])))
    if seconds is not None and seconds > LIMIT:
        faults.append(("slow", f"{seconds:.2f} s"))
    return faults


def in_process(program: Program, argv: Line) -> list[tuple[str, str]]:
    """Give the arguments to ``main`` in this process."""
    output, errors = io.StringIO(), io.StringIO()
    started = time.perf_counter()
    try:
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
            with hostile.time_limit(hostile.PATIENCE):
                code = program.main(argv)
    except hostile.Hang:
        return [("started", f"more than {hostile.PATIENCE:g} s")]
    except BaseException as error:
        return [("traceback", f"{type(error).__name__}: {str(error)[:200]}")]
    return complaint(code, output.getvalue(), errors.getvalue(), time.perf_counter() - started)


def real_process(program: Program, argv: Line) -> tuple[list[tuple[str, str]], float]:
    """Give the arguments to a process; also says how long it took."""
    if any("\x00" in word for word in argv):  # no process can be given one
        return [], 0.0
    started = time.perf_counter()
    try:
        done = subprocess.run(  # noqa: S603
            [sys.executable, "-m", program.module, *argv], capture_output=True, timeout=_PATIENCE
        )
    except subprocess.TimeoutExpired:
        return [("started", f"more than {_PATIENCE:g} s")], _PATIENCE
    except OSError:  # longer than the system takes
        return [], 0.0
    seconds = time.perf_counter() - started
    output, errors = (text.decode(errors="backslashreplace") for text in (done.stdout, done.stderr))
    return complaint(done.returncode, output, errors, seconds), seconds


def shown(argv: Line) -> str:
    """Arguments in a line, long ones cut."""
    return " ".join(ascii(word) if len(word) < 80 else f"{word[:30]!a}…({len(word)})" for word in argv)


def configuration(rng: np.random.Generator) -> list[Fault]:
    """Any values for any settings of an agent: it is made, or ``ValueError`` in one line."""
    name, env = pick(rng, list(AGENTS)), pick(rng, BENCHMARKED)
    settings = fields(agent_class(name).Config)
    values: dict[str, Any] = {}
    for _ in range(int(rng.integers(1, 4))):
        field = pick(rng, settings)
        values[field.name] = pick(
            rng, (*wrong_values(field.default), 0, -1, 10**30, 1e-300, 1, 0.5, "", [1, 2])
        )
    try:
        with hostile.time_limit(hostile.PATIENCE):
            make_agent(name, env, values)
    except ValueError as error:
        return [] if "\n" not in str(error) else [Fault("not one line", f"{name} {values}: {error!r}")]
    except hostile.Hang:
        return [Fault("hang", f"{name} {values}")]
    except Exception as error:
        return [Fault("other exception", f"{name} on {env}, {values}: {type(error).__name__}: {error}"[:300])]
    return []


def portion(numbers: list[int], effort: Effort) -> list[tuple[int, list[Fault]]]:
    """Some trials in this process."""
    found = []
    with effort.scratch(f"from-{numbers[0]}") as place:
        places = Places(place, a_run(effort))
        _warm_up(places)
        for number in numbers:
            rng = effort.rng(number)
            if number % 10 in _CONFIGS:
                found.append((number, configuration(rng)))
                continue
            program, argv = command_line(rng, places)
            found.append((number, _faults(in_process(program, argv), program, argv)))
    return found


def _faults(wrong: list[tuple[str, str]], program: Program, argv: Line) -> list[Fault]:
    return [Fault(kind, f"{why}: python -m {program.module} {shown(argv)}") for kind, why in wrong]


def in_processes(numbers: list[int], effort: Effort) -> Iterator[tuple[int, list[Fault], float]]:
    """Some trials in a process each, one after the other; also says how long each took."""
    with effort.scratch("processes") as place:
        places = Places(place, a_run(effort))
        for number in numbers:
            program, argv = command_line(effort.rng(number), places)
            wrong, seconds = real_process(program, argv)
            yield number, _faults(wrong, program, argv), seconds


def a_run(effort: Effort) -> Path:
    """The folder of a small run, which is made if it is not there."""
    folder = effort.folder / f"{effort.row}-run"
    if not (folder / "run.json").exists():
        line = "--preset smoke --agents random --noise-levels 1 --episodes 2 --no-videos --workers 1".split()
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as errors:
            code = PROGRAMS[0].main([*line, "--envs", VEHICLE, "--out", str(folder)])
        if code != 0:
            raise OSError(f"cannot make a run to try command lines on: {errors.getvalue()}")
    return folder


def _warm_up(places: Places) -> None:
    """Import what the programs import: its time counts for processes of their own only."""
    for name in AGENTS:
        agent_class(name)
    for program in PROGRAMS:
        valid = [word for name, value in program.valid.items() for word in words(name, value, *places)]
        in_process(program, [*valid, "--no-such-option"])
        for line in program.conflicts:
            in_process(program, line.format(**places._asdict()).split("|"))
    in_process(PROGRAMS[0], ["--set", "rise.no_such=1", "--out", str(places.place / "out")])


def run(effort: Effort, tell: Tell) -> Findings:
    """Command lines and settings in turn."""
    findings = Findings()
    numbers = list(effort.numbers(10_000, 10))
    real = [number for number in numbers if number % _REAL == 0]
    inside = [number for number in numbers if number % _REAL]
    a_run(effort)  # once, not in every process
    size = max(1, -(-len(inside) // (4 * effort.workers)))
    tasks = [(inside[i : i + size], effort) for i in range(0, len(inside), size)]
    for done, (_, found) in enumerate(effort.each(portion, tasks)):
        for number, faults in found:
            findings.add(number, faults)
        tell(0.5 * (done + 1) / len(tasks), {"faults": len(findings.faults)})
    seconds: list[float] = []
    for number, faults, took in in_processes(real, effort):  # alone: their time counts
        findings.add(number, faults)
        seconds += [took] if took else []
        tell(0.5 + 0.5 * len(seconds) / len(real), {"faults": len(findings.faults)})
    if seconds:
        middle, most = np.median(seconds), max(seconds)
        findings.note = f"{len(seconds)} in processes of their own: {middle:.2f} s, at most {most:.2f} s"
    return findings
