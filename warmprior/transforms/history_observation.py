"""The last actions as a part of the observation, for networks that are conditioned on them."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform

from warmprior import keys

__all__ = ["HistoryObservation"]


class HistoryObservation(Transform):
    """Writes the observation extended by the last ``H`` actions, in environments and replay buffers alike.

    The actions (zero until there are ``H`` of them) are flattened, followed by 1 if there are ``H`` and else
    0, and repeated over the observation steps. Build the network with ``observation_dim = d_o +
    HistoryObservation.width(H, d_a)`` and the policy with ``observation_key=keys.CONDITIONED``. In an
    environment it comes after :class:`~warmprior.ActionHistory`.

    Keyword Args:
        observation_key: the observation, ``[*B, To, d_o]``, or one with images nested under the key, whose
            vector ``"state"`` is extended.
        out_key: key written, ``[*B, To, d_o + H * d_a + 1]``.

    Raises:
        KeyError: if an input key is missing.
        ValueError: if the observation has several entries, but no vector ``"state"``.

    Examples:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from warmprior import GaussianPrior, policy_transforms
        >>> transforms = policy_transforms(GaussianPrior(2), observation_steps=1, see_history=True)
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), transforms)
        >>> seen = env.rollout(2)["prior", "observation"]  # 3 observations, 2 actions, whether there are 2
        >>> seen.shape, seen[:, 0, -1].tolist()
        (torch.Size([2, 1, 6]), [0.0, 1.0])
        >>> 3 + HistoryObservation.width(2, action_dim=1)
        6
    """

    def __init__(
        self,
        *,
        observation_key: NestedKey = keys.OBSERVATION,
        out_key: NestedKey = keys.CONDITIONED,
    ) -> None:
        read = [unravel_key(observation_key), keys.ACTIONS, keys.STEPS]
        super().__init__(in_keys=read, out_keys=[unravel_key(out_key)])

    @staticmethod
    def width(history_length: int, action_dim: int) -> int:
        """By how much the observation becomes wider: ``H * d_a + 1``.

        Args:
            history_length: ``H``.
            action_dim: ``d_a``.
        """
        return history_length * action_dim + 1

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the extended observation."""
        observation, actions, steps = self._read(tensordict)
        if isinstance(observation, TensorDictBase):
            vector = _extended(observation.get(keys.STATE), actions, steps)
            extended: Any = observation.copy().set(keys.STATE, vector)
        else:
            extended = _extended(observation, actions, steps)
        return tensordict.set(self.out_keys[0], extended)

    def _read(self, place: TensorDictBase | Composite) -> list[Any]:
        """What lies under the input keys, values or their specs."""
        known = place.keys(True)
        missing = [key for key in self.in_keys if key not in known]
        if missing:
            raise KeyError(
                f"HistoryObservation needs the keys {self.in_keys}; missing: {missing}. In an environment "
                "append it after ActionHistory"
            )
        found = [place[key] for key in self.in_keys]
        several = isinstance(found[0], (TensorDictBase, Composite))
        if several and keys.STATE not in found[0].keys():  # noqa: SIM118
            raise ValueError(
                "HistoryObservation appends the last actions to an observation vector [*B, To, d_o], but "
                f"{self.in_keys[0]!r} has the entries {sorted(map(str, found[0].keys(True, True)))}: "
                f"concatenate them before, or call one {keys.STATE!r}"
            )
        return found

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.forward(next_tensordict)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self.forward(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the extended observation."""
        observation, actions, _ = self._read(observation_spec)
        several = isinstance(observation, Composite)
        vector = observation[keys.STATE] if several else observation
        width = vector.shape[-1] + self.width(*actions.shape[-2:])
        extended = Unbounded((*vector.shape[:-1], width), dtype=vector.dtype, device=vector.device)
        if several:
            whole = observation.clone()
            whole[keys.STATE] = extended
            extended = whole
        observation_spec[self.out_keys[0]] = extended
        return observation_spec


def _extended(observation: Tensor, actions: Tensor, steps: Tensor) -> Tensor:
    known = steps >= actions.shape[-2]
    seen = torch.where(known.unsqueeze(-1), actions, 0.0).flatten(-2)
    context = torch.cat([seen, known.to(seen)], dim=-1).unsqueeze(-2)
    context = context.expand(*observation.shape[:-1], context.shape[-1])
    return torch.cat([observation, context.to(observation.dtype)], dim=-1)
