"""The recipes of docs/cluster.md: what they start, with stand-ins for the launchers, and what they ask of a cluster."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from benchmarks.ray_pool import MEMORY
from benchmarks.run import parser

yaml = pytest.importorskip("yaml")
ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "docs" / "examples"
FOR_JOBS = 0.7  # of a container's memory: Ray may fill the rest with files
GIB = 1 << 30

# Each writes down how it was called; what they answer is what SLURM and Ray would.
STAND_INS = {
    "ray": '[ "$2" != --head ] || [ -e up ] || { touch up; exit 1; }',  # the first start fails
    "srun": "",
    "getent": 'echo "10.0.0.7 STREAM"; echo "10.0.0.8 STREAM"',
    "squeue": "date --date='2 hours' +%Y-%m-%dT%H:%M:%S",
    "python": 'case $* in *secrets*) echo token;; *) exit "${CODE:-0}";; esac',
}


@pytest.fixture
def slurm(tmp_path, monkeypatch):
    """Runs the script on so many nodes; returns its exit code and the calls of other programs."""
    environment = tmp_path / "rise" / ".venv" / "bin"
    environment.mkdir(parents=True)
    (environment / "activate").touch()
    programs = tmp_path / "programs"
    programs.mkdir()
    for name, does in STAND_INS.items():
        program = programs / name
        program.write_text(f'#!/bin/sh\nprintf "%s\\n" "{name} $*" >> calls\n{does}\n')
        program.chmod(0o755)

    def run(nodes: int, **variables: str) -> tuple[int, list[str]]:
        given = {
            "PATH": f"{programs}{os.pathsep}{os.environ['PATH']}",
            "HOME": str(tmp_path),
            "SLURM_JOB_ID": "1234567",
            "SLURM_JOB_NUM_NODES": str(nodes),
            "SLURM_CPUS_ON_NODE": "32",
            "SLURMD_NODENAME": "node1",
            **variables,
        }
        script = ["bash", str(EXAMPLES / "slurm.sh")]
        code = subprocess.run(script, cwd=tmp_path, env=given, check=False, timeout=60).returncode
        return code, (tmp_path / "calls").read_text().splitlines()

    return run


def test_the_script_for_slurm(slurm):
    code, calls = slurm(3)
    assert code == 0
    heads = [call for call in calls if call.startswith("ray start --head")]
    assert len(heads) == 2 and heads[0] == heads[1]  # tried again, after a failure
    assert {"--node-ip-address=10.0.0.7", "--port=24567", "--num-cpus=32"} <= set(heads[0].split())
    (others,) = [call for call in calls if call.startswith("srun")]
    assert "--nodes=2 --ntasks=2 --exclude=node1" in others
    assert calls[-1] == "ray stop --force"
    (command,) = [call for call in calls if "-m benchmarks.run" in call]
    given = parser().parse_args(shlex.split(command)[3:])
    assert (given.executor, given.ray_address, given.preset) == ("ray", "10.0.0.7:24567", "paper")
    assert 1.7 < given.hours <= 1.75  # of two hours


def test_the_script_for_slurm_on_one_node_ends_as_the_command_does(slurm):
    code, calls = slurm(1, CODE="1")
    assert code == 1
    assert not [call for call in calls if call.startswith("srun")]
    assert calls[-1] == "ray stop --force"


@pytest.mark.skipif(shutil.which("shellcheck") is None, reason="needs shellcheck")
def test_the_script_for_slurm_is_sound():
    command = ["shellcheck", "--severity=warning", str(EXAMPLES / "slurm.sh")]
    found = subprocess.run(command, check=False, capture_output=True, text=True)
    assert not found.returncode, found.stdout


def described() -> tuple[dict[str, Any], dict[str, Any]]:
    volume, job = yaml.safe_load_all((EXAMPLES / "kuberay.yaml").read_text())
    return volume, job["spec"]


def gibibytes(words: str) -> float:
    return float(re.fullmatch(r"(\d+)Gi", words)[1])


def test_the_command_for_kubernetes_is_one_and_writes_to_the_volume():
    volume, job = described()
    command = shlex.split(job["entrypoint"])
    assert command[:3] == ["python", "-m", "benchmarks.run"]
    given = parser().parse_args(command[3:])
    assert (given.executor, given.ray_address) == ("ray", "auto")
    head = job["rayClusterSpec"]["headGroupSpec"]["template"]["spec"]
    (mount,) = head["containers"][0]["volumeMounts"]
    (folder,) = [each for each in head["volumes"] if each["name"] == mount["name"]]
    assert folder["persistentVolumeClaim"]["claimName"] == volume["metadata"]["name"]
    assert given.out.is_relative_to(mount["mountPath"])


def test_a_token_is_asked_for_with_the_version_of_ray_that_knows_it():
    """The operator refuses the one without the other."""
    _, job = described()
    cluster = job["rayClusterSpec"]
    assert cluster["authOptions"] == {"mode": "token"}
    assert f"ray=={cluster['rayVersion']}" in (ROOT / "constraints.txt").read_text().splitlines()


def test_workers_have_memory_for_a_job_on_each_core():
    _, job = described()
    (group,) = job["rayClusterSpec"]["workerGroupSpecs"]
    assert group["minReplicas"] == group["replicas"] == group["maxReplicas"]
    (container,) = group["template"]["spec"]["containers"]
    asked = container["resources"]["requests"]
    assert asked == container["resources"]["limits"]
    assert int(asked["cpu"]) * MEMORY <= FOR_JOBS * gibibytes(asked["memory"]) * GIB
