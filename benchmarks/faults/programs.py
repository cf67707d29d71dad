"""The command lines of the suite: how each is called, and what its options must refuse."""

from __future__ import annotations

import importlib
import importlib.util
from argparse import Action
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from benchmarks.presets import VEHICLE

NAMES = ("", " ", "x", "RISE", "expertt", "é" * 40, "名前", "\U0001f916", "a\nb", "\x00", "x" * 100_000, "-", "=",
         "rise;ls", "$(ls)", "../..", "%s%n", "{0}", "[bold]x[/]", "None", "\udcff", "rise pcbc", "rise\r")  # fmt: skip
NO_WHOLE = ("NaN", "inf", "-inf", "1e400", "1.5", "-1", "-9999999999", "", " ", "abc", "0x10", "1,000", "9" * 5_000,
            "None", "1e3", "\x00", "1\n2", "--")  # fmt: skip
NO_NUMBER = ("NaN", "-inf", "-1", "-0.5", "", "abc", "1,5", "None", "0x1p3", "\x00", "--1")
NO_END = ("inf", "1e400")  # of which there are options that take them
ADDRESSES = (
    "",
    "x",
    ":",
    "x:",
    "127.0.0.1:",
    "127.0.0.1:x",
    "127.0.0.1:-1",
    "127.0.0.1:65536",
    "\x00:1",
    "é\n:5",
)


