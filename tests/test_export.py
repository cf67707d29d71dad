"""Exported agents: traced NumPy against NumPy, whole files against agents, torch and hand-made cases."""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from rise_agents import agent_class, export, load_agent, make_agent
from rise_agents.export.__main__ import main
from rise_agents.export.graphs import build
from rise_agents.export.pose import traceable
from rise_agents.export.trace import Graph, NotExportable
from rise_agents.forward import Forward
from rise_agents.onnx_policy import OnnxPolicy
from rise_agents.rollout import policy_keys, rollout
from rise_agents.seeds import episode_seeds
from rise_envs.task import task_of

VEHICLE, PANDA = "RISE-GroundVehicle-v0", "RISE-SafePanda-v0"
BRIEF = {
    "rise": {"updates": 40, "vae_updates": 40, "batch_size": 32, "vae_batch_size": 32},
    "pcbc": {"updates": 40},
    "cppo": {},
    "rise-belief": {"updates": 40, "belief_updates": 40, "belief_rows": 2_000, "belief_batch_size": 128},
}


def trained(name, demonstrations, **settings):
    agent = make_agent(name, VEHICLE, {**agent_class(name).BRIEF, **BRIEF[name], **settings}, seed=2)
    return agent.learn(demonstrations if agent.learns_from == "demonstrations" else VEHICLE)


@pytest.fixture(scope="module")
def rise(vehicle_demonstrations):
    return trained("rise", vehicle_demonstrations)


@pytest.fixture(scope="module")
def belief(vehicle_demonstrations):
    return trained("rise-belief", vehicle_demonstrations)


@pytest.fixture(scope="module")
def seen(rise):
    return export.sample(rise)


@pytest.fixture(scope="module")
def file(rise, seen, tmp_path_factory):
    path = tmp_path_factory.mktemp("onnx") / "rise.onnx"
    export.export(rise, path, seen)
    return path


# --- NumPy recorded as a graph ---------------------------------------------------------------------------------


def computed(function, *arrays):
    """What the graph of ``function`` gives for ``arrays`` (B, ·)."""
    graph = Graph()
    traced = [graph.input(f"x{i}", a.shape[1:]) for i, a in enumerate(arrays)]
    graph.output("y", function(*traced))
    session = onnxruntime.InferenceSession(graph.serialised({}, ""))
    return session.run(None, {f"x{i}": a for i, a in enumerate(arrays)})[0]


def set_columns(x):
    x = x.copy()
    x[:, 1:3] -= x[:, :1]
    x[..., -1] += 2.0 * x[..., 0]
    return x


