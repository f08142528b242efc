"""What the robots of a batch did since their last decision, where no environment keeps it."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from warmprior.modules.prior import Prior

__all__ = ["ActionMemory"]


class ActionMemory:
    """The mean of a prior from decision to decision, one row per environment.

    What :class:`~warmprior.ActionHistory` is in an environment of TorchRL: LeRobot's environments keep
    nothing, and its policies have a queue of actions that is common to all rows.

    Args:
        prior: the source distribution.
        action_dim: ``d_a``.

    Examples:
        >>> import torch
        >>> from warmprior import PastPrior
        >>> memory = ActionMemory(PastPrior(2), action_dim=1)
        >>> loc, warm = memory.decide(3)
        >>> memory.record(torch.tensor([[[1.0], [2.0]]]).expand(3, 2, 1))
        >>> memory.step(), memory.step()
        (None, None)
        >>> memory.forget(torch.tensor([False, True, False]))  # a new episode in the second environment
        >>> loc, warm = memory.decide(3)
        >>> loc[0].flatten().tolist(), warm[:, 0, 0].tolist()
        ([1.0, 2.0], [True, False, True])
    """

    def __init__(self, prior: Prior, action_dim: int) -> None:
        self.prior = prior
        self.action_dim = action_dim
        # None between episodes; the others are of the same decision.
        self._chunk: Tensor | None = None
        # Of the decision under way, which counts only once it has a chunk: a sampler may fail.
        self._decision = torch.empty(0), torch.empty(0)
        self._loc = self._elapsed = self._executed = self._new = torch.empty(0)

    def decide(
        self,
        batch_size: int,
        device: torch.device | str = "cpu",
        move: Callable[[Tensor], Tensor] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Mean of the source for the decision that comes now.

        Args:
            batch_size: ``B``.
            device: where the first mean of an episode is made.
            move: expresses actions of the last decision at this one, ``[B, P, d_a]`` to the same.

        Returns:
            ``loc`` ``[B, P, d_a]`` and ``warm``, bool ``[B, P, 1]``.

        Raises:
            ValueError: if there are other environments than before.
        """
        if self._chunk is None:
            size = (batch_size, self.prior.prediction_length, self.action_dim)
            loc = torch.zeros(size, device=device)
            warm = torch.zeros_like(loc[..., :1], dtype=torch.bool)
            elapsed = torch.zeros(batch_size, 1, dtype=torch.int64, device=device)
        elif len(self._chunk) != batch_size:
            raise ValueError(
                f"{batch_size} environments follow {len(self._chunk)}: call reset() in between"
            )
        else:
            elapsed = self._elapsed + self._executed
            loc, warm = self.prior.next_mean(self._loc, self._chunk, self._executed, elapsed)
            warm = warm & ~self._new[:, None, None]
            loc = loc if move is None else move(loc)
        self._decision = loc, elapsed
        return loc, warm

    def record(self, chunk: Tensor) -> None:
        """Remember what was predicted at this decision.

        Args:
            chunk: ``[B, P, d_a]``.
        """
        self._loc, self._elapsed = self._decision
        self._chunk = chunk.detach().to(self._loc, copy=True)
        self._executed = torch.zeros_like(self._elapsed)
        self._new = torch.zeros_like(self._elapsed[:, 0], dtype=torch.bool)

    def step(self) -> None:
        """One more action of the chunk is executed."""
        self._executed = self._executed + 1

    @property
    def waits(self) -> bool:
        """Whether a chunk was predicted of which no action is known to be executed."""
        return self._chunk is not None and not self._executed.any()

    def executed(self, steps: int | Tensor) -> None:
        """Tell how many actions of the chunk were executed, whatever was counted.

        Args:
            steps: a number, or ``[B]``.

        Raises:
            ValueError: if more were executed than the prior remembers, or fewer than none.
        """
        if self._chunk is None:
            return
        count = torch.as_tensor(steps, device=self._executed.device).reshape(-1, 1)
        if count.min() < 0 or count.max() > self.prior.chunk_length:
            raise ValueError(
                f"executed_steps must be from 0 to chunk_length={self.prior.chunk_length} of "
                f"{self.prior}, got {count.flatten().tolist()}"
            )
        self._executed = count.expand_as(self._executed).clone()

    def correct(self, action: Tensor) -> None:
        """Replace the action executed last.

        Args:
            action: ``[B, d_a]``.

        Raises:
            ValueError: if none was executed since the last decision.
        """
        if self._chunk is None or not self._executed.all():
            raise ValueError("no action was given since the last decision: nothing to correct")
        last = (self._executed - 1)[..., None].expand(-1, 1, self.action_dim)
        self._chunk = self._chunk.scatter(1, last, action.to(self._chunk)[:, None])

    def forget(self, mask: Tensor | None = None) -> None:
        """Begin new episodes.

        Args:
            mask: of environments, bool ``[B]``; all by default.

        Raises:
            ValueError: if the mask has another shape.
        """
        if mask is None:
            self._chunk = None
        elif self._chunk is not None:
            rows = torch.as_tensor(mask, dtype=torch.bool, device=self._new.device)
            if rows.shape != self._new.shape:
                raise ValueError(
                    f"the mask of environments has shape {tuple(rows.shape)}, expected "
                    f"{tuple(self._new.shape)}: one bool per environment"
                )
            # The rest of the chunk goes on being executed, now as the first actions of an episode.
            last = self._chunk.shape[1] - 1
            steps = torch.arange(last + 1, device=rows.device) + self._executed
            rest = self._chunk.gather(1, steps.clamp(max=last)[..., None].expand_as(self._chunk))
            self._chunk = torch.where(rows[:, None, None], rest, self._chunk)
            self._loc = torch.where(rows[:, None, None], 0.0, self._loc)
            self._elapsed = torch.where(rows[:, None], 0, self._elapsed)
            self._executed = torch.where(rows[:, None], 0, self._executed)
            self._new = self._new | rows
