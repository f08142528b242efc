"""The learning-rate schedule of the paper's recipe (Table 3)."""

from __future__ import annotations

import math

from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from warmprior.checks import check_share, check_whole_numbers


def warmup_cosine(optimizer: Optimizer, iterations: int, warmup_ratio: float = 0.2) -> LambdaLR:
    """Return a schedule with linear warm-up over the first iterations, then a cosine to zero.

    Args:
        optimizer: its learning rates are the peaks.
        iterations: length of the whole training, at least 1.
        warmup_ratio: share of the warm-up, in [0, 1); 0 starts at the peak.

    Examples:
        >>> import torch
        >>> from warmprior.training import warmup_cosine
        >>> optimizer = torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=1.0)
        >>> schedule = warmup_cosine(optimizer, iterations=10, warmup_ratio=0.2)
        >>> rates = []
        >>> for _ in range(10):
        ...     optimizer.step(); rates.append(round(schedule.get_last_lr()[0], 2)); schedule.step()
        >>> rates
        [0.5, 1.0, 1.0, 0.96, 0.85, 0.69, 0.5, 0.31, 0.15, 0.04]
    """
    check_whole_numbers(iterations=iterations)
    check_share(warmup_ratio=warmup_ratio)
    warmup = min(round(iterations * warmup_ratio), iterations - 1)

    def factor(step: int) -> float:
        if step < warmup:
            return (step + 1) / warmup
        return 0.5 * (1 + math.cos(math.pi * (step - warmup) / (iterations - warmup)))

    return LambdaLR(optimizer, factor)
