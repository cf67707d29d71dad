"""The command line: ``python -m rise_agents.export``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rise_agents import load_agent
from rise_agents.checkpoint import CheckpointError
from rise_agents.cli import Parser, at_work, command

_EXAMPLES = """\
examples:
  python -m rise_agents.export agent.rise --onnx                       writes agent.onnx
  python -m rise_agents.export agent.rise --onnx --set posterior=mean --out mean.onnx
  python -m rise_agents.export rise --env RISE-SafePanda-v0 --onnx     weights that come with the package, if there
"""


def parser() -> Parser:
    """The command line."""
    p = Parser(
        plugins=True,
        prog="python -m rise_agents.export",
        description="Turn a trained agent into one file that runs without Python, and check that it acts the same.",
        epilog=_EXAMPLES,
    )
    p.add_argument("agent", metavar="CKPT", help="checkpoint, or the name of an agent of the package")
    p.add_argument("--env", metavar="ID", help="the environment it must be of; a name needs it")
    p.add_argument("--onnx", action="store_true", help="the format: ONNX, for onnxruntime and others")
    p.add_argument("--out", type=Path, metavar="FILE", help="where to (default: beside CKPT, or here)")
    p.add_argument(
        "--set", nargs="+", default=[], metavar="KEY=VALUE", help="how it acts, laid over what is stored"
    )
    return p


def settings_of(texts: Sequence[str]) -> dict[str, Any]:
    """``KEY=VALUE`` texts as settings, values JSON or plain words; raises ``ValueError`` for texts of another form."""
    found: dict[str, Any] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not key or not equals:
            raise ValueError(f"--set takes KEY=VALUE, for instance margin=0.5, got {text!r}")
        try:
            found[key] = json.loads(value)
        except (ValueError, RecursionError):
            found[key] = value
    return found


@command("rise_agents.export", bad_input=(CheckpointError,))
def main(argv: Sequence[str] | None = None) -> int:
    """Export; returns the exit code: 0 done, 1 not written, 2 bad arguments, 130 interrupted."""
    a: Any = parser().parse_args(argv)
    if not a.onnx:
        raise ValueError("name the format: --onnx")
    agent: Any = load_agent(a.agent, a.env, settings=settings_of(a.set))
    out = a.out or _beside(a.agent, agent.env_id)
    with at_work(ImportError):
        try:
            from rise_agents.export import export

            found = export(agent, out)
        except ModuleNotFoundError as error:
            raise ImportError(f"{error.name} is missing: pip install 'rise-suite[onnx]'") from None
    print(f"{out}: {agent.name} for {agent.env_id}, {out.stat().st_size:,} bytes")
    print(f"largest difference over {found.count:,} observations of noisy validation episodes, by action:")
    for name in ("agent", "deterministic", "torch"):
        numbers = ", ".join(f"{x:.1e}" for x in getattr(found, name))
        print(f"  to {_MEANINGS[name]}: {numbers}")
    return 0


_MEANINGS = {
    "agent": "the agent's predict",
    "deterministic": "the agent's predict, deterministic",
    "torch": "its networks in torch",
}


def _beside(given: str, env: str) -> Path:
    path = Path(given)
    return path.with_suffix(".onnx") if path.exists() else Path(f"{given}-{env}.onnx")


if __name__ == "__main__":
    raise SystemExit(main())
