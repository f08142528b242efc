"""A prior that someone else wrote, as the benchmarks meet it: in a module of its own."""

from __future__ import annotations

from warmprior import PastPrior


class HeldAction(PastPrior):
    """Holds the last executed action."""

    name = "held"

    def mean(self, history):
        """The last executed action at every step."""
        loc, warm = super().mean(history)
        return loc[..., -1:, :].expand_as(loc), warm