class Program(NamedTuple):
    """A command line.

    Attributes:
        module: for ``python -m``.
        valid: arguments with which it would start, by option or, for what has no option, by its name; ``{place}``
            is a folder to write to, ``{run}`` that of a run.
        conflicts: arguments that each make sense, but not together or not here; these alone, and ``beside``.
        beside: names of ``valid`` that conflicts need.
        endless: options to which infinity means never, or for ever.
    """

    module: str
    valid: dict[str, str]
    conflicts: tuple[str, ...]
    beside: tuple[str, ...] = ()
    endless: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Of the module that has ``parser`` and ``main``."""
        spec = importlib.util.find_spec(self.module)
        return f"{self.module}.__main__" if spec and spec.submodule_search_locations else self.module

    def options(self) -> list[Action]:
        """All that it takes but ``--help``."""
        return [a for a in importlib.import_module(self.name).parser()._actions if a.dest != "help"]

    def main(self, argv: Sequence[str]) -> int:
        """In this process."""
        return importlib.import_module(self.name).main(argv)

    def refused(self, option: Action) -> tuple[str, ...]:
        """Texts that an option, or what has none, must refuse; none if it takes any text or a path."""
        name = name_of(option)
        if name in _TEXTS:
            return _TEXTS[name]
        if option.type is int:
            return NO_WHOLE
        if option.type is float:
            return NO_NUMBER if name in self.endless else (*NO_NUMBER, *NO_END)
        return ()


def name_of(option: Action) -> str:
    """As users call it."""
    return option.option_strings[0] if option.option_strings else option.dest


def words(name: str, value: str, place: Path, run: Path) -> list[str]:
    """An argument of :attr:`Program.valid` as it is typed."""
    value = value.format(place=place, run=run)
    return [name, *value.split("|")] if name.startswith("--") else [value]


# option, or what has none -> texts that it must refuse
_TEXTS: dict[str, tuple[str, ...]] = {
    "--agents": NAMES, "--envs": NAMES, "--env": NAMES, "--preset": NAMES, "--expert": NAMES, "--rows": NAMES,
    "--filter": NAMES, "--import": NAMES, "--agent": NAMES, "agent": NAMES, "env": NAMES, "--executor": NAMES,
    "--eval-env": NAMES[1:],  # an empty one is none
    "--noise-model": (*NAMES, "step+", "+step", "dropout:2", "dropout:x", "delay:-1", "step:1:2", "delay:nan"),
    "--device": (*NAMES, "cuda:99", "cpu:-1", "meta:x"),
    "--minari": ("", "x", "a/b", "a b/c-v0", "/", "../x-v0", "x-v", "x" * 300 + "-v0x", "\x00", "a\nb"),
    "--udp": ADDRESSES, "--to": ADDRESSES, "--ray-address": ADDRESSES,
    "--project": ("", " ", "a/b", "\x00", "x" * 1_000),
    "--hours": (*NO_NUMBER, *NO_END, "0"),
    "--share": (*NO_NUMBER, *NO_END, "0", "1.01"),
}  # fmt: skip

_PLACE = {"--out": "{place}/out"}
PROGRAMS = (
    Program(
        "benchmarks.run",
        {"--preset": "smoke", **_PLACE},
        (
            f"--agents|rise|--envs|{VEHICLE}|--expert|pcbc",
            "--agents|cppo|--set|cppo.n_envs=3|cppo.n_steps=5|cppo.batch_size=7",
            "--noise-levels|1|-1",
            "--agents|rise|nobody",
            "--pretrained|--seeds|2",
            "--ray-address|127.0.0.1:1",
        ),
        endless=("--checkpoint-every",),
    ),
    Program(
        "benchmarks.tune",
        {"--agents": "pcbc", "--envs": VEHICLE, **_PLACE},
        ("--agents|rise|nobody", "--agents|expert", "--eval-env|CartPole-v1", "--trials|0"),
        endless=("--checkpoint-every",),
    ),
    Program(
        "benchmarks.report",
        {"source": "{run}", **_PLACE},
        ("{place}", "{run}/run.json", "{run}|--out|{run}/run.json"),
    ),
    Program(
        "benchmarks.publish",
        {"run": "{run}", **_PLACE},
        ("{place}", "{place}|--check", "{run}|--check|--partial"),
    ),
    Program(
        "benchmarks.replay",
        {"run": "{run}", "--agent": "random", "--scenario": "0", "--out": "{place}/out.mp4"},
        ("--scenario|99", "--agent|rise", "--noise-level|7", "--noise-model|drift", "--seed|5", "--out|{place}/x.txt"),
        beside=("run",),
    ),
    Program("benchmarks.upload", {"run": "{run}", "--project": "x"}, ("{place}|--project|x", "{run}")),
    Program(
        "benchmarks.cluster_estimate",
        {"run": "{run}"},
        ("{place}", "{run}|--docs|{place}/no.md", "{run}|--nodes|0", "{run}|--cores|0"),
    ),
    Program(
        "benchmarks.speed",
        {"--rows": "memory", **_PLACE},
        ("--render", "--rows|memory|no-such", "--docs|{place}/no.md"),
        beside=("--out",),
    ),
    Program("benchmarks.fidelity", _PLACE, ("--episodes|2", "--docs|{place}/no.md"), beside=("--out",)),
    Program(
        "benchmarks.faults",
        {"--rows": "save-load", **_PLACE},
        (
            "--quick|--share|0.5",
            "--only|3",
            "--only|3|--rows|fuzz|replay",
            "--rows|fuzz|--render",
            "--docs|{place}/no.md",
        ),
        beside=("--out",),
    ),
    Program(
        "rise_agents.demonstrations",
        {"--env": VEHICLE, **_PLACE},
        ("--expert|panda", "--seed|1000", "--episodes|99999999999", "--minari|no version"),
        beside=("--env", "--out"),
    ),
    Program(
        "rise_agents.export",
        {"agent": "pcbc", "--env": VEHICLE, "--out": "{place}/out.onnx"},
        ("pcbc", "rise|--env|CartPole-v1", "{place}", "{run}/run.json", f"rise|--env|{VEHICLE}|--set|x=1"),
    ),
    Program(
        "rise_agents.runtime",
        {"--agent": "rise", "--env": VEHICLE, "--seconds": "1"},
        ("--rate|0", "--seconds|0", "--rate-limit|1|2|3|4|5|6|7|8|9", "--noise-model|nobody"),
        beside=("--agent", "--env"),
        endless=("--stale-after", "--resume-after", "--rate-limit"),
    ),
    Program(
        "rise_agents.runtime.send",
        {"--env": VEHICLE, "--seconds": "0.1"},
        (f"--env|{VEHICLE}|--log|x", "--seconds|1", f"--env|{VEHICLE}|--rate|0"),
    ),
    Program("rise_agents.runtime.replay", {"log": "{run}/episodes.parquet"}, ("{place}", "{run}/run.json")),
    Program(
        "rise_agents.play",
        {"env": VEHICLE, **_PLACE},
        ("CartPole-v1", f"{VEHICLE}|--seed|1000", f"{VEHICLE}|--episodes|0"),
    ),
    Program(
        "rise_agents.pretrained",
        {"run": "{run}", "--into": "{place}/into"},
        ("{place}", "{run}|--agents|rise", "{run}|--seed|9", "{run}|--envs|RISE-SafePanda-v0"),
    ),
)  # fmt: skip
