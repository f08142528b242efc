"""Where the demonstrations of a training lie, and how batches get from there to the network."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import torch
from tensordict import TensorDictBase
from torch import Tensor

from warmprior.io.distributed import from_leader

DEVICE_SHARE = 0.5
"""Of a GPU's free memory, what demonstrations may take: the rest is for the network and its training."""


def placed(data: TensorDictBase, device: torch.device | str) -> TensorDictBase:
    """The demonstrations, contiguous steps, on the network's device if they fit, or where they are."""
    device = torch.device(device)
    if device.type != "cuda":
        return data.to(device)

    def fits() -> bool:
        free, _ = torch.cuda.mem_get_info(device)
        return data.bytes() <= DEVICE_SHARE * free

    # The same for processes that train together: their windows are drawn by generators of one kind.
    return data.to(device) if from_leader(fits) else data


class Prefetch:
    """Batches, each gathered by a thread while the one before is computed with, and pinned for a GPU.

    Unlike TorchRL's, it knows the generator's state that belongs to the batch it gave last, so that a
    training can be continued. Nothing else may draw from the generator.
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
        """The next batch."""
        if self._executor is None:
            self._executor = ThreadPoolExecutor(1, "prefetch")
        coming = self._next or self._executor.submit(self._draw)
        self._next = None  # whatever drawing it leads to
        batch, self._state = coming.result()
        self._next = self._executor.submit(self._draw)
        # Queued behind what the device still does, and not waited for.
        return batch if self._device is None else batch.to(self._device, non_blocking=True)

    def _draw(self) -> tuple[TensorDictBase, Tensor]:
        batch = self._sample()
        if self._device is not None:
            batch = batch.pin_memory()
        return batch, self._generator.get_state()

    def state(self) -> Tensor:
        """State of the generator after the batch given last, as if none had been drawn ahead."""
        return self._state

    def restore(self, state: Tensor | int) -> None:
        """Go on from a state that :meth:`state` gave, or begin at a seed."""
        self.close()
        if isinstance(state, int):
            state = torch.Generator(self._generator.device).manual_seed(state).get_state()
        self._generator.set_state(state)
        self._state = state

    def close(self) -> None:
        """End the thread, as if no batch had been drawn ahead; the next call starts another."""
        if self._executor is not None:
            self._executor.shutdown()
            self._generator.set_state(self._state)
        self._executor = self._next = None
