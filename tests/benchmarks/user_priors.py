"""A prior that someone else wrote, as the benchmarks meet it: in a module of its own."""

from __future__ import annotations

from warmprior import PastPrior


class HeldAction(PastPrior):
    """Holds the last executed action."""

    name = "held"
    label = "Held action"
    color = "#aa00aa"

    def training_mean(self, history, history_valid, target):
        """The last of the history."""
        loc, warm = super().training_mean(history, history_valid, target)
        return loc[..., -1:, :].expand_as(loc), warm

    def next_mean(self, loc, chunk, executed_steps, elapsed_steps):
        """The last executed action."""
        loc, warm = super().next_mean(loc, chunk, executed_steps, elapsed_steps)
        return loc[..., -1:, :].expand_as(loc), warm