CASES = {
    "arithmetic": lambda x: (x + 1.0) * x / (x * x + 2.0) - np.abs(-x),
    "powers and roots": lambda x: np.sqrt(x**2 + 1.0) + np.exp(-np.abs(x)) + np.sign(x) * np.log1p(np.abs(x)),
    "angles": lambda x: np.sin(x[:, :1]) * np.cos(x[:, 1:]),
    "arcsin": lambda x: np.arcsin(np.clip(x, -1.0, 1.0)),
    "arctan2": lambda x: np.arctan2(x[:, 0], x[:, 1]),
    "hypot and norm": lambda x: np.hypot(x[:, :1], x[:, 1:2]) + np.linalg.norm(x, axis=-1, keepdims=True),
    "choices": lambda x: np.where(x > 0.3, x, np.minimum(np.maximum(x, -0.2), 0.1)),
    "sums": lambda x: x.sum(-1, keepdims=True) * x.mean(-1)[:, None] + np.max(x, axis=-1, keepdims=True),
    "new axes": lambda x: x[:, None] * x[..., None] + x[:, None, 1:2],
    "columns": lambda x: np.concatenate((x[:, [2, 0]], x[:, -1:], x[:, 1][:, None]), -1),
    "shapes": lambda x: x.reshape(len(x), 2, 2).swapaxes(1, 2).reshape(-1, 4),
    "products": lambda x: x.reshape(-1, 2, 2) @ np.stack((x[:, :2], x[:, 2:]), 1),
    "written columns": set_columns,
    "in another type": lambda x: x.astype(np.float32).astype(np.float64),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("rows", [1, 200])
def test_what_is_traced_computes_what_numpy_does(case, rows):
    x = np.random.default_rng(3).normal(size=(rows, 4)) * 1.5
    expected = CASES[case](x)
    given = computed(CASES[case], x)
    assert given.shape == expected.shape and given.dtype == expected.dtype
    np.testing.assert_allclose(given, expected, rtol=1e-12, atol=3e-7 if "arc" in case else 1e-12)


def test_angles_at_the_axes_and_at_the_ends():
    """Where quadrants meet, at the origin, and where arcsin is vertical."""
    x = np.array([[0, 1], [1, 0], [0, -1], [-0.0, -1], [-1, 0], [0, 0], [1e-9, -1], [-1e-9, -1], [1, 1e-12]])
    np.testing.assert_allclose(computed(CASES["arctan2"], x), np.arctan2(x[:, 0], x[:, 1]), atol=3e-7)
    ends = np.array([[1.0, -1.0, 1 - 1e-9, 0.0]])
    np.testing.assert_allclose(computed(CASES["arcsin"], ends), np.arcsin(ends), atol=2e-7)


def test_a_constant_is_stored_once():
    graph = Graph()
    assert graph.constant([1.0, 2.0]) == graph.constant(np.array([1.0, 2.0])) != graph.constant([1, 2])


@pytest.mark.parametrize(
    "function",
    [
        lambda x: x if (x > 0) else -x,
        lambda x: np.arccosh(x),
        lambda x: np.fft.fft(x),
        lambda x: x**3,
        lambda x: x[x > 0],
        lambda x: np.zeros(4) + np.asarray(x),
        lambda x: np.repeat(x, 2, 0),
    ],
)
def test_what_has_no_form_is_refused(function):
    with pytest.raises(NotExportable):
        function(Graph().input("x", (4,)))


def test_frames_are_recognised_or_refused():
    for env_id in (VEHICLE, PANDA):
        task = task_of(env_id)
        states = np.random.default_rng(1).normal(size=(5, task.state_size))
        for ours, known in zip(traceable(task).pose(states), task.pose(states), strict=True):
            np.testing.assert_allclose(np.broadcast_to(ours, known.shape), known, atol=1e-15)
    task = task_of(VEHICLE)
    with pytest.raises(NotExportable, match="rotation"):
        traceable(replace(task, pose=lambda s: (s[:, :2], task.pose(2 * s)[1])))
    with pytest.raises(NotExportable, match="place"):
        traceable(replace(task, pose=lambda s: (s[:, :2] + 1.0, task.pose(s)[1])))


# --- whole files -----------------------------------------------------------------------------------------------

KINDS = [
    *[(name, {"frame": frame}) for name in ("rise", "pcbc") for frame in ("world", "body", "features")],
    *[("rise", {"average": 3}), ("rise", {"posterior": "mean"}), ("pcbc", {"loss": "nll", "hidden": (32,)})],
    *[("rise-belief", {"frame": "body", "margin": 0.5}), ("rise-belief", {}), ("cppo", {})],
    ("cppo", {"frame": "features"}),
]


@pytest.mark.parametrize(("name", "settings"), KINDS, ids=lambda part: str(part))
def test_a_file_acts_as_its_agent_and_as_torch(vehicle_demonstrations, seen, tmp_path, name, settings):
    agent = trained(name, vehicle_demonstrations, **settings)
    found = export.export(agent, tmp_path / "agent.onnx", seen)
    assert found.count == 1_000 and 0 < found.largest < 2e-5  # what float32 can do
    assert (found.agent <= 2e-5 * found.half_range).all()


def test_the_arm_s_frame(tmp_path):
    from rise_agents.demonstrations import generate

    demonstrations = generate("RISE-SafePandaKinematic-v0", "cbf", 4)
    settings = {**BRIEF["rise"], "frame": "features"}
    agent = make_agent("rise", "RISE-SafePandaKinematic-v0", settings).learn(demonstrations)
    assert export.export(agent, tmp_path / "arm.onnx").largest < 2e-5


@pytest.mark.parametrize("kind", ["rise", "belief"])
def test_episodes_end_as_with_the_agent(request, tmp_path, seen, kind):
    agent = request.getfixturevalue(kind)
    export.export(agent, tmp_path / "agent.onnx", seen)
    policy, seeds = OnnxPolicy(tmp_path / "agent.onnx"), episode_seeds("validation", 1, 0, 24)
    ours, theirs = (
        rollout(each, VEHICLE, seeds, noise_level=1.0, deterministic=False)[0] for each in (policy, agent)
    )
    np.testing.assert_array_equal(ours.steps, theirs.steps)
    np.testing.assert_allclose(ours.min_clearance, theirs.min_clearance, atol=1e-2)


def test_draws_are_the_agent_s(rise, file, seen):
    """A file without key, or with other keys, acts otherwise; with the agent's keys, as the agent does."""
    policy = OnnxPolicy(file)
    observation, _ = next(iter(seen))
    keys = policy_keys(range(50))
    state = policy.initial_state(keys)
    for step in range(3):
        action, state = policy.predict(observation, state)
        assert (state[0] == keys).all() and (state[1] == step + 1).all()
    expected, _ = rise.predict(observation, (keys, np.full(50, 2, np.uint64)))
    np.testing.assert_allclose(action, expected, atol=1e-5)
    other, _ = policy.predict(observation, policy.initial_state(keys + np.uint64(1)))
    assert np.abs(other - action).max() > 1e-3


def test_single_observations_and_any_batch(rise, file, seen):
    policy = OnnxPolicy(file)
    observation, _ = next(iter(seen))
    for rows in (1, 7, 50):
        part = {key: value[:rows] for key, value in observation.items()}
        action, state = policy.predict(part, deterministic=True)
        assert action.shape == (rows, 2) and action.dtype == np.float32 and state is None
        np.testing.assert_allclose(action, rise.predict(part, deterministic=True)[0], atol=1e-5)
    alone, _ = policy.predict({key: value[0] for key, value in observation.items()}, deterministic=True)
    np.testing.assert_allclose(alone, action[0], atol=1e-5)
    with pytest.raises(ValueError, match="obstacle"):
        policy.predict({**observation, "obstacle": np.full((50, 5), np.nan)})


def test_actions_lie_within_bounds_whatever_is_read(file, seen):
    session = OnnxPolicy(file).session
    observation, _ = next(iter(seen))
    rows = {key: observation[key] for key in ("observation", "desired_goal")}
    for factor in (1e6, -1e6):
        given = {
            **rows,
            "obstacle": factor * observation["obstacle"],
            "epsilon": np.ones((50, 5), np.float32),
        }
        (action,) = session.run(["action"], given)
        assert (action >= [0.0, -1.5]).all() and (action <= [2.5, 1.5]).all()


def test_a_belief_begins_anew_where_an_episode_does(belief, tmp_path, seen):
    export.export(belief, tmp_path / "belief.onnx", seen)
    policy = OnnxPolicy(tmp_path / "belief.onnx")
    (first, _), (second, _), *_ = seen
    fresh, _ = policy.predict(second)
    _, state = policy.predict(first)
    later, after = policy.predict(second, state)
    assert (after[3] == 2).all() and np.abs(later - fresh).max() > 1e-4
    begun = np.arange(50) < 10
    mixed, after = policy.predict(second, state, begun)
    np.testing.assert_allclose(mixed, np.where(begun[:, None], fresh, later), atol=1e-5)
    assert (after[3] == np.where(begun, 1, 2)).all()


def test_the_file_says_what_it_is(rise, file):
    policy, model = OnnxPolicy(file), onnx.ModelProto.FromString(file.read_bytes())
    inputs, outputs = (json.loads(policy.metadata[key]) for key in ("inputs", "outputs"))
    assert set(inputs) == {node.name for node in model.graph.input} == {*task_of(VEHICLE).shapes, "epsilon"}
    assert inputs["obstacle"] == {
        "shape": ["batch", 5],
        "type": "float64",
        "is": "reading c: position, velocity and radius of each obstacle, SI units, noisy or not",
    }
    assert set(outputs) == {"action"} and (policy.name, policy.env_id) == ("rise", VEHICLE)
    assert json.loads(policy.metadata["settings"])["latent"] == rise.config.latent
    assert {node.type.tensor_type.shape.dim[0].dim_param for node in model.graph.input} == {"batch"}


# --- what is refused -------------------------------------------------------------------------------------------


def test_a_file_that_acts_otherwise_is_not_kept(rise, seen, tmp_path, monkeypatch):
    path, layers = tmp_path / "rise.onnx", Forward.layers
    path.write_bytes(b"old")
    monkeypatch.setattr(Forward, "layers", lambda self: [(1.01 * w, b) for w, b in layers(self)])
    with pytest.raises(ValueError, match="differs from the agent"):
        export.export(rise, path, seen)
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


def test_agents_and_settings_without_a_form(vehicle_demonstrations, belief, tmp_path):
    belief.save(tmp_path / "belief.rise")
    shielded = load_agent(tmp_path / "belief.rise", settings={"shield": True})
    with pytest.raises(NotExportable, match="shield=false"):
        build(shielded)
    with pytest.raises(NotExportable, match="frame='raw'"):
        build(trained("cppo", None, frame="raw"))
    belief_like = type("Other", (), {"name": "other", "env_id": VEHICLE})()
    with pytest.raises(NotExportable, match="'other' cannot be exported"):
        build(belief_like)


def foreign(metadata, elsewhere=""):
    """A model that hands its input on; or one whose weights lie in another file."""
    x = helper.make_tensor_value_info("x", TensorProto.DOUBLE, ["batch", 3])
    y = helper.make_tensor_value_info("action", TensorProto.DOUBLE, ["batch", 3])
    if elsewhere:
        weights = numpy_helper.from_array(np.ones(3), "w")
        weights.ClearField("raw_data")
        weights.data_location = TensorProto.EXTERNAL
        for key, value in (("location", elsewhere), ("length", "24")):
            weights.external_data.add(key=key, value=value)
        graph = helper.make_graph([helper.make_node("Add", ["x", "w"], ["action"])], "g", [x], [y], [weights])
    else:
        graph = helper.make_graph([helper.make_node("Identity", ["x"], ["action"])], "g", [x], [y])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    helper.set_model_props(model, metadata)
    return model.SerializeToString()


def test_files_that_are_none_of_ours(file, tmp_path, monkeypatch, capfd):
    metadata = OnnxPolicy(file).metadata
    monkeypatch.chdir(tmp_path)
    (tmp_path / "weights").write_bytes(np.ones(3).tobytes())
    path = tmp_path / "other.onnx"
    with pytest.raises(ValueError, match="cannot be read"):
        OnnxPolicy(path)
    for content, says in [
        (b"", "no ONNX file"),
        (b"garbage" * 100, "no ONNX file"),
        (file.read_bytes()[:-100], "no ONNX file"),
        *[(foreign(metadata, name), "no ONNX file") for name in ("weights", str(tmp_path / "weights"))],
        (foreign({}), "no exported agent"),
        (foreign(metadata), "inputs"),
        (foreign({**metadata, "format": "2"}), "format"),
        (foreign({**metadata, "env": "CartPole-v1"}), "no exported agent"),
        (foreign({**metadata, "draws": "[]"}), "no exported agent"),
    ]:
        path.write_bytes(content)
        with pytest.raises(ValueError, match=says):
            OnnxPolicy(path)
    assert capfd.readouterr() == ("", "")


def test_the_command_writes_beside_the_checkpoint(rise, tmp_path, capsys):
    rise.save(tmp_path / "agent.rise")
    assert main([str(tmp_path / "agent.rise"), "--onnx", "--set", "posterior=mean"]) == 0
    assert "1,000 observations" in capsys.readouterr().out
    assert json.loads(OnnxPolicy(tmp_path / "agent.onnx").metadata["settings"])["posterior"] == "mean"


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["{}"], 2, "name the format: --onnx"),
        (["{}", "--onx"], 2, "did you mean '--onnx'"),
        (["nowhere.rise", "--onnx"], 2, "does not exist"),
        (["{}", "--onnx", "--set", "posterior"], 2, "takes KEY=VALUE"),
        (["{}", "--onnx", "--set", "beta=1"], 2, "no setting that a trained rise acts by"),
        (["{}", "--onnx", "--env", PANDA], 2, "was trained on"),
        (["{}", "--onnx", "--out", "{}/below.onnx"], 1, "agent.rise"),
    ],
)
def test_wrong_arguments_are_told_in_one_line(rise, tmp_path, capsys, arguments, code, says):
    rise.save(tmp_path / "agent.rise")
    assert main([text.format(tmp_path / "agent.rise") for text in arguments]) == code
    told = capsys.readouterr().err
    assert told.startswith("rise_agents.export: ") and says in told and told.count("\n") == 1


@pytest.mark.parametrize("missing", ["onnx", "onnxruntime"])
def test_a_missing_package_is_told(rise, tmp_path, monkeypatch, capsys, missing):
    monkeypatch.setitem(sys.modules, missing, None)
    rise.save(tmp_path / "agent.rise")
    assert main([str(tmp_path / "agent.rise"), "--onnx"]) == 1
    assert "pip install 'rise-suite[onnx]'" in capsys.readouterr().err
