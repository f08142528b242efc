"""The parts that sources share which learn from training windows by gradient descent (:meth:`Prior.fit`)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.optim import AdamW
from torchrl.data import ReplayBuffer

from warmprior import keys
from warmprior.modules.learning_rate import warmup_cosine


def widths_of(windows: ReplayBuffer, reader: object) -> list[int]:
    """Return the widths d_a, d_o and To of a buffer's windows, without drawing any.

    Raises ValueError, which names the observation's reader, if it is not one vector; 0 and 0 without a
    reader.
    """
    window = windows[:1]
    action_dim, observation = window[keys.CHUNK].shape[-1], window[keys.OBSERVATION]
    if reader is None:
        return [action_dim, 0, 0]
    if not isinstance(observation, Tensor) or observation.ndim != 3:
        raise ValueError(f"{type(reader).__name__} reads observations that are vectors: leave out the images")
    return [action_dim, observation.shape[-1], observation.shape[-2]]


def inside_mean(windows: TensorDictBase, values: Tensor) -> Tensor:
    """Return the mean over the coordinates of a chunk inside the episode; 0 if none is inside."""
    counted = (~windows[keys.IS_PAD]).unsqueeze(-1).expand_as(values)
    return (values * counted).sum() / counted.sum().clamp_min(1)


def minimise(
    loss: Callable[[TensorDictBase, torch.Generator], Tensor],
    module: nn.Module,
    windows: ReplayBuffer,
    *,
    iterations: int,
    generator: torch.Generator,
    learning_rate: float = 1e-3,
) -> None:
    """Minimise a loss of windows over a module's parameters by AdamW, on the generator's device."""
    module.to(generator.device).requires_grad_(True).train()
    optimizer = AdamW(module.parameters(), lr=learning_rate, weight_decay=1e-2, fused=True)
    schedule = warmup_cosine(optimizer, iterations, 0.1)
    for _ in range(iterations):
        optimizer.zero_grad()
        loss(windows.sample(), generator).backward()
        optimizer.step()
        schedule.step()
