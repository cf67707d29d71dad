"""Names of users: registered from files outside of the package, in this process and in workers; the page about it."""

from __future__ import annotations

import importlib
import json
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest
import toy_envs

import rise_agents
import rise_envs
from benchmarks import cli, report
from benchmarks import run as benchmark
from benchmarks.policies import Random
from benchmarks.results import read_rows
from benchmarks.trajectories import draws
from benchmarks.trajectories import play as play_episode
from rise_agents import AGENTS, make_agent, play, register_agent
from rise_agents.demonstrations import __main__ as demonstrations
from rise_agents.demonstrations import generate
from rise_agents.demonstrations.dataset import OBSERVATIONS
from rise_agents.experts import make_expert, register_expert
from rise_agents.filters import FILTERS, make_filter, register_filter
from rise_agents.plugins import import_modules, imported
from rise_agents.pool import Pool
from rise_agents.rollout import check_judged, rollout
from rise_agents.seeds import episode_seeds
from rise_agents.testing import check_agent
from rise_envs import register_env, register_noise
from rise_envs.noise import corrupt
from rise_envs.testing import ContractError, check_env, checks_of

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "docs" / "examples"
VEHICLE = "RISE-GroundVehicle-v0"
PAGE = (ROOT / "docs" / "own.md").read_text()
COMMANDS = [
    command
    for block in re.findall(r"^```sh\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    for command in block.replace("\\\n", " ").splitlines()
]
pytestmark = pytest.mark.usefixtures("own_names")


def example(*names):
    import_modules([str(EXAMPLES / f"{name}.py") for name in names])


# --- the examples ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("module", "env_id"), [("omni_base", "OmniBase-v0"), ("calm_pendulum", "CalmPendulum-v0")]
)
def test_environments_keep_the_contract(module, env_id):
    example(module)
    check_env(env_id, episodes=12)


def test_an_environment_without_a_description_has_the_checks_of_any():
    example("omni_base", "calm_pendulum")
    assert set(checks_of("CalmPendulum-v0")) < set(checks_of("OmniBase-v0"))


def test_the_omni_base_moves_as_it_should():
    """A hand-made step: straight lines, and the least distance on the way, not at its ends."""
    example("omni_base")
    env = gym.make("OmniBase-v0").unwrapped
    env.reset(seed=0)
    env._at, env._disc, env._velocity = np.array([0.0, 0.0]), np.array([[[0.075, 1.0]]]), np.zeros((1, 1, 2))
    env._radius[:] = 0.5
    observation, _, _, _, info = env.step(np.array([1.5, 0.0], np.float32))
    np.testing.assert_allclose(observation["observation"], [0.15, 0.0])
    assert info["clearance"] == pytest.approx(1.0 - 0.5 - 0.3)  # halfway, at x = 0.075
    assert info["cost"] == 0.0


def test_the_omni_base_s_expert_is_one():
    example("omni_base")
    episodes, _ = rollout(
        make_expert("barrier", "OmniBase-v0"), "OmniBase-v0", episode_seeds("validation", 0, 0, 200)
    )
    assert episodes.reached.mean() > 0.95


@pytest.mark.parametrize(
    ("agent", "env_id", "config"),
    [
        ("neighbours", "OmniBase-v0", {}),
        ("pcbc", "OmniBase-v0", {}),
        ("cppo", "CalmPendulum-v0", {"frame": "raw"}),
    ],
)
def test_agents_keep_the_contract(agent, env_id, config):
    example("omni_base", "calm_pendulum", "neighbours")
    check_agent(agent, env_id, config=config)


