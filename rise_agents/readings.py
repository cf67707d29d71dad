"""What a policy sees: observations in one of three frames, and their units.

Every agent reads through this file, so that frames are compared on equal terms:

``world``
    state, goal and reading as the environment gives them (the paper).
``body``
    goal and readings relative to the robot: turned into the vehicle's heading frame, or relative to the hand.
``features``
    geometric quantities of the body frame (distances, clearance, closing speed, the angle an obstacle
    covers, its offset from the straight way) that make the avoidance rule nearly linear.

Shapes: B batch, R robot inputs, C reading inputs, N obstacles, D dimensions.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rise_envs import streams
from rise_envs.task import Task

Array = NDArray[np.float64]
FRAMES = ("world", "body", "features")
_FLOAT64 = np.dtype(np.float64)


def as_batch(observation: Mapping[str, Any]) -> tuple[dict[str, Array], bool]:
    """The observation as float64 with a batch axis in front, and whether it came as a single one.

    An observation is a batch if its ``desired_goal`` has two dimensions. Tensors of torch will do.
    """
    rows = {name: np.asarray(on_host(value), np.float64) for name, value in observation.items()}
    single = rows["desired_goal"].ndim == 1
    return ({name: value[None] for name, value in rows.items()} if single else rows), single


def on_host(value: Any) -> Any:
    """What NumPy can read: ``value`` itself, or a tensor brought from its device."""
    return value.cpu() if hasattr(value, "cpu") else value


def checked_batch(task: Task, observation: Any) -> tuple[dict[str, Array], bool]:
    """What a policy reads of an observation of ``task``, with a batch axis in front; whether it came as a single one.

    This is the door of every ``predict``: an observation is a batch if its ``desired_goal`` has two dimensions,
    and every part of it must then have as many rows. Keys that no policy reads are left out. The arrays may be the
    caller's own: read them only.

    Args:
        task: says how many numbers each part has.
        observation: parts (S,), (D,), (C,), or (B, S), (B, D), (B, C); tensors of torch will do.

    Returns:
        Parts (B, S), (B, D), (B, C), float64.

    Raises:
        ValueError: a part that is missing, of another shape, not of real numbers, or not finite; it is named.
    """
    rows: dict[str, Array] = {}
    try:  # one observation as environments give it, which is nothing but looked at: a microsecond and a half
        for key, shape in task.shapes.items():
            part = observation[key]
            if type(part) is not np.ndarray or part.dtype is not _FLOAT64 or part.shape != shape:
                break
            if not np.vdot(part, part) < np.inf:
                break
            rows[key] = part[None]
        else:
            return rows, True
    except (KeyError, TypeError, IndexError):  # named below
        pass
    return _converted_batch(task, observation)


def _converted_batch(task: Task, observation: Any) -> tuple[dict[str, Array], bool]:
    """`checked_batch` of whatever was given."""
    parts = _parts(observation, task.widths)
    rows = {key: _numbers(key, parts[key]) for key in task.widths}
    lead = rows["desired_goal"].shape[:-1]
    for key, width in task.widths.items():
        if len(lead) > 1 or rows[key].shape != (*lead, width):
            wanted = f"({width},), or (B, {width}) with the same B in every part"
            raise ValueError(f"observation[{key!r}] must have shape {wanted}, got {rows[key].shape}")
    check_finite(rows)
    return ({key: value[None] for key, value in rows.items()}, True) if not lead else (rows, False)


def checked_parts(observation: Any, ranks: Mapping[str, int]) -> tuple[dict[str, NDArray], bool]:
    """As `checked_batch`, for any environment, of which the ranks of the parts of an observation are known.

    Args:
        observation: a dict of parts, or the only part, whose key is empty then.
        ranks: number of dimensions of each part of a single observation.

    Raises:
        ValueError: as for `checked_batch`.
    """
    parts = {"": observation} if list(ranks) == [""] else _parts(observation, ranks)
    rows = {key: _numbers(key, parts[key]) for key in ranks}
    single = all(rows[key].ndim == rank for key, rank in ranks.items())
    if single:
        rows = {key: part[None] for key, part in rows.items()}
    count = None
    for key, rank in ranks.items():
        count = rows[key].shape[:1] if count is None else count
        if rows[key].ndim != rank + 1 or rows[key].shape[:1] != count:
            wanted = f"{rank} dimensions, or one more with the same length in every part"
            raise ValueError(f"{_place(key)} must have {wanted}, got shape {np.shape(parts[key])}")
    check_finite(rows)
    return rows, single


def observation_ranks(space: spaces.Space) -> dict[str, int]:
    """The number of dimensions of each part of one observation, as `checked_parts` takes them.

    Raises:
        ValueError: a part that is no Box.
    """
    parts = space.spaces if isinstance(space, spaces.Dict) else {"": space}
    for key, part in parts.items():
        if not isinstance(part, spaces.Box):
            raise ValueError(f"observation {key!r} must be a Box to be read as numbers, got {part}")
    return {key: len(part.shape or ()) for key, part in parts.items()}


def _parts(observation: Any, keys: Mapping[str, int]) -> Mapping[str, Any]:
    """The observation itself; raises ``ValueError`` unless it is a dict with the given keys."""
    if not isinstance(observation, Mapping):
        raise ValueError(f"an observation must be a dict with the keys {list(keys)}, got {observation!r}")
    for key in keys:
        if key not in observation:
            raise ValueError(f"observation lacks {key!r}, it has {list(observation)}")
    return observation


def _numbers(key: str, value: Any) -> Array:
    """A part of an observation as float64; raises ``ValueError`` unless it is an array of real numbers."""
    if type(value) is np.ndarray and value.dtype is _FLOAT64:
        return value
    try:
        array = np.asarray(on_host(value))
    except (TypeError, ValueError):  # rows of different lengths
        array = np.asarray(None)
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{_place(key)} must be an array of real numbers, got {value!r}")
    return array.astype(np.float64)


def _place(key: str) -> str:
    return f"observation[{key!r}]" if key else "the observation"


def check_finite(parts: Mapping[str, NDArray]) -> None:
    """Raise ``ValueError`` that names the key and the place of a number that is not finite."""
    for key, value in parts.items():
        # A sum of squares is finite only if every number is, and takes a third of the time to find out.
        if not np.vdot(value, value) < np.inf and not np.isfinite(value).all():
            where = np.argwhere(~np.isfinite(value))[0].tolist()
            raise ValueError(f"{_place(key)} is not finite at {where}")


def inputs(task: Task, frame: str, observation: dict[str, Array]) -> tuple[Array, Array]:
    """Robot inputs (B, R) and reading inputs (B, C) of a batched observation in the given frame."""
    state, goal, reading = observation["observation"], observation["desired_goal"], observation["obstacle"]
    if frame == "world":
        return np.concatenate((state, goal), -1), reading
    goal, position, velocity, radius = to_body(task, state, goal, reading)
    robot = np.concatenate((state[:, _columns(task.body_state)], goal), -1) if task.body_state else goal
    if frame == "body":
        c = np.concatenate((position, velocity, radius[..., None]), -1)
        return robot, c.reshape(len(c), -1)
    distance = np.linalg.norm(goal, axis=-1, keepdims=True)
    way = goal / np.maximum(distance, 1e-6)
    features = obstacle_features(task, way, distance, position, velocity, radius)
    return np.concatenate((robot, distance, way), -1), features.reshape(len(goal), -1)


def to_body(task: Task, state: Array, goal: Array, reading: Array) -> tuple[Array, Array, Array, Array]:
    """Goal (B, D), positions and velocities (B, N, D) seen from the robot's frame, and radii (B, N).

    Velocities keep their size (they are not relative to the robot's own), they are only turned.
    """
    origin, rotation = task.pose(state)
    position, velocity, radius = task.split(reading)
    n = task.n_obstacles
    vectors = np.concatenate((goal[:, None], position, velocity), 1)
    vectors[:, : 1 + n] -= origin[:, None]
    turned = vectors @ rotation  # rows times R is Rᵀ times columns: world to body
    return turned[:, 0], turned[:, 1 : 1 + n], turned[:, 1 + n :], radius


@functools.cache
def _columns(numbers: tuple[int, ...]) -> slice | list[int]:
    """The given columns of an array, as a view of it where they lie side by side."""
    side_by_side = numbers == tuple(range(numbers[0], numbers[-1] + 1))
    return slice(numbers[0], numbers[-1] + 1) if side_by_side else list(numbers)


def to_world(task: Task, state: Array, position: Array, velocity: Array, radius: Array) -> Array:
    """The inverse of :func:`to_body` for readings: (B, N, D) twice and (B, N) to (B, C)."""
    origin, rotation = task.pose(state)
    turned = rotation.swapaxes(-1, -2)
    c = np.concatenate((position @ turned + origin[:, None], velocity @ turned, radius[..., None]), -1)
    return c.reshape(len(c), -1)


def obstacle_features(
    task: Task, way: Array, goal_distance: Array, position: Array, velocity: Array, radius: Array
) -> Array:
    """Geometric features of obstacles in the body frame, (B, N, F).

    Args:
        task: gives the robot's radius.
        way: unit vector towards the goal, (B, D).
        goal_distance: (B, 1), m.
        position: centres, (B, N, D), m.
        velocity: (B, N, D), m/s.
        radius: (B, N), m.
    """
    distance = np.linalg.norm(position, axis=-1, keepdims=True)
    towards = position / np.maximum(distance, 1e-6)
    reach = np.maximum(radius[..., None], 0.0) + task.robot_radius
    closing = -(velocity * towards).sum(-1, keepdims=True)
    across = velocity + closing * towards
    covered = np.arcsin(np.clip(reach / np.maximum(distance, 1e-6), 0.0, 1.0))
    along = (position * way[:, None]).sum(-1, keepdims=True)
    aside = position - along * way[:, None]
    offset = np.linalg.norm(aside, axis=-1, keepdims=True)
    parts = [
        *(
            position,
            velocity,
            radius[..., None],
            distance,
            towards,
            distance - reach,
            closing,
            across,
            covered,
        ),
        *(
            along,
            along - goal_distance[:, None],
            aside,
            offset - reach,
            (towards * way[:, None]).sum(-1, keepdims=True),
        ),
    ]
    if task.dim == 2:  # signed angles and offsets exist in the plane only
        side = (way[:, None, 0] * position[..., 1] - way[:, None, 1] * position[..., 0])[..., None]
        bearing = np.arctan2(position[..., 1], position[..., 0])[..., None]
        parts += [side - reach, side + reach, bearing - covered, bearing + covered]
    return np.concatenate(parts, -1)


def reading_units(task: Task, frame: str, observation: dict[str, Array], draws: int = 8) -> Array:
    """How much noise of level 1 moves each reading input, (C,): the units of the reading noise.

    In the world and body frames this is the noise scale itself (noise is isotropic, and turning keeps it);
    for features it is the root mean square change over ``draws`` noisy copies of each observation.
    """
    scale = np.asarray(task.noise_scale)
    if frame != "features":
        return scale
    clean = inputs(task, frame, observation)[1]
    change = np.zeros(clean.shape[1])
    keys = streams.split(np.arange(len(clean), dtype=np.uint64), 7)
    for draw in range(draws):
        counter = draw * len(scale) + np.arange(len(scale))
        noise = streams.normal(keys[:, None], counter) * scale
        noisy = inputs(task, frame, {**observation, "obstacle": observation["obstacle"] + noise})[1]
        change += ((noisy - clean) ** 2).mean(0)
    return np.sqrt(change / draws)


@dataclass(frozen=True)
class Standardiser:
    """An affine change of units: (x − mean) / scale."""

    mean: Array
    scale: Array

    @classmethod
    def fit(cls, x: Array) -> Standardiser:
        """Zero mean and unit variance on ``x`` (B, K); constant columns are only centred."""
        std = x.std(0)
        return cls(x.mean(0), np.where(std > 1e-8, std, 1.0))

    def __call__(self, x: Array) -> NDArray[np.float32]:
        """``x`` (B, K) in the new units, float32."""
        return ((x - self.mean) / self.scale).astype(np.float32)

    def arrays(self, name: str) -> dict[str, Array]:
        """The numbers to store, under ``name``."""
        return {f"{name}.mean": self.mean, f"{name}.scale": self.scale}

    @classmethod
    def from_arrays(cls, arrays: dict[str, Array], name: str) -> Standardiser:
        """The inverse of :meth:`arrays`."""
        return cls(arrays[f"{name}.mean"], arrays[f"{name}.scale"])
