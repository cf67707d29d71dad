"""The rows of the table. A new one is a line here and, if it measures something new, a function."""

from __future__ import annotations

from functools import partial

from benchmarks.speed import agents, envs, processes
from benchmarks.speed.measure import Row, Target


def at_least(bound: float) -> Target:
    """A ratio, or a figure without peer, that should be large."""
    return Target(bound)


def at_most(bound: float) -> Target:
    """A ratio, or a figure without peer, that should be small."""
    return Target(bound, at_least=False)


_REACH, _PPO, _BARE = "PandaReach-v3", "SB3's PPO.predict", "forward + backward"

# fmt: off
_ROWS = (
    Row("vehicle", "Vehicle through `make`", "steps/s", "CartPole-v1", at_least(0.5), envs.vehicle),
    Row("vehicles", "1,000 vehicles, NumPy", "steps/s", "CartPoleVectorEnv", at_least(1.0), envs.vehicles),
    Row("vehicles-torch", "100,000 vehicles, torch", "steps/s", "NumPy", at_least(1.5), envs.vehicles_torch, 5),
    Row("vehicles-cuda", "Vehicles, torch, GPU", "steps/s", "NumPy", None, envs.vehicles_cuda, 5),
    Row("panda", "Panda in Bullet", "steps/s", _REACH, at_least(1.0), envs.panda),
    Row("arms", "1,000 kinematic Pandas", "steps/s", _REACH, at_least(200), envs.arms),
    Row("predict", "`rise.predict`", "µs", _PPO, at_most(0.3), agents.predict),
    Row("predict-mean", "`rise.predict`, deterministic", "µs", _PPO, at_most(0.3),
        partial(agents.predict, deterministic=True)),
    Row("onnx", "RISE as ONNX", "µs", "", at_most(50), agents.onnx),
    Row("clone-pcbc", "Update of PC-BC", "ms", _BARE, at_most(1.2), partial(agents.cloning, name="pcbc")),
    Row("clone-rise", "Update of RISE", "ms", _BARE, at_most(1.2), partial(agents.cloning, name="rise")),
    Row("workers", "Panda evaluation, 2 workers", "episodes/s", "1 worker", at_least(1.8),
        processes.workers, repeats=3, warm_up=False),
    Row("import", "`import rise_envs`", "s", "import gymnasium", at_most(1.3), processes.imports, 15),
    Row("memory", "Memory of a vehicle", "bytes", "", at_most(400), envs.memory,
        repeats=1, warm_up=False),
    Row("bench", "`make bench`, nothing done", "s", "", at_most(480),
        partial(processes.bench, cold=True), repeats=1, warm_up=False, by_default=False),
    Row("bench-again", "`make bench`, all done", "s", "", at_most(15),
        partial(processes.bench, cold=False), repeats=1, warm_up=False, by_default=False),
)
# fmt: on
ROWS = {row.name: row for row in _ROWS}