def test_neighbours_with_one_neighbour_repeats_what_was_shown(vehicle_demonstrations):
    example("neighbours")
    agent = make_agent("neighbours", VEHICLE, {"neighbours": 1}).learn(vehicle_demonstrations)
    action, _ = agent.predict(vehicle_demonstrations.subsample(50))
    step = -(-len(vehicle_demonstrations.actions) // 50)
    np.testing.assert_allclose(action, vehicle_demonstrations.actions[::step], atol=1e-6)


def test_coloured_noise_has_the_law_that_it_states():
    example("coloured")
    readings, keys = np.zeros((2_000, 6, 2)), np.arange(2_000, dtype=np.uint64)
    noisy = corrupt("coloured:0.8:0.5", readings, [1.0, 2.0], keys)
    np.testing.assert_allclose(noisy.std(0), np.broadcast_to([0.5, 1.0], (6, 2)), rtol=0.08)
    for lag in (1, 3):
        ends = noisy[:, 5, 0], noisy[:, 5 - lag, 0]
        assert np.corrcoef(*ends)[0, 1] == pytest.approx(0.8**lag, abs=0.05)
    alone = corrupt("coloured:0.8:0.5", readings[:1], [1.0, 2.0], keys[7:8])
    np.testing.assert_array_equal(alone[0], noisy[7])
    env = rise_envs.ObservationNoise(gym.make(VEHICLE), "coloured", noise_level=0.0)
    observation, info = env.reset(seed=0)
    np.testing.assert_array_equal(observation["obstacle"], info["clean_observation"]["obstacle"])


def test_smoothing_takes_noise_away_and_leaves_true_readings():
    """An obstacle that stands still, read a few times: the average is nearer to it than a reading is."""
    example("smoothing")

    class Seen:
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            return observation["obstacle"], None

    rng, true = np.random.default_rng(0), np.array([3.0, 1.0, 0.0, 0.0, 1.0])
    rows = {"observation": np.zeros((500, 3)), "desired_goal": np.zeros((500, 2))}
    for level, gain in ((1.0, 0.65), (0.0, 1e-12)):
        behind, state = make_filter("smooth", Seen(), VEHICLE, level), None
        for _ in range(20):
            reading = true + level * rng.normal(size=(500, 5))
            seen, state = behind.predict({**rows, "obstacle": reading}, state)
        assert np.abs(seen - true)[:, 2:].mean() <= gain * np.abs(rng.normal(size=9_999)).mean()


# --- registries ------------------------------------------------------------------------------------------------


class NoAgent:
    name, learns_from, evaluate_deterministic = "no-agent", "demonstrations", True

    def predict(self, observation, state=None, episode_start=None, deterministic=False): ...


@dataclass(frozen=True)
class Settings:
    pass


class Dreamer(NoAgent):
    name, learns_from, Config, PRESETS, BRIEF = "dreamer", "dreams", Settings, {}, {}

    def learn(self, source, progress=None, resume=None): ...
    def save(self, path): ...
    def from_checkpoint(self): ...


class NoNoise(rise_envs.NoiseModel):
    def at(self, level):
        return self


class NoEnv:
    def reset(self): ...
    def step(self): ...


@pytest.mark.parametrize(
    ("register", "message"),
    [
        (
            lambda: register_agent("no-agent", NoAgent),
            r"lacks Config, PRESETS, BRIEF, learn, save, from_checkpoint",
        ),
        (
            lambda: register_agent("rise", Dreamer),
            r"'rise' is registered already, as 'rise_agents.rise:Rise'",
        ),
        (lambda: register_agent("dream", Dreamer), r"calls itself 'dreamer'"),
        (
            lambda: register_agent("dreamer", Dreamer),
            r"learns_from must be 'demonstrations' or 'environment'",
        ),
        (lambda: register_agent("expert-mine", Dreamer), r"mean something else"),
        (lambda: register_agent("a+b", Dreamer), r"letters, digits"),
        (lambda: register_agent("mine", "nowhere:Mine"), r"cannot find 'nowhere:Mine'.*nowhere"),
        (lambda: register_agent("mine", f"{__name__}:Mine"), r"cannot find .*Mine"),
        (lambda: register_agent("mine", "json:loads"), r"is no class"),
        (lambda: register_agent("mine", "mine"), r"give a class or 'module:Class', got 'mine'"),
        (lambda: register_noise("none", NoNoise), r"lacks reset, __call__"),
        (lambda: register_noise("step", rise_envs.noise.Drift), r"registered already"),
        (lambda: register_noise("env", NoEnv), r"lacks at, __call__"),
        (lambda: register_env("Mine-v0", NoEnv, 10), r"is no gymnasium.Env"),
        (lambda: register_env("Mine", gym.Env, 10), r"ends with a version, as in Mine-v0"),
        (lambda: register_env("lab/Mine-v0", gym.Env, 10), r"letters, digits"),
        (lambda: register_env(VEHICLE, gym.Env, 10), r"registered already, as 'rise_envs.ground_vehicle:"),
        (lambda: register_env("CartPole-v1", gym.Env, 10), r"registered already, as 'gymnasium.envs"),
        (lambda: register_env("Mine-v0", gym.Env, 0), r"max_episode_steps must be a whole number"),
        (
            lambda: register_env("Mine-v0", gym.Env, 5, stands_in_for="Theirs-v0"),
            r"cannot stand in for 'Theirs-v0'",
        ),
        (lambda: register_expert(VEHICLE, "none", NoEnv), r"lacks predict"),
        (
            lambda: register_expert("RISE-GroundVehicl-v0", "a", NoAgent),
            r"did you mean 'RISE-GroundVehicle-v0'",
        ),
        (lambda: register_expert(VEHICLE, "cbf", NoAgent), r"registered already"),
        (lambda: register_filter("true", NoAgent), r"mean something else"),
        (lambda: register_filter("none", NoAgent), r"lacks initial_state, label"),
    ],
)
def test_what_cannot_be_used_is_refused_when_it_is_registered(register, message):
    before = [dict(known) for known in (AGENTS, FILTERS, rise_envs.ENVS, rise_envs.NOISE_MODELS)]
    with pytest.raises(ValueError, match=message):
        register()
    assert before == [AGENTS, FILTERS, rise_envs.ENVS, rise_envs.NOISE_MODELS]
    assert "Mine-v0" not in gym.registry


def test_a_class_that_other_processes_cannot_find_is_refused():
    class Hidden(rise_envs.noise.StepNoise):
        pass

    with pytest.raises(ValueError, match="top level of a module"):
        register_noise("hidden", Hidden)


def test_the_same_entry_again_is_welcome():
    example("neighbours", "omni_base", "coloured", "smoothing")
    register_agent("neighbours", "neighbours:Neighbours")
    register_env("OmniBase-v0", sys.modules["omni_base"].OmniBase, 150)
    register_noise("coloured", sys.modules["coloured"].Coloured)
    register_filter("smooth", "smoothing:Smooth")


def test_who_registers_an_environment_again_can_change_its_steps():
    example("omni_base")
    base, before = sys.modules["omni_base"].OmniBase, rise_envs.ENVS["OmniBase-v0"]
    try:
        register_env("OmniBase-v0", base, 7)
        assert rise_envs.ENVS["OmniBase-v0"][2] == gym.spec("OmniBase-v0").max_episode_steps == 7
    finally:
        register_env("OmniBase-v0", base, before[2])


def test_a_class_that_breaks_the_contract_is_told(vehicle_demonstrations):
    """An environment that says nothing of velocities; an agent whose rows depend on their neighbours."""
    example("omni_base", "neighbours")
    module, neighbours = sys.modules["omni_base"], sys.modules["neighbours"].Neighbours

    class Still(module.OmniBase):
        def _observation(self):
            parts = super()._observation()
            parts["obstacle"][2:4] = 0.0
            return parts

    class Close(neighbours):
        def predict(self, observation, *args, **kwargs):
            action, state = super().predict(observation, *args, **kwargs)
            return action - action.mean(0) * (action.ndim > 1) * 0.01, state

    module.Still, sys.modules["neighbours"].Close = Still, Close
    Still.__module__, Still.__qualname__ = "omni_base", "Still"
    Close.__module__, Close.__qualname__, Close.name = "neighbours", "Close", "close"
    register_env("Still-v0", Still, 150)
    with pytest.raises(ContractError, match=r"(?s)Still-v0: task description: .* coming step"):
        check_env("Still-v0", episodes=5)
    register_agent("close", Close)
    with pytest.raises(ContractError, match=r"close in .*: rows of a batch"):
        check_agent("close", VEHICLE, vehicle_demonstrations)
    with pytest.raises(ValueError, match="not registered"):
        check_env("CartPole-v1")


# --- --import --------------------------------------------------------------------------------------------------

OF_OURS_ALONE = {"upload", "speed", "fidelity", "faults"}


@pytest.mark.parametrize("name", sorted(cli.COMMANDS.keys() - OF_OURS_ALONE))
def test_every_command_that_looks_names_up_imports(name, tmp_path, capsys):
    program = importlib.import_module(cli.COMMANDS[name].module)
    needed = [
        word
        for action in program.parser()._actions
        if action.required
        for word in (*action.option_strings[:1], str(tmp_path))
    ]
    module = str(EXAMPLES / "neighbours.py")
    program.parser().parse_args([*needed, "--import", module, "--import", "json"])
    assert "neighbours" in AGENTS
    assert imported() == (module, "json")
    assert program.main([*needed, "--import", "no_such_module"]) == 2
    error = capsys.readouterr().err
    assert ": --import no_such_module: there is no such module" in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("def f(:\n", r"SyntaxError: .*"),
        ("1 / 0\n", r"ZeroDivisionError: division by zero \(.*mine\.py, line 1\)"),
        (
            "import nothing_there\n",
            r"ModuleNotFoundError: No module named 'nothing_there' \(.*mine\.py, line 1\)",
        ),
        ("import sys\nsys.exit('no')\n", r"SystemExit: no"),
        ("from rise_agents import register_agent\nregister_agent('rise', int)\n", r"'int' lacks|lacks name"),
    ],
)
def test_a_file_that_fails_says_where(text, message, tmp_path):
    (tmp_path / "mine.py").write_text(text)
    with pytest.raises(
        ValueError, match=f"--import .*mine.py: {message}|--import .*: ValueError: .*{message}"
    ):
        import_modules([str(tmp_path / "mine.py")])
    assert imported() == ()


