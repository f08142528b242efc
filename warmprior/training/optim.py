"""The optimiser and weight averaging of the paper's recipe (Table 3)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.optim import AdamW
from torch.optim.swa_utils import AveragedModel

from warmprior.checks import check_share
from warmprior.modules.network import uncompiled


def make_optimizer(network: nn.Module, *, learning_rate: float = 1e-4, weight_decay: float = 1e-5) -> AdamW:
    """Return AdamW with the paper's values, for a :class:`~warmprior.VelocityNetwork`, compiled or not.

    Biases, norms and position embeddings do not decay.
    """
    return AdamW(uncompiled(network).parameter_groups(weight_decay), lr=learning_rate, fused=True)


def ema_of(network: nn.Module, rate: float = 0.995) -> AveragedModel:
    """Return an exponential moving average of a network's weights; the averaged copy is ``.module``.

    ``rate``, in [0, 1), is the decay per update. The first update copies the weights.

    Examples:
        >>> from torch import nn
        >>> from warmprior.training import ema_of
        >>> network = nn.Linear(1, 1, bias=False)
        >>> average = ema_of(network, rate=0.9)
        >>> for weight in (0.0, 1.0):
        ...     _ = nn.init.constant_(network.weight, weight)
        ...     average.update_parameters(network)
        >>> round(average.module.weight.item(), 3)
        0.1
    """
    check_share(rate=rate)
    averaged = _Average(network, multi_avg_fn=partial(_move, rate=rate))
    averaged.module.eval()
    return averaged.requires_grad_(False)


def _move(averaged: list[Tensor], current: list[Tensor], _: Tensor, *, rate: float) -> None:
    # A function and not a closure as in PyTorch, because policies that hold an average are pickled.
    torch._foreach_lerp_(averaged, current, 1 - rate)


class _Average(AveragedModel):
    """An average that keeps its count on the CPU: PyTorch's waits for the device at every update."""

    def update_parameters(self, model: nn.Module) -> None:
        self.update_from(model)()

    def update_from(self, model: nn.Module) -> Callable[[], None]:
        """Return a function that updates the average from a model that keeps its parameters and modules.

        It collects them once, which for a large network takes milliseconds.
        """
        averages: list[Tensor] = list(self.module.parameters())
        weights: list[Tensor] = list(model.parameters())
        parts = zip(self.module.modules(), model.modules(), strict=True)
        return partial(self._update, averages, weights, [pair for pair in parts if pair[1]._buffers])

    @torch.no_grad()
    def _update(
        self,
        averages: list[Tensor],
        weights: list[Tensor],
        owners: list[tuple[nn.Module, nn.Module]],
    ) -> None:
        if self.n_averaged.item():
            cast(Any, self.multi_avg_fn)(averages, weights, self.n_averaged)
        else:
            torch._foreach_copy_(averages, weights)
        # A forward pass may replace a buffer, so they are collected anew.
        averaged, current = ([b for pair in owners for b in pair[i].buffers(False)] for i in (0, 1))
        if averaged:  # those of a norm without running statistics are None
            torch._foreach_copy_(averaged, current)
        self.n_averaged += 1
