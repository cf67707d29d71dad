"""One door to all commands: ``rise-bench run --agents rise`` is ``python -m benchmarks.run --agents rise``."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rise_agents import __version__
from rise_agents.agent import nearest
from rise_agents.cli import command


class Command(NamedTuple):
    """A command.

    Attributes:
        module: that has its ``parser`` and ``main``.
        line: what it does.
    """

    module: str
    line: str


COMMANDS = {
    "run": Command("benchmarks.run", "train, evaluate on noisy scenarios, tables, figures, videos"),
    "tune": Command("benchmarks.tune.__main__", "search settings, with the same budget for every agent"),
    "report": Command("benchmarks.report", "make tables and figures again, from the episodes of a run"),
    "replay": Command("benchmarks.replay", "run a recorded episode again, check it, draw it"),
    "upload": Command("benchmarks.upload", "show a run on Weights & Biases"),
    "publish": Command("benchmarks.publish", "make what is committed of a run, or check it"),
    "demonstrations": Command("rise_agents.demonstrations.__main__", "record an expert's episodes"),
    "play": Command("rise_agents.play", "drive with the keyboard, keep it as demonstrations"),
    "pretrained": Command("rise_agents.pretrained.__main__", "ship the trained agents of a run by name"),
    "export": Command("rise_agents.export.__main__", "make one ONNX file of a trained agent"),
    "runtime": Command("rise_agents.runtime.__main__", "run an agent at a fixed rate, in real time"),
    "runtime-send": Command("rise_agents.runtime.send", "stream readings and goals to it over UDP"),
    "runtime-replay": Command("rise_agents.runtime.replay", "show what its log says"),
    "speed": Command("benchmarks.speed.__main__", "measure speed against the peers"),
    "fidelity": Command("benchmarks.fidelity.__main__", "measure the kinematic arm against Bullet's"),
    "cluster-estimate": Command(
        "benchmarks.cluster_estimate", "how long a run takes on a cluster, from measured times"
    ),
    "faults": Command("benchmarks.faults.__main__", "try to break the suite"),
}
SHELLS = ("bash", "zsh", "tcsh")
_EXAMPLES = """\
examples:
  rise-bench run --agents rise pcbc cppo
  rise-bench run --import my_agent.py --agents mine pcbc --noise-model step episode
  rise-bench tune --agents rise --envs RISE-GroundVehicle-v0
  rise-bench demonstrations --env RISE-SafePanda-v0 --episodes 500 --out demos/panda
  rise-bench report runs/quick

rise-bench COMMAND --help says all about a command.
rise-bench --print-completion bash (or zsh, tcsh) gives a script that completes all this, and names of environments,
agents, presets and the like, at the TAB key.
"""


def help_text() -> str:
    """What ``--help`` says."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {each.line}" for name, each in COMMANDS.items()]
    return "\n".join(["usage: rise-bench COMMAND [options]", "", "commands:", *lines, "", _EXAMPLES.rstrip()])


def known_names() -> dict[str, Iterable[str]]:
    """What can follow an option, where that is a name."""
    from benchmarks.configs import SHIPPED, read
    from benchmarks.presets import PRESETS
    from rise_agents import AGENTS
    from rise_agents.experts import EXPERTS
    from rise_agents.filters import FILTERS
    from rise_envs import ENVS, NOISE_MODELS, STAND_INS

    return {
        "--agents": [*AGENTS, *read([SHIPPED]).variants, "expert", "random"],
        "--envs": ENVS,
        "--env": ENVS,
        "--eval-env": STAND_INS,
        "--preset": PRESETS,
        "--expert": dict.fromkeys(name for _, name in EXPERTS),
        "--filter": FILTERS,
        "--noise-model": NOISE_MODELS,
        "--device": ("cpu", "cuda"),
    }


def completion(shell: str) -> str:
    """A script that completes commands, options and names.

    Raises:
        ValueError: an unknown shell, or the package that writes such scripts is not installed.
    """
    if shell not in SHELLS:
        raise ValueError(
            f"--print-completion takes the name of a shell, got {shell!r}: {nearest(shell, SHELLS)}"
        )
    try:
        import shtab
    except ImportError:
        raise ValueError("completion needs one more package: pip install 'rise-suite[completion]'") from None
    whole = argparse.ArgumentParser(prog="rise-bench")
    commands, names = whole.add_subparsers(), known_names()
    for name, each in COMMANDS.items():
        own = importlib.import_module(each.module).parser()
        for action in own._actions:
            _complete(action, names, shtab)
        commands.add_parser(name, help=each.line, parents=[own], add_help=False)
    return shtab.complete(whole, shell)


def _complete(action: argparse.Action, names: dict[str, Iterable[str]], shtab: Any) -> None:
    """Say what can follow an option; its parser is for nothing else."""
    for option in action.option_strings:
        if option in names:
            action.choices = list(names[option])
    if action.type is Path or action.dest == "modules":
        folder = action.metavar in ("DIR", "RUN_DIR")
        action.complete = shtab.DIRECTORY if folder else shtab.FILE  # type: ignore[attr-defined]  # shtab's way


@command("rise-bench")
def main(argv: Sequence[str] | None = None) -> int:
    """Hand over to a command; returns its exit code, 2 for an unknown one, 130 if interrupted."""
    words = list(sys.argv[1:] if argv is None else argv)
    if not words or words[0] in ("-h", "--help"):
        print(help_text())
        return 0 if words else 2
    if words[0] == "--version":
        print(f"rise-suite {__version__}")
        return 0
    if words[0] == "--print-completion":
        print(completion(words[1] if len(words) > 1 else ""))
        return 0
    if words[0] not in COMMANDS:
        raise ValueError(f"unknown command {words[0]!r}: {nearest(words[0], COMMANDS)}")
    return importlib.import_module(COMMANDS[words[0]].module).main(words[1:])


if __name__ == "__main__":
    raise SystemExit(main())
