"""Demonstration sets that were damaged or forged, our own and Minari's: all are refused, and none runs anything."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.faults import hostile
from benchmarks.faults.checkpoints import HOSTILE_ENVS, NOT_FILES, Forger, Samples, forge
from benchmarks.faults.hostile import Marks, Sample
from benchmarks.faults.measure import Effort, Fault, Findings, Tell
from rise_agents import demonstrations
from rise_agents.demonstrations import DatasetError, Demonstrations

_ENVS = ("RISE-GroundVehicle-v0", "RISE-SafePandaKinematic-v0")
_STORE = "MINARI_DATASETS_PATH"
_MINARI = "rise/forged-v0"
_MINARI_EVERY = 10  # one trial in so many is of a Minari dataset


def wrong_env(rng: np.random.Generator, sample: Sample) -> bytes:
    """Another environment, or one whose name asks for an import."""
    env = HOSTILE_ENVS[int(rng.integers(len(HOSTILE_ENVS)))]
    if env == sample.description["env"]:
        env = None
    return hostile.redescribed(sample, env=env)


def wrong_kwargs(rng: np.random.Generator, sample: Sample) -> bytes:
    """Arguments of the environment that it does not have, or that make it another one."""
    spec = {"id": "x", "entry_point": f"{hostile.EVIL}:Env", "kwargs": {}}
    wrong: list[Any] = [
        {"entry_point": f"{hostile.EVIL}:Env"}, {"no_such": 1}, {"params": None}, {"render_mode": "human"},
        {"n_obstacles": 10**9}, {"__class__": 1}, "x", [], 3, None, spec, {"": spec},
    ]  # fmt: skip
    return hostile.redescribed(sample, env_kwargs=wrong[int(rng.integers(len(wrong)))])


def wrong_card(rng: np.random.Generator, sample: Sample) -> bytes:
    """Entries that contradict the arrays or the environment."""
    card = sample.description
    wrong: dict[str, list[Any]] = {
        "params": [{}, [], "x", 3, {**card["params"], "no_such": 1}, {"entry_point": f"{hostile.EVIL}:Env"}],
        "episodes": [0, -1, 10**9, "4", None, float("nan")],
        "transitions": [0, -1, 10**9, "4", None, float("nan")],
        "experts": [[], "", None, 3, {}],
    }
    name = str(rng.choice(list(wrong)))
    return hostile.redescribed(sample, **{name: wrong[name][int(rng.integers(len(wrong[name])))]})


def wrong_numbers(rng: np.random.Generator, sample: Sample) -> bytes:
    """Numbers that no recording holds: out of bounds, unsafe, not at the goal, episodes that overlap."""
    arrays = {key: array.copy() for key, array in sample.arrays.items()}
    row = int(rng.integers(len(arrays["actions"])))
    kind = int(rng.integers(7))
    if kind == 0:
        arrays["actions"][row] = rng.choice([-1e3, 1e3, 1e30])
    elif kind == 1:
        arrays["costs"][row] = rng.choice([1.0, -1.0, np.nan])
    elif kind == 2:
        arrays["offsets"][-1] += rng.choice([-1, 1, 10**15])
    elif kind == 3:
        arrays["offsets"] = arrays["offsets"][::-1].copy()
    elif kind == 4:
        arrays["expert"][0] = rng.choice([-1, 10**9])
    elif kind == 5:
        arrays["final.achieved_goal"][0] += 0.5 * (arrays["final.achieved_goal"][0] + 1)
    else:
        arrays["rewards"][row] = rng.choice([np.nan, np.inf])
    return hostile.archive(arrays, sample.header)


FORGERS: dict[str, Forger] = {
    **hostile.common_forgers("env"),
    "signed, environment": hostile.signed_with(wrong_env),
    "signed, env_kwargs": hostile.signed_with(wrong_kwargs),
    "signed, card": hostile.signed_with(wrong_card),
    "signed, numbers": hostile.signed_with(wrong_numbers),
}


def samples_of(place: Path) -> Samples:
    """Sets of two environments."""
    found = []
    for env in _ENVS:
        folder = place / env
        demonstrations.generate(env, "cbf", 3).save(folder)
        found.append(hostile.take_apart((folder / demonstrations.DATA).read_bytes()))
    return found


def portion(
    numbers: list[int], effort: Effort, samples: Samples, load: Callable[[Path], Any] = demonstrations.load
) -> list[tuple[int, list[Fault]]]:
    """Some trials with sets of our own, in this process."""
    found = []
    with effort.scratch(f"from-{numbers[0]}") as place, Marks(place) as marks:
        folder = place / "set"
        folder.mkdir()
        for number in numbers:
            kind, content = forge(number, effort.rng(number), samples, marks, FORGERS)
            (folder / demonstrations.DATA).write_bytes(content)
            faults = hostile.judge(partial(load, folder), DatasetError, marks)
            if faults:
                effort.keep(folder / demonstrations.DATA, f"{number}.rise")
            found.append((number, [Fault(what, f"{kind}: {why}") for what, why in faults]))
    return found


def no_data(place: Path) -> Iterator[tuple[str, Path]]:
    """Folders in which something else has the name of the data; ``/dev/zero`` by a link."""
    for kind in NOT_FILES:
        folder = place / kind
        folder.mkdir()
        path = folder / demonstrations.DATA
        if kind == "folder":
            path.mkdir()
        elif kind == "zero":
            path.symlink_to("/dev/zero")
        elif kind == "fifo":
            os.mkfifo(path)
        yield kind, folder


# --- Minari ----------------------------------------------------------------------------------------------------


@contextmanager
def minari_store(place: Path) -> Iterator[Path]:
    """Minari's datasets lie in ``place`` in this block."""
    before = os.environ.get(_STORE)
    os.environ[_STORE] = str(place)
    try:
        yield place
    finally:
        if before is None:
            del os.environ[_STORE]
        else:
            os.environ[_STORE] = before


