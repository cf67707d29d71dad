"""Ship the agents of a benchmark run: copies their checkpoints; a card says where they come from.

The copies are the run's files byte for byte, unless a row acts otherwise than its file says (rows that differ in
nothing else share one): then it goes into the copy, so that who loads it by name gets what was measured.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rise_agents import agent_class, checkpoint, load_agent
from rise_agents.agent import acting_settings, nearest
from rise_agents.checkpoint import CheckpointError
from rise_agents.cli import Parser, command, prepare_folder
from rise_agents.files import replace_file
from rise_agents.pretrained import CARD, FOLDER, file_of, is_name, sha256
from rise_envs import ENVS

_EXAMPLES = """\
examples:
  python -m rise_agents.pretrained runs/quick
  python -m rise_agents.pretrained runs/paper --agents rise pcbc --seed 2 --note 'trained at commit 0123abc'
"""


def parser() -> Parser:
    """The command line."""
    p = Parser(
        plugins=True,
        prog="python -m rise_agents.pretrained",
        description="Copy the trained agents of a benchmark run to where load_agent finds them by name.",
        epilog=_EXAMPLES,
    )
    p.add_argument("run", type=Path, metavar="RUN_DIR", help="run folder, with its run.json")
    p.add_argument("--agents", nargs="+", metavar="NAME", help="which of the run (default: all)")
    p.add_argument("--envs", nargs="+", metavar="ID", help="in which environments (default: all of the run)")
    p.add_argument("--seed", type=int, default=0, metavar="N", help="training seed (default: 0)")
    p.add_argument("--note", default="", metavar="TEXT", help="goes into the card, for instance the commit")
    p.add_argument(
        "--into", type=Path, default=FOLDER, metavar="DIR", help="another folder than the package's"
    )
    return p


def read_run(folder: Path) -> dict[str, Any]:
    """The ``run.json`` of a run folder, as far as it is needed here.

    Raises:
        ValueError: it is missing, or no record of a run.
    """
    path = folder / "run.json"
    try:
        run = json.loads(path.read_text())
        kept = {key: run[key] for key in ("command", "agents", "demonstrations")}
        kept["settings"], kept["variants"] = run.get("settings", {}), run.get("plan", {}).get("variants", {})
        texts = [text for paths in kept["agents"].values() for pair in paths.items() for text in pair]
        fits = isinstance(kept["command"], str) and all(isinstance(text, str) for text in texts)
        told = [*kept["settings"].values(), *kept["variants"].values()]
        fits = fits and all(isinstance(each, dict) for each in told)
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        fits = False
    if not fits:
        raise ValueError(f"{path} is no record of a benchmark run: name the folder of a finished one")
    return kept


def chosen(a: argparse.Namespace, agents: dict[str, dict[str, str]]) -> list[tuple[str, str, Path]]:
    """(agent, environment, checkpoint) of what is to be copied.

    Args:
        a: the arguments.
        agents: of the run: per environment, the checkpoints by ``NAME-seedN``.

    Raises:
        ValueError: the run has no such agent, environment or training seed.
    """
    for env in a.envs or agents:
        if env not in agents or env not in ENVS:
            raise ValueError(f"the run has no environment {env!r}: {nearest(env, agents)}")
    found = []
    for env in a.envs or agents:
        cut = {key.rpartition("-seed")[::2]: path for key, path in agents[env].items()}
        # What stands behind a filter (pcbc+kalman) is no other agent, and its name none of an agent.
        own = {name: path for (name, seed), path in cut.items() if seed == str(a.seed) and is_name(name)}
        for name in a.agents or own:
            if name not in own:
                known = nearest(name, own)
                raise ValueError(f"the run has no {name!r} of training seed {a.seed} in {env}: {known}")
            found.append((name, env, a.run / own[name]))
    if not found:
        raise ValueError(f"the run has no agent of training seed {a.seed}")
    return found


def acting(name: str, path: Path, env: str, run: dict[str, Any]) -> dict[str, Any]:
    """The settings by which a row of the run acted, as far as its checkpoint says something else.

    Raises:
        CheckpointError: the checkpoint cannot be used.
        ValueError: the run's settings are none of this agent.
    """
    load_agent(path, env)
    _, description = checkpoint.load(path)
    settings = run["settings"].get(f"{name}@{env}", {})
    told = {key: settings[key] for key in acting_settings(agent_class(description["agent"])) & set(settings)}
    load_agent(path, env, settings=told)
    return {key: value for key, value in told.items() if value != description["config"].get(key)}


def copy(path: Path, target: Path, settings: dict[str, Any]) -> Path:
    """Put a checkpoint to ``target``, with other ``settings`` if there are some."""
    if not settings:
        return replace_file(target, path.read_bytes())
    arrays, description = checkpoint.load(path)
    checkpoint.save(target, arrays, {**description, "config": {**description["config"], **settings}})
    return target


def entry(name: str, path: Path, env: str, run: dict[str, Any], note: str) -> dict[str, Any]:
    """What the card says of a checkpoint that was put there."""
    _, description = checkpoint.load(path)
    told = {key: description[key] for key in ("agent", "env", "seed", "config", "versions")}
    told |= {"sha256": sha256(path), "bytes": path.stat().st_size, "run": run["command"]}
    sets, expert = run["demonstrations"], run["variants"].get(name, {}).get("expert")
    source = sets.get(f"{env} by {expert}", sets.get(env))  # a variant can have a demonstrator of its own
    if agent_class(description["agent"]).learns_from == "demonstrations" and source:
        told["demonstrations"] = source
    return {**told, "note": note} if note else told


def ship(a: argparse.Namespace) -> list[Path]:
    """Copy what the arguments ask for, and renew the card; returns the files.

    Raises:
        ValueError: the run or the arguments make no sense; nothing was copied.
        CheckpointError: a checkpoint cannot be used; nothing was copied.
    """
    run = read_run(a.run)
    pieces = chosen(a, run["agents"])
    changes = [acting(name, path, env, run) for name, env, path in pieces]
    prepare_folder(a.into)
    card = a.into / CARD
    told = json.loads(card.read_text()) if card.exists() else {}
    made = []
    for (name, env, path), settings in zip(pieces, changes, strict=True):
        made.append(copy(path, file_of(name, env, a.into), settings))
        told[made[-1].name] = entry(name, made[-1], env, run, a.note)
    replace_file(card, (json.dumps(told, indent=2, sort_keys=True) + "\n").encode())
    return made


@command("rise_agents.pretrained", failed=(CheckpointError,))
def main(argv: Sequence[str] | None = None) -> int:
    """Ship trained agents; returns the exit code: 0 done, 1 a file cannot be read or written, 2 bad arguments."""
    made = ship(parser().parse_args(argv))
    for path in made:
        print(f"{path}: {path.stat().st_size:,} bytes")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
