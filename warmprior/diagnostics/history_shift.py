"""Inference-time history shift: a policy whose memory is slightly wrong."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from warmprior import keys
from warmprior.diagnostics.flow import seen_anew
from warmprior.diagnostics.memory_gain import shifted
from warmprior.modules.actor import WarmPriorActor

__all__ = ["HistoryShift"]


class HistoryShift(TensorDictModuleBase):
    """Disturbs a policy's history at every decision.

    Adds normal noise to the history's actions and forecast before the policy sees them. The environment's own
    history stays as it is.

    Args:
        policy: the policy.
        std: standard deviation of the noise, normalised action units.

    Keyword Args:
        generator: source of randomness; PyTorch's global one by default.

    Raises:
        ValueError: if ``std < 0``.
    """

    def __init__(
        self, policy: WarmPriorActor, std: float, *, generator: torch.Generator | None = None
    ) -> None:
        super().__init__()
        if not std >= 0:
            raise ValueError(f"std must be >= 0, got {std}")
        self.policy, self.std, self.generator = policy, std, generator
        self.in_keys, self.out_keys = policy.in_keys, policy.out_keys

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Disturb the history and act."""
        history = tensordict[keys.HISTORY]
        longest = max(history[name].shape[-2] for name in ("actions", "forecast"))
        actions = history["actions"]
        noise = torch.randn(
            (*actions.shape[:-2], longest, actions.shape[-1]),
            generator=self.generator,
            dtype=actions.dtype,
            device=actions.device,
        )
        seen = tensordict.clone(recurse=False)
        seen.set(keys.HISTORY, shifted(history, self.std * noise))
        out = self.policy(seen_anew(self.policy, seen))
        return tensordict.update(out.select(*self.out_keys))
