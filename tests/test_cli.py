"""The one door to all commands, and what the TAB key completes."""

from __future__ import annotations

import importlib
import json
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from benchmarks import cli
from rise_agents.cli import WorkFailed, at_work, command
from rise_envs import ENVS

ROOT = Path(__file__).resolve().parents[1]


def test_the_console_script_is_this_one():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["scripts"] == {"rise-bench": "benchmarks.cli:main"}


def test_all_command_lines_of_the_packages_are_there():
    """Whatever has a parser of its own and can be started."""
    modules = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for package in ("benchmarks", "rise_agents", "rise_envs")
        for path in (ROOT / package).rglob("*.py")
        if "\ndef parser(" in path.read_text() and "\ndef main(" in path.read_text()
    }
    assert {command.module for command in cli.COMMANDS.values()} == modules


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_commands_are_handed_what_follows(name, monkeypatch):
    heard = []
    module = importlib.import_module(cli.COMMANDS[name].module)
    monkeypatch.setattr(module, "main", lambda argv: heard.append(argv) or 7)
    assert cli.main([name, "--agents", "rise", "-h"]) == 7
    assert heard == [["--agents", "rise", "-h"]]


def test_help_lists_all_commands(capsys):
    assert cli.main(["--help"]) == 0
    text = capsys.readouterr().out
    for name, each in cli.COMMANDS.items():
        assert f"  {name} " in text and each.line in text
    assert "examples:" in text
    assert max(map(len, text.splitlines())) <= 120
    assert cli.main([]) == 2


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["rum"], "unknown command 'rum': did you mean 'run'?"),
        (["--print-completion"], "takes the name of a shell"),
        (["--print-completion", "bsh"], "did you mean 'bash'?"),
        (["run", "--presett", "smoke"], "did you mean '--preset'"),
    ],
)
def test_mistakes_are_one_line(argv, message, capsys):
    assert cli.main(argv) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_a_name_with_a_line_break_takes_one_line(capsys):
    @command("x")
    def main(argv):
        raise ValueError("a\nb: cannot be read")

    assert main([]) == 2
    assert capsys.readouterr().err == "x: a\\nb: cannot be read\n"


def test_an_interruption_is_told_by_the_exit_code(monkeypatch):
    def interrupted(argv):
        raise KeyboardInterrupt

    monkeypatch.setattr(importlib.import_module("benchmarks.report"), "main", interrupted)
    assert cli.main(["report", "x"]) == 130


def test_without_the_package_that_writes_scripts(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert cli.main(["--print-completion", "bash"]) == 2
    assert "pip install 'rise-suite[completion]'" in capsys.readouterr().err


COMPLETE = """
source "$1"
shift
COMP_WORDS=("$@")
COMP_CWORD=$(($# - 1))
compopt() { :; }
_shtab_rise_bench
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    pytest.importorskip("shtab")
    code = (
        "import sys; from benchmarks import cli; status = cli.main(['--print-completion', 'bash']); "
        "print(*{'torch', 'stable_baselines3', 'pybullet'} & set(sys.modules), file=sys.stderr); sys.exit(status)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stderr.split() == []  # nothing heavy was loaded for it
    path = tmp_path_factory.mktemp("completion") / "rise-bench"
    path.write_text(done.stdout)
    return path


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (["ru"], {"run", "runtime", "runtime-send", "runtime-replay"}),
        (["run", "--envs", "RISE-G"], {"RISE-GroundVehicle-v0"}),
        (["run", "--envs", "RISE-GroundVehicle-v0", "RISE-Safe"], {e for e in ENVS if "Safe" in e}),
        (["run", "--agents", "cpp"], {"cppo", "cppo-long"}),
        (["run", "--agents", "rise", "--preset", "sm"], {"smoke"}),
        (["tune", "--eval-env", ""], {"RISE-SafePandaKinematic-v0"}),
        (["demonstrations", "--min"], {"--minari"}),
        (["run", "--filter", "k"], {"kalman"}),
    ],
)
def test_bash_offers(script, words, offered):
    command = ["bash", "-c", COMPLETE, "bash", str(script), "rise-bench", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) == offered


def test_zsh_and_tcsh_get_theirs():
    pytest.importorskip("shtab")
    for shell in ("zsh", "tcsh"):
        text = cli.completion(shell)
        assert "rise-bench" in text and "RISE-GroundVehicle-v0" in text


def test_a_command_of_the_door_can_be_repeated_from_its_record(tmp_path):
    """What run.json says is the command of the module, whichever door it came through."""
    out = tmp_path / "run"
    argv = [
        "run",
        "--agents",
        "random",
        "--envs",
        "RISE-GroundVehicle-v0",
        "--preset",
        "smoke",
        "--no-videos",
    ]
    assert cli.main([*argv, "--workers", "1", "--out", str(out)]) == 0
    command = json.loads((out / "run.json").read_text())["command"]
    assert command.startswith("python -m benchmarks.run --agents random --envs RISE-GroundVehicle-v0")


# --- how commands end ----------------------------------------------------------------------------------------------


def test_who_reads_may_go_before_the_end():
    """As in ``rise-bench --help | head -0``."""
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "benchmarks.cli", "--help"]
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, check=False, cwd=ROOT)
    os.close(writing)
    assert (done.returncode, done.stderr) == (1, "")


class Narrow(OSError):
    """A kind of its own of what else is a failure."""


@pytest.mark.parametrize(
    ("error", "code", "says"),
    [
        (ValueError("no such thing"), 2, "tool: no such thing\n"),
        (UnicodeError("not text"), 2, "tool: not text\n"),  # a ValueError, too
        (PermissionError("not yours"), 1, "tool: not yours\n"),
        (Narrow("of the arguments"), 2, "tool: of the arguments\n"),
        (KeyError("key"), 1, "tool: 'key'\n"),
        (WorkFailed("broke"), 1, "tool: broke\n"),
        (KeyboardInterrupt(), 130, "\ntool: stopped\n"),
    ],
)
def test_a_command_ends_in_one_line_and_a_code(error, code, says, capsys):
    @command("tool", bad_input=(Narrow,), failed=(KeyError,), interrupted="stopped")
    def main(argv=None):
        raise error

    assert main([]) == code
    assert capsys.readouterr().err == says


def test_too_many_open_files_are_told_with_the_limit(tmp_path):
    """As they are met, in a process that may have few."""
    code = """
import resource
from rise_agents.cli import command
@command("tool")
def main(argv=None):
    resource.setrlimit(resource.RLIMIT_NOFILE, (17, 17))
    print([open(__file__) for _ in range(17)])
raise SystemExit(main([]))
"""
    script = tmp_path / "tool.py"
    script.write_text(code)
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=False)
    assert done.returncode == 1 and done.stderr.count("\n") == 1
    assert "may have 17 here" in done.stderr and "ulimit -n" in done.stderr


def test_what_no_user_can_cause_is_not_hidden():
    @command("tool")
    def main(argv=None):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        main([])


def test_at_work_the_arguments_are_not_to_blame():
    with pytest.raises(WorkFailed, match="damaged"), at_work():
        raise ValueError("damaged")
    with pytest.raises(WorkFailed), at_work(KeyError):
        raise KeyError("key")
    with pytest.raises(KeyError), at_work():
        raise KeyError("key")
