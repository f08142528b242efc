"""The environment's side of a prior: its mean for the next decision."""

from __future__ import annotations

import copy

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from warmprior import keys
from warmprior.modules.prior import Prior
from warmprior.transforms.memory import ChunkMemory

__all__ = ["ActionHistory"]


class ActionHistory(ChunkMemory):
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
        KeyError: if :class:`ChunkStep` does not come before, or a step's input lacks the mean, the mask or
            the count.

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
        super().__init__(
            (loc_key, warm_key, elapsed_key), chunk_key=chunk_key, executed_key=executed_key
        )
        if isinstance(prior, nn.Module):
            # It becomes a part of this one: whoever moved or cast the policy would do so to the environment.
            prior = copy.deepcopy(prior).cpu().requires_grad_(False)
        self.prior = prior

    def _check_length(self, length: int) -> None:
        if length != self.prior.prediction_length:
            raise ValueError(
                f"the environment takes chunks of {length} actions, but {self.prior} predicts "
                f"{self.prior.prediction_length}: use "
                f"ChunkStep({self.prior.chunk_length}, "
                f"prediction_length={self.prior.prediction_length})"
            )

    def _remember(
        self, tensordict: TensorDictBase, executed: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        loc_key, _, elapsed_key = self.memory_keys
        elapsed = tensordict.get(elapsed_key) + executed
        chunk = tensordict.get(self.chunk_key)
        return *self.prior.next_mean(tensordict.get(loc_key), chunk, executed, elapsed), elapsed
