"""Measurement of speed: a clock for several functions in turn, and random data of a robot's size."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict
from tqdm import tqdm

from warmprior import PastPrior
from warmprior.history import window_history

D_O, D_A, H, TO = 23, 7, 8, 2
PRIOR = PastPrior(H)
NFES = (1, 3, 9)
BATCH = 256


class Clock:
    """Times several functions in turn, so that drifts of the machine affect all of them equally."""

    def __init__(self, repeats: int, bar: tqdm) -> None:
        self.repeats, self.bar = repeats, bar

    def times(
        self, *functions: Callable[[], object], calls: int = 1, before: Callable[[], object] = int
    ) -> list[list[float]]:
        """Return seconds per call, ``[function][repeat]``; ``before`` runs untimed before each round."""
        seconds: list[list[float]] = [[] for _ in functions]
        for repeat in range(self.repeats + 1):
            before()
            # Every other round runs backwards, so that no function is always first.
            for i in range(len(functions)) if repeat % 2 else reversed(range(len(functions))):
                start = time.perf_counter()
                for _ in range(calls):
                    functions[i]()
                    if torch.cuda.is_initialized():
                        torch.cuda.synchronize()
                if repeat:  # the first round warms up
                    seconds[i].append((time.perf_counter() - start) / calls)
            self.bar.set_postfix(repeat=f"{repeat}/{self.repeats}")
        return seconds

    def ratio(self, function: Callable[[], object], base: Callable[[], object], **options: Any) -> float:
        """Return the median over rounds of the time of ``function`` over that of ``base``."""
        one, two = self.times(function, base, **options)
        return statistics.median(a / b for a, b in zip(one, two, strict=True))


def steps(episodes: int, length: int) -> TensorDict:
    """Return demonstrations of random numbers."""
    n = episodes * length
    both = torch.rand(n, D_O + D_A, generator=torch.Generator().manual_seed(0)) * 2 - 1
    observation, action = both.split((D_O, D_A), dim=-1)
    episode = torch.arange(n) // length
    return TensorDict({"observation": observation, "action": action, "episode": episode}, [n]).contiguous()


def one_decision(device: str = "cpu") -> TensorDict:
    """Return the input of a policy for one decision."""
    history = window_history(torch.randn(1, H, D_A), torch.full((1, 1), H), torch.zeros(1, H, D_A), H)
    return TensorDict({"observation": torch.randn(1, TO, D_O), "history": history}, [1]).to(device)
