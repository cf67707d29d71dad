"""Forged files: what an accident or an enemy makes of a good one, and how it is noticed when one gets through."""

from __future__ import annotations

import hashlib
import importlib
import io
import json
import signal
import struct
import sys
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import safetensors.numpy as st
from numpy.typing import NDArray

from rise_agents.archive import MAGIC

EVIL = "evil_module_of_the_fault_rows"
_DIGEST = 32
PATIENCE = 10.0  # s after which something hangs


class Sample(NamedTuple):
    """A good file, taken apart."""

    content: bytes
    arrays: dict[str, NDArray]
    header: dict[str, Any]

    @property
    def description(self) -> dict[str, Any]:
        """A copy of what the file says of itself."""
        return json.loads(json.dumps(self.header["description"]))


def take_apart(content: bytes) -> Sample:
    """A file in the form of :mod:`rise_agents.archive`, without any checks."""
    body = content[len(MAGIC) + _DIGEST :]
    size = int.from_bytes(body[:8], "little")
    header = json.loads(json.loads(body[8 : 8 + size])["__metadata__"]["rise"])
    return Sample(content, st.load(body), header)


def signed(body: bytes) -> bytes:
    """``body`` with our magic and its right digest in front."""
    return MAGIC + hashlib.sha256(body).digest() + body


def archive(arrays: Mapping[str, NDArray], header: Any) -> bytes:
    """A file of ours with any arrays and any header; a text is taken as the header's JSON."""
    text = header if isinstance(header, str) else json.dumps(header)
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    return signed(st.save(contiguous, metadata={"rise": text}))


def redescribed(sample: Sample, **entries: Any) -> bytes:
    """A sample whose description has other entries, properly signed."""
    return archive(sample.arrays, {**sample.header, "description": {**sample.description, **entries}})


