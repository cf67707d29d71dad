"""What no file of the packages may do, read off its syntax: run code that arrives as data.

Checkpoints, demonstrations and results come from strangers. What unpickles, evaluates or rebuilds objects from them
runs whatever they hold.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = sorted(
    path for package in ("rise_envs", "rise_agents", "benchmarks") for path in (ROOT / package).rglob("*.py")
)

MODULES = {"pickle", "_pickle", "cPickle", "cloudpickle", "dill", "joblib", "shelve", "marshal"}
BUILTINS = {"eval", "exec", "compile", "__import__"}
NAMES = {
    *{"torch.load", "torch.hub.load", "torch.jit.load", "torch.package.PackageImporter"},
    *{
        "yaml.load",
        "yaml.load_all",
        "yaml.unsafe_load",
        "yaml.full_load",
        "pandas.read_pickle",
        "os.system",
        "os.popen",
    },
    *{f"builtins.{name}" for name in BUILTINS},
}
ATTRIBUTES = {"recover_environment"}  # of Minari's data sets: makes whatever environment they name
KEYWORDS = {"allow_pickle": False, "weights_only": True, "trust_remote_code": False, "shell": False}
# Whose load() reads numbers, texts or our own formats. Any other one is suspect: those of stable-baselines3 unpickle.
LOADERS = {
    *{"json", "tomllib", "numpy", "safetensors.numpy", "benchmarks.trajectories"},
    *{"rise_agents.checkpoint", "rise_agents.demonstrations", "rise_agents.demonstrations.minari_io"},
}


def violations(source: str) -> list[str]:
    """What a file does that none may do, as ``line: what``."""
    return [f"{line}: {what}" for line, what in sorted(_Rules().found(ast.parse(source)))]


class _Rules:
    """Follows the names that a file imports."""

    def __init__(self) -> None:
        self.names: dict[str, str] = {}  # as the file says -> in full

    def found(self, tree: ast.Module) -> Iterator[tuple[int, str]]:
        nodes = list(ast.walk(tree))
        for node in nodes:
            if isinstance(node, ast.Import | ast.ImportFrom):
                yield from self._imported(node)
        for node in nodes:
            if isinstance(node, ast.Name | ast.Attribute):
                yield from self._named(node)
            elif isinstance(node, ast.Call):
                yield from self._called(node)

    def _imported(self, node: ast.Import | ast.ImportFrom) -> Iterator[tuple[int, str]]:
        for alias in node.names:
            if isinstance(node, ast.Import):
                full, known = alias.name, alias.asname or alias.name.partition(".")[0]
                self.names[known] = full if alias.asname else known
            else:
                full = f"{node.module or ''}.{alias.name}"
                self.names[alias.asname or alias.name] = full
            if full.partition(".")[0] in MODULES or alias.name in MODULES:
                yield node.lineno, f"imports {full}"
            if alias.name == "*":
                yield node.lineno, f"imports everything of {node.module}"  # type: ignore[union-attr]  # no plain import

    def _full(self, node: ast.AST) -> str:
        """A dotted name as it is called in full; what is no name becomes ``?``."""
        if isinstance(node, ast.Name):
            return self.names.get(node.id, f"builtins.{node.id}" if node.id in BUILTINS else node.id)
        return f"{self._full(node.value)}.{node.attr}" if isinstance(node, ast.Attribute) else "?"

    def _named(self, node: ast.Name | ast.Attribute) -> Iterator[tuple[int, str]]:
        full = self._full(node)
        if full in NAMES and isinstance(node.ctx, ast.Load):
            yield node.lineno, f"uses {full}"
        if isinstance(node, ast.Attribute):
            yield from self._attribute(node.lineno, self._full(node.value), node.attr)

    def _attribute(self, line: int, owner: str, name: str) -> Iterator[tuple[int, str]]:
        if name in ATTRIBUTES:
            yield line, f"uses {name}"
        if name == "load" and owner not in LOADERS and f"{owner}.load" not in NAMES:
            yield line, f"uses {owner}.load"
        owner_name = owner.rpartition(".")[2].lower()
        if name in ("make", "from_json") and ("spec" in owner_name or owner_name == "?"):
            yield line, f"uses {owner}.{name}: an EnvSpec makes whatever class it names"

    def _called(self, node: ast.Call) -> Iterator[tuple[int, str]]:
        full = self._full(node.func)
        text = [
            one.value for one in node.args if isinstance(one, ast.Constant) and isinstance(one.value, str)
        ]
        if full == "importlib.import_module" and text and text[0].partition(".")[0] in MODULES:
            yield node.lineno, f"imports {text[0]}"
        if full == "getattr" and text and node.args:
            owner = self._full(node.args[0])
            if f"{owner}.{text[0]}" in NAMES:
                yield node.lineno, f"uses {owner}.{text[0]}"
            yield from self._attribute(node.lineno, owner, text[0])
        for keyword in node.keywords:
            if keyword.arg in KEYWORDS:
                value = keyword.value
                if not (isinstance(value, ast.Constant) and value.value is KEYWORDS[keyword.arg]):
                    yield node.lineno, f"says {keyword.arg}={ast.unparse(value)}"


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_file_runs_what_it_reads(path: Path) -> None:
    assert violations(path.read_text("utf-8")) == []


def test_all_packages_are_read() -> None:
    assert {path.relative_to(ROOT).parts[0] for path in FILES} == {"rise_envs", "rise_agents", "benchmarks"}
    assert len(FILES) > 90


@pytest.mark.parametrize(
    "snippet",
    [
        "import pickle",
        "import _pickle as p",
        "import os, cloudpickle",
        "import joblib.numpy_pickle",
        "from dill import loads",
        "from shelve import open as o",
        "from marshal import *",
        "from six.moves import cPickle",
        "def f():\n    import pickle",
        "import importlib\nimportlib.import_module('pickle')",
        "from importlib import import_module as im\nim('dill.source')",
        "__import__('pickle')",
        "eval('1')",
        "exec(code)",
        "run = exec",
        "compile(text, '', 'exec')",
        "import builtins\nbuiltins.eval('1')",
        "from builtins import exec as run\nrun('1')",
        "import torch\ntorch.load(path)",
        "import torch as t\nt.load(path, weights_only=True)",
        "from torch import load\nload(path)",
        "from torch import load as read\nread(path)",
        "import torch\nread = torch.load",
        "import torch\ngetattr(torch, 'load')(path)",
        "import torch.hub\ntorch.hub.load('a', 'b')",
        "import numpy as np\nnp.load(path, allow_pickle=True)",
        "import numpy as np\nnp.load(path, allow_pickle=trusted)",
        "read(path, weights_only=False)",
        "AutoModel.from_pretrained(name, trust_remote_code=True)",
        "import subprocess\nsubprocess.run(command, shell=True)",
        "import os\nos.system(command)",
        "from stable_baselines3 import PPO\nPPO.load(path)",
        "from stable_baselines3 import PPO as Algorithm\nAlgorithm.load(path)",
        "import stable_baselines3 as sb3\nsb3.PPO.load(path)",
        "from stable_baselines3.common.vec_env import VecNormalize\nVecNormalize.load(path, venv)",
        "from stable_baselines3.common.policies import ActorCriticPolicy\nActorCriticPolicy.load(path)",
        "from rise_agents.constrained_ppo import ConstrainedPPO\nConstrainedPPO.load(path)",
        "model = make()\nmodel.load(path)",
        "type(model).load(path)",
        "import yaml\nyaml.load(text)",
        "from yaml import load as read\nread(text)",
        "import pandas as pd\npd.read_pickle(path)",
        "dataset.recover_environment()",
        "env.spec.make()",
        "import gymnasium as gym\ngym.spec(name).make()",
        "from gymnasium.envs.registration import EnvSpec\nEnvSpec.from_json(text)",
        "import minari\nminari.load_dataset(name).env_spec.make()",
    ],
)
def test_hostile_snippets_are_found(snippet: str) -> None:
    found = violations(snippet)
    assert found and found[-1].startswith(f"{len(snippet.splitlines())}:")


@pytest.mark.parametrize(
    "snippet",
    [
        "import json\njson.load(file)",
        "import numpy as np\nnp.load(path)\nnp.load(path, allow_pickle=False)",
        "import re\nre.compile('a')",
        "import gymnasium as gym\ngym.make(name)",
        "from benchmarks.speed import envs\nenvs.make(name)",
        "from safetensors import numpy as st\nst.load(body)",
        "model.eval()",
        "from rise_agents import checkpoint\ncheckpoint.load(path)",
        "import subprocess\nsubprocess.run([command], shell=False)",
        "import importlib\nimportlib.import_module(module)",
        "text = 'import pickle'",
        "def evaluate(compiled):\n    return compiled",
    ],
)
def test_harmless_snippets_are_not(snippet: str) -> None:
    assert violations(snippet) == []


def test_what_is_hidden_from_the_linter_is_known() -> None:
    """Only an assertion for the type checker and a process from a list of words may go by ruff's security rules."""
    hidden = [
        (str(path.relative_to(ROOT)), code)
        for path in FILES
        for line in path.read_text("utf-8").splitlines()
        for directive in re.findall(r"#\s*noqa(.*)", line, re.IGNORECASE)
        for code in re.findall(r"\bS\d+", directive)
        or ([] if directive.lstrip().startswith(":") else ["everything"])
    ]
    assert {code for _, code in hidden} <= {"S101", "S603"}, hidden
