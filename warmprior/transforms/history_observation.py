"""The last actions as part of the observation, for networks conditioned on them."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Composite, Unbounded

from warmprior import keys
from warmprior.transforms.inner_step import EnvTransform

__all__ = ["HistoryObservation"]


class HistoryObservation(EnvTransform):
    """Appends the last ``H`` actions to the observation, in environments and replay buffers alike.

    It writes ``keys.CONDITIONED``, ``[*B, To, d_o + H * d_a + 1]``.

    The actions are flattened (zero until there are ``H`` of them), followed by 1 if there are ``H`` and 0
    otherwise, and repeated over the observation steps. Build the network with ``observation_dim = d_o +
    HistoryObservation.width(H, d_a)`` and the policy with ``observation_key=keys.CONDITIONED``. In an
    environment it comes after :class:`~warmprior.ActionHistory`.

    Keyword Args:
        observation_key: the observation, ``[*B, To, d_o]``, or one with images nested under the key, whose
            vector ``"state"`` is extended.

    Raises:
        KeyError: if an input key is missing.
        ValueError: if the observation has several entries, but no vector ``"state"``.

    Examples:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from warmprior import GaussianPrior, HistoryObservation, policy_transforms
        >>> transforms = policy_transforms(GaussianPrior(2), observation_steps=1, see_history=True)
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), transforms)
        >>> seen = env.rollout(2)["prior", "observation"]  # 3 observations, 2 actions, whether there are 2
        >>> seen.shape, seen[:, 0, -1].tolist(), 3 + HistoryObservation.width(2, action_dim=1)
        (torch.Size([2, 1, 6]), [0.0, 1.0], 6)
    """

    def __init__(self, *, observation_key: NestedKey = keys.OBSERVATION) -> None:
        read = [unravel_key(observation_key), keys.ACTIONS, keys.STEPS]
        super().__init__(in_keys=read, out_keys=[keys.CONDITIONED])

    @staticmethod
    def width(history_length: int, action_dim: int) -> int:
        """How much wider the observation becomes: ``H * d_a + 1``."""
        return history_length * action_dim + 1

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the extended observation."""
        observation, actions, steps = self._read(tensordict)
        known = steps >= actions.shape[-2]
        seen = torch.where(known.unsqueeze(-1), actions, 0.0).flatten(-2)
        context = torch.cat([seen, known.to(seen)], dim=-1).unsqueeze(-2)

        def extend(vector: Tensor) -> Tensor:
            added = context.expand(*vector.shape[:-1], context.shape[-1]).to(vector.dtype)
            return torch.cat([vector, added], dim=-1)

        return tensordict.set(self.out_keys[0], _with_vector(observation, extend))

    def _read(self, place: TensorDictBase | Composite) -> list[Any]:
        """The values or specs under the input keys."""
        known = place.keys(True)
        missing = [key for key in self.in_keys if key not in known]
        if missing:
            raise KeyError(
                f"HistoryObservation needs the keys {self.in_keys}; missing: {missing}. In an environment "
                "append it after ActionHistory"
            )
        return [place[key] for key in self.in_keys]

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.forward(next_tensordict)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the extended observation."""
        observation, actions, _ = self._read(observation_spec)

        def extend(vector: Unbounded) -> Unbounded:
            shape = (*vector.shape[:-1], vector.shape[-1] + self.width(*actions.shape[-2:]))
            return Unbounded(shape, dtype=vector.dtype, device=vector.device)

        observation_spec[self.out_keys[0]] = _with_vector(observation, extend)
        return observation_spec


def _with_vector(observation: Any, extend: Any) -> Any:
    """An observation or its spec, a vector or several entries, with its vector extended."""
    if not isinstance(observation, TensorDictBase | Composite):
        return extend(observation)
    if keys.STATE not in observation.keys():  # noqa: SIM118
        raise ValueError(
            "HistoryObservation appends the last actions to an observation vector [*B, To, d_o], but it has "
            f"the entries {sorted(map(str, observation.keys(True, True)))}: concatenate them before, or "
            f"call one {keys.STATE!r}"
        )
    whole = observation.clone() if isinstance(observation, Composite) else observation.copy()
    whole[keys.STATE] = extend(observation[keys.STATE])
    return whole