def evil_spec(rng: np.random.Generator, data: Path) -> bool:
    """The stored environment is one that leaves a mark when it is imported; returns whether it may be loaded."""
    spec: dict[str, Any] = {"id": f"{hostile.EVIL}:Env-v0" if rng.random() < 0.5 else _ENVS[0]}
    spec |= {"entry_point": f"{hostile.EVIL}:Env", "reward_threshold": None, "nondeterministic": False}
    spec |= {"max_episode_steps": 200, "order_enforce": True, "disable_env_checker": False, "kwargs": {}}
    spec |= {"additional_wrappers": [], "vector_entry_point": f"{hostile.EVIL}:Env"}
    _redescribe(data, env_spec=json.dumps(spec), eval_env_spec=json.dumps(spec))
    return True


def broken_metadata(rng: np.random.Generator, data: Path) -> bool:
    """Minari's description is cut off, empty or of the wrong kind."""
    texts = ["", "{", "[]", "null", "{}", "[" * 100_000, '{"total_episodes": "x"}']
    (data / "metadata.json").write_text(texts[int(rng.integers(len(texts)))])
    return False


def broken_data(rng: np.random.Generator, data: Path) -> bool:
    """The HDF5 file is cut off, empty, or something else."""
    file = next(data.glob("*.hdf5"))
    content = file.read_bytes()
    wrong = [b"", content[: int(rng.integers(len(content) // 2))], rng.bytes(5_000), bytes(len(content))]
    file.write_bytes(wrong[int(rng.integers(len(wrong)))])
    return False


def wrong_hdf5(rng: np.random.Generator, data: Path) -> bool:
    """Numbers out of bounds, an unsafe step, or a missing array."""
    import h5py

    with h5py.File(next(data.glob("*.hdf5")), "r+") as file:
        episode = file["episode_0"]
        kind = int(rng.integers(6))
        if kind == 0:
            episode["actions"][0] = np.nan
        elif kind == 1:
            episode["actions"][0] = 1e9
        elif kind == 2:
            episode["infos/cost"][1] = 1.0
        elif kind == 3:
            del episode["actions"]
        elif kind == 4:
            del episode["observations/obstacle"]
        else:
            del file["episode_0"]
    return False


def _redescribe(data: Path, **entries: Any) -> None:
    path = data / "metadata.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **entries}))


MINARI = {
    "stored environment": evil_spec,
    "metadata": broken_metadata,
    "broken file": broken_data,
    "numbers": wrong_hdf5,
}


def _load_minari(dataset_id: str) -> Demonstrations:
    from rise_agents.demonstrations import minari_io

    return minari_io.load(dataset_id, _ENVS[0])


def minari_portion(
    numbers: list[int], effort: Effort, load: Callable[[str], Any] = _load_minari
) -> list[tuple[int, list[Fault]]]:
    """Some trials with Minari datasets, in this process."""
    from rise_agents.demonstrations import minari_io

    found = []
    with effort.scratch("minari") as place, Marks(place) as marks, minari_store(place / "store") as store:
        store.mkdir()
        minari_io.export(demonstrations.generate(_ENVS[0], "cbf", 2), _MINARI)
        good = place / "good"
        shutil.move(store / _MINARI, good)
        for number in numbers:
            shutil.rmtree(store / _MINARI, ignore_errors=True)
            shutil.copytree(good, store / _MINARI)
            kind = list(MINARI)[number // _MINARI_EVERY % len(MINARI)]
            acceptable = MINARI[kind](effort.rng(number), store / _MINARI / "data")
            faults = hostile.judge(partial(load, _MINARI), DatasetError, marks)
            faults = [fault for fault in faults if not (acceptable and fault[0] == "accepted")]
            if faults:
                effort.keep(store / _MINARI, f"minari-{number}")
            found.append((number, [Fault(what, f"Minari, {kind}: {why}") for what, why in faults]))
    return found


def run(effort: Effort, tell: Tell) -> Findings:
    """Forged sets of every kind in turn; one in ten is Minari's."""
    findings = Findings()
    numbers = list(effort.numbers(1_000, _MINARI_EVERY + len(FORGERS)))
    minaris = [number for number in numbers if number % _MINARI_EVERY == _MINARI_EVERY - 1]
    ours = [number for number in numbers if number not in minaris]
    with effort.scratch("samples") as place:
        samples = samples_of(place)
    size = max(1, -(-len(ours) // effort.workers))
    tasks = [(ours[i : i + size], effort, samples) for i in range(0, len(ours), size)]
    batches = [found for _, found in effort.each(portion, tasks)]
    tell(0.7, {})
    if minaris:
        batches.append(minari_portion(minaris, effort))
    for number, faults in (each for batch in batches for each in batch):
        findings.add(number, faults)
    if effort.only is None:
        with effort.scratch("no-data") as place, Marks(place) as marks:
            for kind, folder in no_data(place):
                faults = hostile.judge(partial(demonstrations.load, folder), DatasetError, marks)
                findings.add(0, [Fault(what, f"{kind}: {why}") for what, why in faults])
    return findings