def test_files_that_cannot_be_found_by_their_name(tmp_path):
    for name, message in (
        ("json.py", "'json' is another module"),
        ("a-b.py", "letters, digits and '_' only"),
    ):
        (tmp_path / name).touch()
        with pytest.raises(ValueError, match=message):
            import_modules([str(tmp_path / name)])
    for name, message in (("nowhere.py", "no file"), ("a/b", "names of modules"), ("\0.py", "no file")):
        with pytest.raises(ValueError, match=message):
            import_modules([name])


def test_a_folder_is_no_module(tmp_path, monkeypatch):
    (tmp_path / "examples_of_my_lab").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=r"--import examples_of_my_lab: .* is a folder without __init__\.py"):
        import_modules(["examples_of_my_lab"])


def test_a_module_is_found_in_the_working_directory(tmp_path, monkeypatch):
    (tmp_path / "of_my_lab.py").write_text("import helper_of_my_lab\n")
    (tmp_path / "helper_of_my_lab.py").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place])  # as a console script has it
    import_modules(["of_my_lab"])
    assert imported() == ("of_my_lab",)
    sys.modules.pop("helper_of_my_lab")


def known_names(tell):
    """What a worker process knows."""
    return sorted(set(rise_agents.AGENTS) | set(rise_envs.ENVS))


