"""The prior's mean as a part of the observation, for networks that are conditioned on it."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform

from warmprior import keys
from warmprior.modules.prior import Prior

__all__ = ["MeanObservation"]


class MeanObservation(Transform):
    """Writes the observation extended by the prior's mean, in environments and replay buffers alike.

    The mean (zero on cold positions) is flattened, followed by 1 if anything is warm and else 0, and
    repeated over the observation steps. :func:`~warmprior.policy_transforms` and
    :func:`~warmprior.window_replay_buffer` append it for priors that ask for it
    (:attr:`Prior.conditions_network`), and their :class:`~warmprior.WarmPriorActor` reads what it writes.
    In an environment it comes after :class:`~warmprior.ActionHistory`.

    Keyword Args:
        observation_key: the observation, ``[*B, To, d_o]``, or one with images nested under the key, whose
            vector ``"state"`` is extended.
        loc_key: the mean, ``[*B, P, d_a]``, normalised action space.
        warm_key: the warm mask, bool ``[*B, P, 1]``.
        out_key: key written, ``[*B, To, d_o + P * d_a + 1]``.

    Raises:
        KeyError: if an input key is missing.
        ValueError: if the observation has several entries, but no vector ``"state"``.

    Examples:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from warmprior import HistoryPrior, policy_transforms
        >>> prior = HistoryPrior(2)
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), policy_transforms(prior, observation_steps=1))
        >>> seen = env.rollout(2)["prior", "observation"]  # 3 observations, 2 actions, whether warm
        >>> seen.shape, seen[:, 0, -1].tolist()
        (torch.Size([2, 1, 6]), [0.0, 1.0])
        >>> 3 + MeanObservation.width(prior, action_dim=1)
        6
    """

    def __init__(
        self,
        *,
        observation_key: NestedKey = keys.OBSERVATION,
        loc_key: NestedKey = keys.LOC,
        warm_key: NestedKey = keys.WARM,
        out_key: NestedKey = keys.CONDITIONED,
    ) -> None:
        read = [unravel_key(key) for key in (observation_key, loc_key, warm_key)]
        super().__init__(in_keys=read, out_keys=[unravel_key(out_key)])

    @staticmethod
    def width(prior: Prior, action_dim: int) -> int:
        """By how much a policy's observation is wider than the environment's: ``P * d_a + 1``, or 0.

        Args:
            prior: the policy's.
            action_dim: ``d_a``.
        """
        return prior.prediction_length * action_dim + 1 if prior.conditions_network else 0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the extended observation."""
        observation, loc, warm = self._read(tensordict)
        if isinstance(observation, TensorDictBase):
            vector = _extended(observation.get(keys.STATE), loc, warm)
            extended: Any = observation.copy().set(keys.STATE, vector)
        else:
            extended = _extended(observation, loc, warm)
        return tensordict.set(self.out_keys[0], extended)

    def _read(self, place: TensorDictBase | Composite) -> list[Any]:
        """What lies under the input keys, values or their specs."""
        known = place.keys(True)
        missing = [key for key in self.in_keys if key not in known]
        if missing:
            raise KeyError(
                f"MeanObservation needs the keys {self.in_keys}; missing: {missing}. In an environment "
                "append it after ActionHistory"
            )
        found = [place[key] for key in self.in_keys]
        self._check_vector(found[0])
        return found

    def _check_vector(self, observation: object) -> None:
        if not isinstance(observation, (TensorDictBase, Composite)):
            return
        if keys.STATE not in observation.keys():  # noqa: SIM118
            raise ValueError(
                f"MeanObservation appends its mean to an observation vector [*B, To, d_o], but "
                f"{self.in_keys[0]!r} has the entries {sorted(map(str, observation.keys(True, True)))}: "
                f"concatenate them before, or call one {keys.STATE!r}"
            )

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.forward(next_tensordict)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self.forward(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the extended observation."""
        observation, loc, _ = self._read(observation_spec)
        several = isinstance(observation, Composite)
        vector = observation[keys.STATE] if several else observation
        shape = (*vector.shape[:-1], vector.shape[-1] + loc.shape[-2:].numel() + 1)
        extended = Unbounded(shape, dtype=vector.dtype, device=vector.device)
        if several:
            whole = observation.clone()
            whole[keys.STATE] = extended
            extended = whole
        observation_spec[self.out_keys[0]] = extended
        return observation_spec


def mean_observation(prior: Prior, **renamed: NestedKey) -> list[MeanObservation]:
    """The transform, where the prior asks for it; and nothing otherwise.

    Args:
        prior: the source distribution.
        renamed: keys of :class:`MeanObservation`.
    """
    return [MeanObservation(**renamed)] if prior.conditions_network else []


def _extended(observation: Tensor, loc: Tensor, warm: Tensor) -> Tensor:
    mean = torch.where(warm, loc, 0.0).flatten(-2)
    context = torch.cat([mean, warm.any(-2).to(mean)], dim=-1).unsqueeze(-2)
    context = context.expand(*observation.shape[:-1], context.shape[-1])
    return torch.cat([observation, context.to(observation.dtype)], dim=-1)
