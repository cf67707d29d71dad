"""An interrupted training ends in the weights of one that was not: every registered agent, bit for bit."""

from __future__ import annotations

import numpy as np
import pytest

from rise_agents import AGENTS, agent_class, archive, make_agent
from rise_agents.checkpoint import CheckpointError
from rise_agents.resume import Resume

VEHICLE = "RISE-GroundVehicle-v0"


class Interrupted(Exception):
    pass


def until(share: float):
    def progress(done: float, figures: dict[str, float]) -> None:
        if done >= share:
            raise Interrupted

    return progress


def learner(name: str, **changed: object):
    return make_agent(name, VEHICLE, {**agent_class(name).BRIEF, **changed}, seed=3)


def source_of(agent, demonstrations):
    return demonstrations if agent.learns_from == "demonstrations" else VEHICLE


@pytest.fixture(scope="module")
def whole(vehicle_demonstrations):
    """Every agent, trained in one go without a file."""
    agents = {name: learner(name) for name in AGENTS}
    return {name: agent.learn(source_of(agent, vehicle_demonstrations)) for name, agent in agents.items()}


def assert_same_weights(agent, other):
    assert set(agent._arrays) == set(other._arrays)
    for name, array in agent._arrays.items():
        np.testing.assert_array_equal(array, other._arrays[name], err_msg=name)


@pytest.mark.parametrize("name", AGENTS)
def test_interrupted_twice_it_ends_in_the_same_weights(name, whole, vehicle_demonstrations, tmp_path):
    path = tmp_path / "state.training"
    for share in (0.3, 0.7):
        agent = learner(name)
        with pytest.raises(Interrupted):
            agent.learn(source_of(agent, vehicle_demonstrations), until(share), Resume(path, every=0.0))
    agent, resume, told = learner(name), Resume(path, every=0.0), []
    agent.learn(source_of(agent, vehicle_demonstrations), lambda share, _: told.append(share), resume)
    assert_same_weights(agent, whole[name])
    assert min(told) > 0.5  # it did go on
    shares = [point["share"] for point in resume.curve]
    assert shares == sorted(set(shares)) and shares[0] < 0.3 and shares[-1] == 1


@pytest.mark.parametrize("name", AGENTS)
def test_a_finished_training_is_not_done_again(name, whole, vehicle_demonstrations, tmp_path):
    path = tmp_path / "state.training"
    agent = learner(name)
    agent.learn(source_of(agent, vehicle_demonstrations), resume=path)
    again, told = learner(name), []
    again.learn(source_of(again, vehicle_demonstrations), lambda *now: told.append(now), path)
    assert not told
    assert_same_weights(again, whole[name])


@pytest.mark.parametrize("name", AGENTS)
def test_a_file_of_another_training_is_refused(name, vehicle_demonstrations, tmp_path):
    path = tmp_path / "state.training"
    agent = learner(name)
    with pytest.raises(Interrupted):
        agent.learn(source_of(agent, vehicle_demonstrations), until(0.5), Resume(path, every=0.0))
    before = path.read_bytes()
    other = make_agent(name, VEHICLE, agent_class(name).BRIEF, seed=4)
    with pytest.raises(CheckpointError, match="with seed 3, this one has 4; remove it"):
        other.learn(source_of(other, vehicle_demonstrations), resume=path)
    other = learner(name, hidden=(16,))
    with pytest.raises(CheckpointError, match=r"with config .*, this one has"):
        other.learn(source_of(other, vehicle_demonstrations), resume=path)
    if agent.learns_from == "demonstrations":
        with pytest.raises(CheckpointError, match="with source"):
            learner(name).learn(vehicle_demonstrations.first(3), resume=path)
    assert path.read_bytes() == before


@pytest.mark.parametrize("name", AGENTS)
def test_a_damaged_or_forged_state_is_refused(name, vehicle_demonstrations, tmp_path):
    path = tmp_path / "state.training"
    agent = learner(name)
    with pytest.raises(Interrupted):
        agent.learn(source_of(agent, vehicle_demonstrations), until(0.8), Resume(path, every=0.0))
    arrays, description = archive.read(path, "training")
    for lost in [key for key in arrays if key.endswith((".weight", "0.exp_avg", "now", "random.torch"))]:
        archive.write(path, "training", {k: a for k, a in arrays.items() if k != lost}, description)
        with pytest.raises(CheckpointError, match="lacks a part"):
            again = learner(name)
            again.learn(source_of(again, vehicle_demonstrations), resume=path)
    whole_number = next(key for key in arrays if key.endswith(".weight"))
    forged = [({**arrays, whole_number: arrays[whole_number].astype(np.int64)}, description)]
    changes = ({"curve": 3}, {"curve": [{"x": "y"}]}, {"seconds": "long"}, {"seconds": -1.0}, {"notes": []})
    forged += [(arrays, {**description, **change}) for change in changes]
    numbers = ("updates",) if name != "cppo" else ("updates", "steps", "episodes", "controller", "cost_rng")
    for entry in numbers:
        for value in (None, -5, 10**30, [1], [{}], {"state": {"state": 2**200}}):
            forged.append((arrays, {**description, "notes": {**description["notes"], entry: value}}))
    for changed, told in forged:
        archive.write(path, "training", changed, told)
        again = learner(name)
        with pytest.raises(CheckpointError, match=r"lacks a part.*remove it to begin anew"):
            again.learn(source_of(again, vehicle_demonstrations), resume=path)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(CheckpointError, match=r"damaged.*remove it to begin anew"):
        again = learner(name)
        again.learn(source_of(again, vehicle_demonstrations), resume=path)


@pytest.mark.parametrize("every", [-1, float("nan"), True, "x", None])
def test_an_interval_that_is_none_is_refused(every):
    with pytest.raises(ValueError, match="every must be"):
        Resume("file", every)