def test_workers_import_what_their_parent_did():
    example("omni_base", "neighbours")
    with Pool(1) as pool:
        pool.start(0, known_names)
        while not (ended := pool.wait()):
            pass
    assert {"neighbours", "OmniBase-v0"} <= set(ended[0].result)


def test_workers_record_in_an_environment_of_one_s_own():
    example("omni_base")
    alone, shared = (generate("OmniBase-v0", "barrier", 30, workers=workers) for workers in (1, 2))
    assert alone.digest() == shared.digest()


def test_a_run_with_an_agent_an_environment_and_noise_of_one_s_own(tmp_path):
    """In a process of its own, with workers: everything of the user's is there, and in the record of the run."""
    modules = [str(EXAMPLES / f"{name}.py") for name in ("omni_base", "neighbours", "coloured", "smoothing")]
    command = [sys.executable, "-m", "benchmarks.run", "--import", *modules[:2], "--import", *modules[2:]]
    command += [
        "--envs",
        "OmniBase-v0",
        "--expert",
        "barrier",
        "--agents",
        "neighbours",
        "random",
        "--preset",
        "smoke",
    ]
    command += [
        "--filter",
        "smooth",
        "--noise-model",
        "coloured:0.9",
        "--workers",
        "2",
        "--out",
        str(tmp_path / "run"),
    ]
    done = subprocess.run([*command, "--no-videos"], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    rows = read_rows(tmp_path / "run" / "episodes.parquet").to_pydict()
    assert set(rows["agent"]) == {"neighbours", "neighbours+smooth", "random"}
    assert set(rows["noise_model"]) == {"coloured:0.9"}
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert all(module in record["command"] for module in modules)
    assert "behind an average" in (tmp_path / "run" / "summary.md").read_text()
    folder = [str(tmp_path / "run")]
    assert report.main([*folder, "--out", str(tmp_path / "again"), "--import", *modules]) == 0
    for name in ("summary.csv", "summary.md"):
        assert (tmp_path / "again" / name).read_text() == (tmp_path / "run" / name).read_text()


# --- bad combinations ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--envs", "CalmPendulum-v0", "--agents", "cppo"], r"settings of cppo: .*frame='raw'"),
        (["--envs", "CalmPendulum-v0", "--agents", "rise"], r"no expert for environment 'CalmPendulum-v0'"),
        (["--envs", "CalmPendulum-v0", "--agents", "random+kalman"], r"describes no task"),
        (["--envs", "OmniBase-v0", "--agents", "rise"], r"unknown expert 'mixture': known: barrier"),
    ],
)
def test_what_an_environment_of_one_s_own_does_not_offer(arguments, message, tmp_path, capsys):
    modules = [str(EXAMPLES / f"{name}.py") for name in ("omni_base", "calm_pendulum")]
    assert benchmark.main([*arguments, "--import", *modules, "--out", str(tmp_path / "run")]) == 2
    error = capsys.readouterr().err
    assert re.search(message, error) and error.count("\n") == 1


