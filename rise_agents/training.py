"""The one training loop."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from rise_agents.stages import Stage

# Maps a batch, (B, …) each, to named terms, of which ``loss`` is minimised.
Loss = Callable[..., dict[str, Tensor]]


def fit(
    stage: Stage,
    module: nn.Module,
    loss: Loss,
    data: Sequence[Tensor],
    *,
    updates: int,
    batch_size: int,
    learning_rate: float,
    generator: torch.Generator,
    progress: Callable[[float, dict[str, float]], None],
) -> None:
    """Adam with a cosine schedule to zero over shuffled passes through the data.

    Args:
        stage: where this training may have been interrupted, and keeps its state.
        module: what is trained.
        loss: called as ``loss(*rows)`` with a batch of each of ``data``.
        data: tensors (T, …) of the same length, on the device of ``generator``.
        updates: gradient steps.
        batch_size: B (at most T).
        learning_rate: at the start.
        generator: draws the order of the rows.
        progress: told the share done and the terms, about a hundred times.
    """
    optimiser = torch.optim.Adam(module.parameters(), lr=learning_rate, fused=True)
    total = len(data[0])
    batch_size = min(batch_size, total)
    per_pass = total // batch_size
    every = max(1, updates // 100)
    begun, epoch = stage.restore(module, optimiser, generator, updates)
    for update in range(begun, updates):
        start = (update % per_pass) * batch_size
        if start == 0 or update == begun:  # rows are gathered once a pass, so that batches are views
            epoch = generator.get_state() if start == 0 else epoch
            order = _order(total, generator if start == 0 else _at(epoch, generator))
            shuffled = [part.index_select(0, order) for part in data]
        for group in optimiser.param_groups:
            group["lr"] = 0.5 * learning_rate * (1 + math.cos(math.pi * update / updates))
        terms = loss(*(part[start : start + batch_size] for part in shuffled))
        optimiser.zero_grad(set_to_none=True)
        terms["loss"].backward()
        optimiser.step()
        if (update + 1) % every == 0 or update + 1 == updates:
            progress((update + 1) / updates, {name: float(term.detach()) for name, term in terms.items()})
        if stage.due() and update + 1 < updates:
            stage.keep(update + 1, module, optimiser, generator, epoch)
    if begun < updates:
        stage.keep(updates, module, None, generator, epoch)


def _order(rows: int, generator: torch.Generator) -> Tensor:
    return torch.randperm(rows, generator=generator, device=generator.device)


def _at(state: Tensor, like: torch.Generator) -> torch.Generator:
    generator = torch.Generator(device=like.device)
    generator.set_state(state)
    return generator