class Marks:
    """Notices whether a forged file has run anything.

    Args:
        folder: where the mark would be left, and where the evil module lies.
    """

    def __init__(self, folder: Path) -> None:
        self.mark = folder / "mark"
        (folder / f"{EVIL}.py").write_text(f"import os\nos.mkdir({str(self.mark)!r})\nEnv = Agent = object\n")
        self.folder = folder

    def __enter__(self) -> Marks:
        sys.path.insert(0, str(self.folder))
        importlib.invalidate_caches()
        return self

    def __exit__(self, *exception: object) -> None:
        sys.path.remove(str(self.folder))

    def left(self) -> bool:
        """Whether something was run since the last look."""
        seen = self.mark.exists() or EVIL in sys.modules
        if self.mark.exists():
            self.mark.rmdir()
        sys.modules.pop(EVIL, None)
        return seen

    def bomb(self) -> bytes:
        """A pickle that leaves the mark when it is loaded."""
        # By hand: find os.mkdir, push the path, call. Nothing of ours imports what could load it.
        return b"cos\nmkdir\n(V" + str(self.mark).encode("raw_unicode_escape") + b"\ntR."


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise ``TimeoutError`` in this block after some seconds (in the main thread, where there are alarms)."""

    def ring(*_: Any) -> None:
        raise Hang

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


class Hang(BaseException):
    """It takes too long; no ``Exception``, so that nobody catches it on the way."""


def judge(load: Callable[[], Any], error: type[Exception], marks: Marks) -> list[tuple[str, str]]:
    """What is wrong with how ``load`` takes a forged file: it must raise ``error`` and run nothing."""
    faults = []
    try:
        with time_limit(PATIENCE):
            load()
        faults.append(("accepted", "no error"))
    except error as refusal:
        if "\n" in str(refusal):
            faults.append(("error of several lines", repr(str(refusal))[:200]))
    except Hang:
        faults.append(("hang", f"more than {PATIENCE:g} s"))
    except BaseException as other:
        faults.append(("other exception", f"{type(other).__name__}: {str(other)[:200]}"))
    if marks.left():
        faults.append(("executed", "what the file says was run"))
    return faults


# --- damage to bytes -------------------------------------------------------------------------------------------


def flipped(content: bytes, rng: np.random.Generator) -> bytes:
    """One to eight bits are others, anywhere or in the first bytes, which say how to read the rest."""
    changed = bytearray(content)
    end = len(content) if rng.random() < 0.5 else min(len(content), 512)
    for place in rng.integers(0, end, rng.integers(1, 9)):
        changed[place] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def truncated(content: bytes, rng: np.random.Generator) -> bytes:
    """The end is missing, or nearly all."""
    return content[: int(rng.integers(0, len(content) if rng.random() < 0.7 else 64))]


def extended(content: bytes, rng: np.random.Generator) -> bytes:
    """Bytes follow, lead or stand in the midst."""
    more = rng.bytes(int(rng.integers(1, 4_096)))
    place = int(rng.choice([0, int(rng.integers(len(content))), len(content)]))
    return content[:place] + more + content[place:]


def spliced(content: bytes, other: bytes, rng: np.random.Generator) -> bytes:
    """The beginning of one file and the end of another, or a piece of one within the other."""
    a, b = sorted(int(place) for place in rng.integers(0, min(len(content), len(other)), 2))
    return content[:a] + other[a:] if rng.random() < 0.5 else content[:a] + other[a:b] + content[b:]


# --- files of others -------------------------------------------------------------------------------------------


def zipped(entries: Mapping[str, bytes]) -> bytes:
    """A zip archive."""
    sink = io.BytesIO()
    with zipfile.ZipFile(sink, "w") as file:
        for name, content in entries.items():
            file.writestr(name, content)
    return sink.getvalue()


def foreign(rng: np.random.Generator, sample: Sample) -> bytes:
    """Files of other programs."""
    import torch

    noise = rng.bytes(int(rng.integers(0, 10_000)))
    sink = io.BytesIO()
    torch.save({name: torch.from_numpy(np.array(array)) for name, array in sample.arrays.items()}, sink)
    png = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + b"IHDR" + noise
    kinds = [
        noise,
        MAGIC + noise,
        signed(noise),
        png,
        zipped({"data": noise, "policy.pth": sink.getvalue(), "pytorch_variables.pth": noise}),
        sink.getvalue(),
        st.save(sample.arrays),
        signed(st.save(sample.arrays)),
        signed(st.save(sample.arrays, metadata={"format": "pt"})),
        json.dumps(sample.header).encode(),
        b"",
    ]
    return kinds[int(rng.integers(len(kinds)))]


def bombs(rng: np.random.Generator, marks: Marks, sample: Sample, entry: str) -> bytes:
    """Pickles that run code, plain and in disguise; one of them as ``entry`` of the description."""
    bomb = marks.bomb()
    kinds = [
        bomb,
        zipped({"archive/data.pkl": bomb, "archive/version": b"3\n"}),
        zipped({"data": bomb, "policy.pth": bomb}),
        MAGIC + bomb,
        MAGIC + bytes(_DIGEST) + bomb,
        signed(bomb),
        signed(zipped({"archive/data.pkl": bomb})),
        signed(len(bomb).to_bytes(8, "little") + bomb),
        sample.content + bomb,
        archive({**sample.arrays, "bomb": np.frombuffer(bomb, np.uint8)}, sample.header),
        redescribed(sample, **{entry: bomb.hex()}),
    ]
    return kinds[int(rng.integers(len(kinds)))]


# --- properly signed, and wrong --------------------------------------------------------------------------------


def headers(rng: np.random.Generator, sample: Sample) -> bytes:
    """Properly signed files whose header is broken, foreign, or claims what is not there."""
    good = sample.header
    deep = 100_000 if rng.random() < 0.5 else 2_000
    texts: list[Any] = [
        json.dumps(good)[:-1],
        json.dumps(good).replace(":", "", 1),
        "",
        "null",
        "[]",
        '"' + "x" * 100_000 + '"',
        "[" * deep + "]" * deep,
        '{"a":' * deep + "1" + "}" * deep,
        json.dumps({**good, "description": None}),
        json.dumps({**good, "description": []}),
        json.dumps({**good, "description": "rise"}),
        json.dumps({**good, "schema": 2}),
        json.dumps({**good, "schema": [1]}),
        json.dumps({**good, "schema": "1"}),
        json.dumps({**good, "kind": "another"}),
        json.dumps({**good, "kind": None}),
        json.dumps({key: value for key, value in good.items() if key != rng.choice(list(good))}),
        '{"schema": ' + "9" * 5_000 + "}",
    ]
    choice = int(rng.integers(len(texts) + 1))
    return archive(sample.arrays, texts[choice]) if choice < len(texts) else claims(rng, sample)


def claims(rng: np.random.Generator, sample: Sample) -> bytes:
    """A safetensors header that claims arrays of another size than their bytes."""
    body = sample.content[len(MAGIC) + _DIGEST :]
    size = int.from_bytes(body[:8], "little")
    header = json.loads(body[8 : 8 + size])
    name = str(rng.choice([key for key in header if key != "__metadata__"]))
    entry = header[name]
    huge = [[10**12], [2**63, 2**63], [10**6] * 10, [-1], ["a"], [[1]], None, [0], [1 << 62, 4]]
    kind = int(rng.integers(4))
    if kind == 0:
        entry["shape"] = huge[int(rng.integers(len(huge)))]
    elif kind == 1:
        entry["data_offsets"] = [[0, 10**15], [10**15, 0], [-8, 0], [5, 3], None][int(rng.integers(5))]
    elif kind == 2:
        entry["dtype"] = ["F128", "", None, "U1", "object"][int(rng.integers(5))]
    text = json.dumps(header).encode()
    length = len(text) if kind != 3 else int(rng.choice([2**63, 2**40, len(body) * 2, 0, 1]))
    return signed((length % 2**64).to_bytes(8, "little") + text + body[8 + size :])


def arrays_changed(rng: np.random.Generator, sample: Sample) -> bytes:
    """Properly signed arrays that do not belong together: missing, foreign, other shapes, kinds, numbers."""
    arrays = {key: array.copy() for key, array in sample.arrays.items()}
    name = str(rng.choice([key for key, array in arrays.items() if array.size]))
    array = arrays[name]
    number = array.dtype.kind == "f"
    kind = int(rng.integers(8))
    if kind == 0:
        del arrays[name]
    elif kind == 1:
        arrays[str(rng.choice(["extra", f"{name}.extra", "policy.99.weight", ""]))] = np.zeros(3, np.float32)
    elif kind == 2:
        shapes: list[NDArray] = [
            array[..., None],
            array[None],
            np.concatenate([np.atleast_1d(array)] * 2),
            np.atleast_1d(array)[:0],
        ]
        arrays[name] = shapes[int(rng.integers(len(shapes)))]
    elif kind == 3 and number:
        array.flat[int(rng.integers(array.size))] = float(rng.choice([np.nan, np.inf, -np.inf]))
    elif kind == 4:
        arrays[name] = array.astype(np.int16 if array.dtype != np.int16 else np.int8)
    elif kind == 5:
        arrays[name] = array != 0
    elif kind == 6:
        arrays[f"x{name}"] = arrays.pop(name)
    else:
        arrays = {}
    return archive(arrays, sample.header)


# From what is random in a trial, a sample, another one and the marks to the bytes of a forged file.
Forger = Callable[[np.random.Generator, Sample, Sample, Marks], bytes]


def signed_with(change: Callable[[np.random.Generator, Sample], bytes]) -> Forger:
    """A forger that makes ``change`` to a sample and signs it properly."""
    return lambda rng, sample, other, marks: change(rng, sample)


def common_forgers(entry: str) -> dict[str, Forger]:
    """What may happen to any file of ours; ``entry`` of its description is where a bomb is put."""
    return {
        "bits flipped": lambda rng, sample, other, marks: flipped(sample.content, rng),
        "truncated": lambda rng, sample, other, marks: truncated(sample.content, rng),
        "extended": lambda rng, sample, other, marks: extended(sample.content, rng),
        "spliced": lambda rng, sample, other, marks: spliced(sample.content, other.content, rng),
        "foreign file": lambda rng, sample, other, marks: foreign(rng, sample),
        "pickle bomb": lambda rng, sample, other, marks: bombs(rng, marks, sample, entry),
        "signed, header": signed_with(headers),
        "signed, arrays": signed_with(arrays_changed),
        "signed, arrays of another": lambda rng, sample, other, marks: archive(other.arrays, sample.header),
    }