class Broken(toy_envs.Walk):
    def step(self, action):
        raise LookupError("no wheels")


class Judged(toy_envs.Walk):
    """A walk with all that episodes are judged by."""

    COST: ClassVar = 0.0

    def __init__(self, render_mode=None):
        super().__init__()

    def step(self, action):
        *rest, info = super().step(action)
        return *rest, info | {"cost": self.COST, "clearance": 1.0, "is_success": False}


class Paid(Judged):
    COST = -1.0


class Lost(Judged):
    COST = np.nan


class Free(Judged):
    COST = None


class Flat(Judged):
    def step(self, action):
        observation, *rest = super().step(action)
        return observation[:1], *rest


class Later(Judged):
    """Its cost is none in its second step only."""

    def step(self, action):
        self.COST = getattr(self, "after", 0.0)
        self.after = -1.0
        return super().step(action)


def test_a_cost_that_is_none_is_found_in_later_steps_too():
    register_env("Mine-v0", Later, 20)
    check_judged("Mine-v0")
    with pytest.raises(
        ValueError, match=r"Mine-v0: the cost of a step must be a finite number ≥ 0, got -1.0"
    ):
        rollout(Random("Mine-v0"), "Mine-v0", [0, 1])


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (toy_envs.Walk, r"Mine-v0 gives no info\['clearance'\], no info\['is_success'\]"),
        (Broken, r"Mine-v0 fails in its first step: LookupError: no wheels"),
        (Paid, r"Mine-v0: the cost of a step must be a finite number ≥ 0, got -1.0"),
        (Lost, r"Mine-v0: the cost of a step must be a finite number ≥ 0, got nan"),
        (Free, r"Mine-v0: the cost of a step must be a finite number ≥ 0, got None"),
        (Flat, r"Mine-v0 gives observation of shape \(1,\), its observation_space says \(2,\)"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*not within the observation space")
def test_an_environment_whose_episodes_cannot_be_judged_is_refused_at_once(kind, message, tmp_path, capsys):
    register_env("Mine-v0", kind, 20)
    with pytest.raises(ValueError, match=message.partition(" fails")[0]):
        check_judged("Mine-v0")
    arguments = ["--envs", "Mine-v0", "--agents", "random", "--out", str(tmp_path)]
    assert benchmark.main(arguments) == 2
    error = capsys.readouterr().err
    assert re.search(message, error) and error.count("\n") == 1


class Undrawn(Judged):
    def __init__(self):
        super(Judged, self).__init__(dict_space=True)
        self.observation_space = gym.spaces.Dict(
            dict.fromkeys(OBSERVATIONS, gym.spaces.Box(-50, 50, (2,), float))
        )

    def _observe(self):
        return dict.fromkeys(OBSERVATIONS, self.place)


def test_an_environment_that_draws_nothing_needs_no_render_mode():
    register_env("Mine-v0", Undrawn, 20)
    assert len(play_episode(lambda observation: np.zeros(2), "Mine-v0", 3).action) == 7


class Wrapped(gym.Wrapper):
    """What exists already, with what episodes are judged by."""

    def __init__(self, render_mode=None):
        super().__init__(gym.make("Pendulum-v1", render_mode=render_mode))

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        info |= {"cost": 0.0, "clearance": 1.0, "is_success": False}
        return observation, reward, terminated, truncated, info


def test_a_wrapper_is_an_environment_of_one_s_own():
    register_env("Mine-v0", Wrapped, 20)
    check_env("Mine-v0", episodes=2)
    assert draws("Mine-v0")
    check_judged("Mine-v0")


class Lever(toy_envs.Lever):
    action_space = gym.spaces.Discrete(3, start=5)

    def step(self, action):
        *rest, info = super().step(action)
        return *rest, {**info, "clearance": float(action), "is_success": True}


def test_chance_plays_discrete_actions():
    register_env("Mine-v0", Lever, 20)
    policy = Random("Mine-v0")
    episodes, _ = rollout(policy, "Mine-v0", range(300), deterministic=False)
    values, counts = np.unique(episodes.min_clearance, return_counts=True)
    assert values.tolist() == [5, 6, 7] and (counts > 60).all()
    again, _ = rollout(policy, "Mine-v0", range(300), deterministic=False, slots=7)
    np.testing.assert_array_equal(again.min_clearance, episodes.min_clearance)


# --- the page --------------------------------------------------------------------------------------------------


def runs(command):
    """Module and arguments of a command of the page that starts a module of ours."""
    words = shlex.split(command)
    return (words[2], words[3:]) if words[:2] == ["python", "-m"] else ("", words)


@pytest.mark.parametrize("command", [command for command in COMMANDS if runs(command)[0]])
def test_commands_of_the_page_are_accepted(command, monkeypatch, tmp_path):
    name, arguments = runs(command)
    monkeypatch.chdir(ROOT)
    if name == "benchmarks.run":
        benchmark.plan_of(benchmark.parser().parse_args(arguments))
    else:
        arguments[arguments.index("--out") + 1] = str(tmp_path)
        {"rise_agents.demonstrations": demonstrations, "rise_agents.play": play}[name].checked(arguments)


@pytest.mark.slow
@pytest.mark.parametrize(
    "command", [command for command in COMMANDS if runs(command)[0] and ".play" not in command]
)
def test_commands_of_the_page_do_their_work(command, tmp_path):
    name, arguments = runs(command)
    if "--out" in arguments:
        at = arguments.index("--out")
        del arguments[at : at + 2]
    whole = [sys.executable, "-m", name, *arguments, "--out", str(tmp_path / "out")]
    done = subprocess.run(whole, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr


ALONE = """
import sys

before = set(sys.modules)

class Others:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in sys.argv[1].split():
            raise ImportError(f"{name} is not part of this project")

sys.meta_path.insert(0, Others())
import gymnasium as gym
import rise_envs
from rise_envs import ObservationNoise, VectorObservationNoise

env = ObservationNoise(gym.make("CartPole-v1"), "step+dropout:0.2+delay:1", noise_scale=0.1)
env.reset(seed=0)
env.step(env.action_space.sample())
envs = VectorObservationNoise(gym.make_vec("CartPole-v1", 3, vectorization_mode="sync"), "drift", noise_scale=0.1)
envs.reset(seed=0)
envs.step(envs.action_space.sample())
new = {name: module for name, module in sys.modules.items() if name not in before}
roots = {name.partition(".")[0] for name, module in new.items() if getattr(module, "__file__", None)}
roots -= set(sys.stdlib_module_names)
print(*sorted(root for root in roots if not root.startswith("_sysconfigdata")))
"""


def test_the_noise_wrapper_alone_needs_gymnasium_and_numpy():
    """With everything else that this package depends on out of reach, and nothing else of it imported."""
    import tomllib

    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    names = {re.split(r"[<>=\[ ]", text)[0].replace("-", "_") for text in declared}
    others = names - {"gymnasium", "numpy", "array_api_compat"} | {
        "pybullet",
        "pygame",
        "PIL",
        "rise_agents",
        "benchmarks",
    }
    done = subprocess.run(
        [sys.executable, "-c", ALONE, " ".join(others)], capture_output=True, text=True, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    ours = {"gymnasium", "numpy", "array_api_compat", "rise_envs"}
    # What Gymnasium itself imports, and NumPy's f2py where it is installed.
    theirs = {"cloudpickle", "farama_notifications", "typing_extensions", "charset_normalizer"}
    assert ours <= set(done.stdout.split()) <= ours | theirs
