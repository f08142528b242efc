"""The history of a batch of robots without environments that keep it."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict
from torch import Tensor
from torch.nn.functional import pad

from warmprior.checks import check_between, check_shape, check_whole_numbers
from warmprior.history import caught_up, cold_history, without
from warmprior.modules.prior import Prior


class ActionMemory:
    """The history (:mod:`warmprior.history`) from decision to decision, one row per environment.

    It is the counterpart of :class:`~warmprior.ActionHistory`: LeRobot's environments keep no history, and
    its policies share one queue of actions for all rows.
    """

    def __init__(self, prior: Prior, action_dim: int) -> None:
        self.prior = prior
        self.action_dim = action_dim
        # None between episodes; the attributes below belong to the same decision.
        self._chunk: Tensor | None = None
        # Rows whose episode began since the decision before, bool [B].
        self.began = torch.empty(0, dtype=torch.bool)
        # The history of the current decision is only stored with its chunk, since a sampler may fail.
        self._history = self._decision = TensorDict()
        self._executed = self._new = torch.empty(0)
        # True once the number of executed actions of the chunk is known.
        self._counted = False

    def decide(
        self,
        batch_size: int,
        device: torch.device | str = "cpu",
        move: Callable[[Tensor], Tensor] | None = None,
    ) -> TensorDict:
        """Return the history ``[B]`` at the next decision; ``move`` converts actions to its state.

        Raises ValueError if the number of environments changes, or that of executed actions is unknown.
        """
        self.expect(batch_size)
        if self._chunk is None:
            self.began = torch.ones(batch_size, dtype=torch.bool, device=device)
            lengths = self.prior.history_length, self.prior.prediction_length
            history = cold_history([batch_size], *lengths, self.action_dim, device=device)
        elif not self._counted:
            raise ValueError(
                "the number of executed actions of the last chunk is unknown: give executed_steps= to "
                "predict_action_chunk, or prev_chunk_left_over= as LeRobot's real-time chunking does"
            )
        else:
            self.began = self._new
            history = caught_up(self._history, self._chunk, self._executed)
            # The rest of the chunk belongs to an episode that has ended.
            cold = without(history, self._new)
            history.update(cold.select("forecast", "forecast_steps"))
            if move is not None:  # empty entries stay empty
                line = torch.cat([history["actions"], history["forecast"]], 1)
                step = torch.arange(line.shape[1], device=line.device) - history["actions"].shape[1]
                real = (step >= -history["steps"]) & (step < history["forecast_steps"])
                line = torch.where(real[..., None], move(line).to(line), 0.0)
                history.update({"actions": line[:, step < 0], "forecast": line[:, step >= 0]})
        self._decision = history
        return history

    def record(self, chunk: Tensor) -> None:
        """Remember the chunk of this decision, ``[B, P, d_a]``."""
        self._history = self._decision
        self._chunk = chunk.detach().to(self._history["forecast"], copy=True)
        self._executed = torch.zeros_like(self._history["steps"])
        self._new = torch.zeros_like(self._executed[:, 0], dtype=torch.bool)
        self._counted = False

    def expect(self, batch_size: int) -> None:
        """Raise ValueError if the last chunk has another number of environments."""
        if self._chunk is not None and len(self._chunk) != batch_size:
            raise ValueError(f"{batch_size} environments follow {len(self._chunk)}: call reset() in between")

    def step(self) -> None:
        """Count one more executed action of the chunk."""
        self._executed, self._counted = self._executed + 1, True

    def infer_executed(self, left_over: Tensor | None, given: int) -> int:
        """Infer the number of executed actions from those left over; return how many are left.

        The policy returned the first ``given`` actions of the chunk. Those left over are ``[B, n, d_a]``, or
        ``[n, d_a]`` for one environment: any number of actions from the next one on, with zeros after the
        last. ``None`` stands for a new episode, as in LeRobot's rollouts. Raises ValueError if they are not
        part of the chunk. The number returned is the smallest of all environments.
        """
        if left_over is None:
            self.forget()
        if left_over is None or self._chunk is None:
            return 0
        left_over = (left_over if left_over.ndim == 3 else left_over[None])[..., : self.action_dim]
        left_over = left_over.to(self._chunk)
        count = left_over.shape[1]
        line = pad(self._chunk[:, :given], (0, 0, 0, count))
        first = 0 if count else given
        same = [(line[:, k : k + count] == left_over).flatten(1).all(1) for k in range(first, given + 1)]
        begins = torch.stack(same, 1)
        if not begins.any(1).all():
            raise ValueError(
                "prev_chunk_left_over is not part of the last chunk, so the number of executed actions is "
                "unknown: give executed_steps=, or reset() for a new episode"
            )
        executed = first + begins.int().argmax(1)
        self.executed(executed)
        return given - int(executed.max())

    def executed(self, steps: int | Tensor) -> None:
        """Set the number of executed actions of the chunk, from 0 to ``prediction_length``.

        One number applies to all environments whose episode continues; ``[B]`` also counts the actions of new
        episodes.
        """
        if self._chunk is None:
            return
        count = torch.as_tensor(steps, device=self._executed.device)
        if count.ndim:
            check_shape("executed_steps", count, (len(self._chunk),))
        for number in count.flatten().tolist():
            check_whole_numbers(0, executed_steps=number)
            check_between(0, self.prior.prediction_length, executed_steps=number)
        counted = self._new[:, None] & (count.ndim == 0)
        self._executed = torch.where(counted, self._executed, count.reshape(-1, 1))
        self._counted = True

    def correct(self, action: Tensor) -> None:
        """Replace the action executed last, ``[B, d_a]``; raise ValueError if there is none."""
        if self._chunk is None or not self._executed.all():
            raise ValueError("no action was executed since the last decision: there is nothing to correct")
        check_shape("the executed action", action, (len(self._chunk), self.action_dim))
        last = (self._executed - 1)[..., None].expand(-1, 1, self.action_dim)
        self._chunk = self._chunk.scatter(1, last, action.to(self._chunk)[:, None])

    def forget(self, mask: Tensor | None = None) -> None:
        """Begin new episodes in the environments of a mask, bool ``[B]``, or by default in all."""
        if mask is None:
            self._chunk = None
        elif self._chunk is not None:
            rows = torch.as_tensor(mask, dtype=torch.bool, device=self._new.device)
            check_shape("mask of environments", rows, self._new.shape)
            # The rest of the chunk is still executed, as the first actions of the new episode.
            rest = caught_up(self._history, self._chunk, self._executed)["forecast"]
            self._chunk = torch.where(rows[:, None, None], rest, self._chunk)
            self._history = without(self._history, rows)
            self._executed = self._executed.masked_fill(rows[:, None], 0)
            self._new = self._new | rows
