"""The environment's side of a prior: its mean for the next decision."""

from __future__ import annotations

import copy

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import nn
from torchrl.data import Categorical, TensorSpec, Unbounded
from torchrl.envs.transforms import Transform

from warmprior import keys
from warmprior.modules.prior import Prior
from warmprior.transforms.chunk_keys import chunk_spec, executed_steps

__all__ = ["ActionHistory"]


class ActionHistory(Transform):
    """Writes the prior's mean for the next decision after each step, and a cold one at resets.

    A function of the step's own tensordict, without state: it gives the same in ``env.rollout``,
    collectors and batched environments, inside or outside of workers, with any policy (random ones
    included), and per sub-environment when some of them reset. Append it after :class:`ChunkStep`,
    which tells how many actions were executed.

    =========================  ===========================  ====================================
    key                        shape                        meaning
    =========================  ===========================  ====================================
    ``("prior", "loc")``       ``[*B, P, d_a]`` float       the mean, normalised action space, of the
                                                            action's dtype
    ``("prior", "warm")``      ``[*B, P, 1]`` bool          where the mean counts
    ``("prior", "elapsed")``   ``[*B, 1]`` int64            actions executed since the reset
    =========================  ===========================  ====================================

    Args:
        prior: the source distribution of the policy that will act. One that learns is copied, as it is now:
            the copy goes where the environment goes, and the policy's own where the policy goes.

    Keyword Args:
        chunk_key: the predicted chunk, ``[*B, P, d_a]``.
        executed_key: the number of executed actions, int64 ``[*B, 1]``.
        loc_key: where the mean is written.
        warm_key: where the mask is written.
        elapsed_key: where the count of executed actions is written.

    Raises:
        ValueError: if the environment's chunks have another length than the prior's predictions.
        KeyError: if :class:`ChunkStep` does not come before.

    Examples:
        >>> from torchrl.envs import GymEnv, TransformedEnv, Compose
        >>> from warmprior import ActionHistory, ChunkStep, PastPrior
        >>> env = TransformedEnv(
        ...     GymEnv("Pendulum-v1"), Compose(ChunkStep(4), ActionHistory(PastPrior(4))))
        >>> rollout = env.rollout(3)
        >>> rollout["prior", "warm"].all(1).flatten().tolist()
        [False, True, True]
        >>> bool((rollout["prior", "loc"][1:] == rollout["vla_action", "chunk"][:-1]).all())
        True
    """

    def __init__(
        self,
        prior: Prior,
        *,
        chunk_key: NestedKey = keys.CHUNK,
        executed_key: NestedKey = keys.EXECUTED,
        loc_key: NestedKey = keys.LOC,
        warm_key: NestedKey = keys.WARM,
        elapsed_key: NestedKey = keys.ELAPSED,
    ) -> None:
        super().__init__(in_keys=[chunk_key], out_keys=[loc_key, warm_key, elapsed_key])
        if isinstance(prior, nn.Module):
            # It becomes a part of this one: whoever moved or cast the policy would do so to the environment.
            prior = copy.deepcopy(prior).cpu().requires_grad_(False)
        self.prior = prior
        self.chunk_key = unravel_key(chunk_key)
        self.executed_key = unravel_key(executed_key)
        self.loc_key = unravel_key(loc_key)
        self.warm_key = unravel_key(warm_key)
        self.elapsed_key = unravel_key(elapsed_key)
        self._chunk: TensorSpec | None = None

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        executed = executed_steps(next_tensordict, self.executed_key, "ActionHistory")
        before = tensordict.get(self.loc_key)
        elapsed = tensordict.get(self.elapsed_key) + executed
        loc, warm = self.prior.next_mean(before, tensordict.get(self.chunk_key), executed, elapsed)
        loc = loc.to(before.dtype)  # a policy may compute in another precision than the environment
        rows = tensordict.get("_step", None)
        if rows is not None:
            # A partial step: the others were not asked, and what lies in their chunk was not executed.
            rows = rows.view(*next_tensordict.batch_size, 1, 1)
            loc = torch.where(rows, loc, before)
            warm = torch.where(rows, warm, tensordict.get(self.warm_key))
        next_tensordict.set(self.loc_key, loc)
        next_tensordict.set(self.warm_key, warm)
        return next_tensordict.set(self.elapsed_key, elapsed)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # Cold everywhere: TorchRL merges these rows into the sub-environments that were reset only.
        batch, device = tensordict_reset.batch_size, tensordict_reset.device
        chunk = self._chunk or self._check_chunk(self.parent.full_action_spec)
        loc = torch.zeros(*batch, *chunk.shape[-2:], dtype=chunk.dtype, device=device)
        tensordict_reset.set(self.loc_key, loc)
        tensordict_reset.set(self.warm_key, torch.zeros_like(loc[..., :1], dtype=torch.bool))
        elapsed = torch.zeros(*batch, 1, dtype=torch.int64, device=device)
        return tensordict_reset.set(self.elapsed_key, elapsed)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Outside environments the transform does nothing: the keys are already in the data."""
        return tensordict

    def _check_chunk(self, action_spec: TensorSpec) -> TensorSpec:
        chunk = chunk_spec(action_spec, self.chunk_key, "ActionHistory")
        length = chunk.shape[-2]
        if length != self.prior.prediction_length:
            raise ValueError(
                f"the environment takes chunks of {length} actions, but {self.prior} predicts "
                f"{self.prior.prediction_length}: use "
                f"ChunkStep({self.prior.chunk_length}, "
                f"prediction_length={self.prior.prediction_length})"
            )
        # Kept because resets are frequent and TorchRL rebuilds specs on every access.
        self._chunk = chunk
        return chunk

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the mean, the mask and the count."""
        chunk = self._check_chunk(self.parent.full_action_spec)
        batch, device = observation_spec.shape, observation_spec.device
        length, action_dim = chunk.shape[-2:]
        observation_spec[self.loc_key] = Unbounded(
            (*batch, length, action_dim), dtype=chunk.dtype, device=device
        )
        observation_spec[self.warm_key] = Categorical(
            2, shape=(*batch, length, 1), dtype=torch.bool, device=device
        )
        observation_spec[self.elapsed_key] = Unbounded(
            (*batch, 1), dtype=torch.int64, device=device
        )
        return observation_spec
