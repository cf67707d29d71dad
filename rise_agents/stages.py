"""The state of a training in torch, as named arrays and back: what :mod:`rise_agents.resume` stores."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from rise_agents.resume import Resume

Arrays = dict[str, NDArray]


def to_arrays(module: nn.Module, name: str) -> Arrays:
    """The weights of ``module`` as arrays, under ``name``."""
    return named(name, module.state_dict())


def named(name: str, tensors: dict[str, Tensor]) -> Arrays:
    """Copies of tensors as arrays, under ``name``."""
    return {f"{name}.{key}": value.detach().cpu().numpy().copy() for key, value in tensors.items()}


def under(arrays: Arrays, name: str) -> dict[str, Tensor]:
    """The inverse of :func:`named`."""
    own = {key.removeprefix(f"{name}."): a for key, a in arrays.items() if key.startswith(f"{name}.")}
    return {key: torch.from_numpy(array.copy()) for key, array in own.items()}


def moments(optimiser: torch.optim.Optimizer, name: str) -> Arrays:
    """The state of an optimiser under ``name``, by the position of each parameter."""
    state = optimiser.state_dict()["state"]
    return named(name, {f"{i}.{key}": value for i, each in state.items() for key, value in each.items()})


def optimiser_state(optimiser: torch.optim.Optimizer, arrays: Arrays, name: str) -> dict[str, Any]:
    """What ``load_state_dict`` of an Adam takes, from the arrays that :func:`moments` gave.

    Raises:
        KeyError: an array is missing.
        ValueError: an array has another shape than its parameter.
    """
    tensors = under(arrays, name)
    parameters = [parameter for group in optimiser.param_groups for parameter in group["params"]]
    state: dict[int, dict[str, Tensor]] = {}
    for i, parameter in enumerate(parameters):
        for part, shape in (("step", ()), ("exp_avg", parameter.shape), ("exp_avg_sq", parameter.shape)):
            value = tensors[f"{i}.{part}"]
            if value.shape != shape:
                raise ValueError(f"{name}.{i}.{part} has shape {tuple(value.shape)}, not {tuple(shape)}")
            state.setdefault(i, {})[part] = value
    return {**optimiser.state_dict(), "state": state}


class Stage:
    """One fit within a training: finished, interrupted, or not begun."""

    def __init__(self, stages: Stages, name: str) -> None:
        self.stages, self.name = stages, name
        self.due = stages.resume.due

    def restore(
        self, module: nn.Module, optimiser: torch.optim.Optimizer, generator: torch.Generator, updates: int
    ) -> tuple[int, Tensor]:
        """Bring all three to where the stored training of ``updates`` updates was.

        Returns:
            Updates that are done (0 at the start), and the state of the generator at the start of the pass through
            the data that is under way.
        """
        return self.stages.resume.read(partial(self._restore, module, optimiser, generator, updates))

    def _restore(
        self, module: nn.Module, optimiser: torch.optim.Optimizer, generator: torch.Generator, updates: int
    ) -> tuple[int, Tensor]:
        arrays, done = self.stages.arrays, self.stages.done.get(self.name, 0)
        if type(done) is not int or not 0 <= done <= updates:
            raise ValueError(f"{done!r} of {updates} updates are done")
        if not done:
            return 0, generator.get_state()
        for key, array in arrays.items():
            if key.startswith(f"{self.name}.") and array.dtype.kind != "f":
                raise ValueError(f"{key} is {array.dtype}, not float")
        module.load_state_dict(under(arrays, self.name))
        random = under(arrays, f"{self.name}/random")
        generator.set_state(random["now"])
        if done < updates:
            optimiser.load_state_dict(optimiser_state(optimiser, arrays, f"{self.name}/adam"))
        return done, random["pass"]

    def keep(
        self,
        done: int,
        module: nn.Module,
        optimiser: torch.optim.Optimizer | None,
        generator: torch.Generator,
        epoch: Tensor,
    ) -> None:
        """Store the training with this stage after ``done`` updates (without optimiser: finished)."""
        random = {"now": generator.get_state(), "pass": epoch}
        current = {**to_arrays(module, self.name), **named(f"{self.name}/random", random)}
        if optimiser is not None:
            current |= moments(optimiser, f"{self.name}/adam")
        self.stages.save(self.name, done, current)


class Stages:
    """The consecutive fits of one call to ``learn``, which a :class:`Resume` remembers.

    Args:
        resume: where.
        arrays: what it held.
        notes: what it held.
    """

    def __init__(self, resume: Resume, arrays: Arrays, notes: dict[str, Any]) -> None:
        self.resume, self.arrays = resume, arrays
        self.done: dict[str, int] = resume.read(lambda: self._done(notes))

    def _done(self, notes: dict[str, Any]) -> dict[str, int]:
        """Updates of each stage that is stored; ``ValueError`` if the notes speak of others."""
        done = dict(notes.get("updates", {}))
        stored = {key.split(".")[0].split("/")[0] for key in self.arrays}
        if set(done) != stored:
            raise ValueError(f"it holds the stages {sorted(stored)} and speaks of {sorted(map(str, done))}")
        return done

    def __getitem__(self, name: str) -> Stage:
        """The stage called ``name``."""
        return Stage(self, name)

    def save(self, name: str, done: int, current: Arrays) -> None:
        """Write all stages, with ``current`` in place of what there was of stage ``name``."""
        others = {key: a for key, a in self.arrays.items() if not key.startswith((f"{name}.", f"{name}/"))}
        self.arrays, self.done = {**others, **current}, {**self.done, name: done}
        self.resume.save(self.arrays, {"updates": self.done})
