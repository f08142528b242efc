"""Placement of a training run's demonstrations, and the way of batches from there to the network."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import torch
from tensordict import TensorDictBase
from torch import Tensor

from warmprior.io.distributed import from_leader

DEVICE_SHARE = 0.5
"""The share of a GPU's free memory for demonstrations; the rest is for the network and its training."""


def placed(data: TensorDictBase, device: torch.device | str) -> TensorDictBase:
    """Move demonstrations, contiguous steps, to the network's device if they fit."""
    device = torch.device(device)
    if device.type != "cuda":
        return data.to(device)

    def fits() -> bool:
        free, _ = torch.cuda.mem_get_info(device)
        return data.bytes() <= DEVICE_SHARE * free

    # The first process decides for all that train together: their generators must be of the same kind.
    return data.to(device) if from_leader(fits) else data


class Prefetch:
    """A source of batches that a thread gathers one step ahead, and pins for a GPU.

    Unlike TorchRL's prefetching, it keeps the generator's state after the batch that it returned last, so
    that a training run can be continued. Nothing else may draw from the generator.
    """

    def __init__(
        self,
        sample: Callable[[], TensorDictBase],
        generator: torch.Generator,
        *,
        device: torch.device | None = None,
    ) -> None:
        self._sample, self._generator = sample, generator
        self._device = device if device is not None and device.type == "cuda" else None
        self._executor: ThreadPoolExecutor | None = None
        self._next: Future[tuple[TensorDictBase, Tensor]] | None = None
        self._state = generator.get_state()

    def __call__(self) -> TensorDictBase:
        """Return the next batch."""
        if self._executor is None:
            self._executor = ThreadPoolExecutor(1, "prefetch")
        coming = self._next or self._executor.submit(self._draw)
        self._next = None  # also if gathering it has failed
        batch, self._state = coming.result()
        self._next = self._executor.submit(self._draw)
        # The copy is queued on the device, and the CPU does not wait for it.
        return batch if self._device is None else batch.to(self._device, non_blocking=True)

    def _draw(self) -> tuple[TensorDictBase, Tensor]:
        batch = self._sample()
        if self._device is not None:
            batch = batch.pin_memory()
        return batch, self._generator.get_state()

    def state(self) -> Tensor:
        """Return the generator's state after the batch returned last, without the batch drawn ahead."""
        return self._state

    def restore(self, state: Tensor | int) -> None:
        """Continue from a state of :meth:`state`, or begin at a seed."""
        self.close()
        if isinstance(state, int):
            state = torch.Generator(self._generator.device).manual_seed(state).get_state()
        self._generator.set_state(state)
        self._state = state

    def close(self) -> None:
        """End the thread and drop the batch drawn ahead; the next call starts another thread."""
        if self._executor is not None:
            self._executor.shutdown()
            self._generator.set_state(self._state)
        self._executor = self._next = None
