"""An environment whose action is a residual in the source space of a frozen policy."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import Bounded, Composite

from warmprior import keys
from warmprior.rl.decoder import PriorDecoder
from warmprior.transforms.inner_step import EnvTransform

__all__ = ["PriorSpace"]


class PriorSpace(EnvTransform):
    r"""Makes the residual the environment's action: :math:`\Delta \in [-\delta, \delta]^{P \times d_a}`.

    The other way to use :class:`~warmprior.PriorDecoder`, for agents and tools that expect a plain
    environment with a bounded action. The transitions are those of ``TensorDictSequential(agent, decoder)``,
    with the source and the chunk under other keys:

    ========================================  =====================================================
    ``TensorDictSequential(agent, decoder)``  ``PriorSpace(decoder)``
    ========================================  =====================================================
    ``("prior", "noise")``                    ``("next", "decoded", "noise")``
    ``("vla_action", "chunk")``               ``("next", "decoded", "chunk")``
    ========================================  =====================================================

    (TorchRL drops what an inverse transform writes, so they are part of the next state. Under their usual
    names they would be mistaken for those of the next step.)

    Append it last, after :class:`~warmprior.PriorAnchor`, and outside batched environments: inside, every
    worker would hold a copy of the network.

    Args:
        decoder: the frozen policy.

    Raises:
        KeyError: if :class:`~warmprior.ChunkStep` or :class:`~warmprior.PriorAnchor` does not come before.
        ValueError: if the environment's chunks are not the policy's, see
            :meth:`PriorDecoder.check_env`.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from warmprior import PastPrior, PriorAnchor, PriorDecoder, PriorSpace, VelocityMLP
        >>> from warmprior import WarmPriorActor, policy_transforms
        >>> from warmprior.envs import NavigationEnv
        >>> actor = WarmPriorActor(VelocityMLP(1, 9, 4, observation_steps=1), PastPrior(4), nfe=1)
        >>> transforms = policy_transforms(actor.prior, observation_steps=1)
        >>> transforms.append(PriorAnchor(actor))
        >>> transforms.append(PriorSpace(PriorDecoder(actor, delta=0.5)))
        >>> env = TransformedEnv(NavigationEnv(batch_size=[3]), transforms)
        >>> env.action_keys, env.full_action_spec["prior", "delta"].shape
        ([('prior', 'delta')], torch.Size([3, 4, 1]))
        >>> env.rollout(2)["next", "decoded", "chunk"].shape
        torch.Size([3, 2, 4, 1])
    """

    def __init__(self, decoder: PriorDecoder) -> None:
        written = [keys.DECODED_NOISE, keys.DECODED_CHUNK]
        super().__init__(out_keys=written, in_keys_inv=[keys.CHUNK], out_keys_inv=[keys.DELTA])
        self.decoder = decoder

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.decoder(tensordict)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        for key, out_key in zip(self.decoder.out_keys, self.out_keys, strict=True):
            next_tensordict.set(out_key, tensordict.get(key))
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        anchor = self._anchor_of(tensordict_reset)
        for key in self.out_keys:
            tensordict_reset.set(key, torch.zeros_like(anchor))
        return tensordict_reset

    def _anchor_of(self, observations: Any) -> Any:
        if keys.ANCHOR not in observations.keys(True, True):
            raise KeyError(
                f"PriorSpace found no {keys.ANCHOR} among the observations: append it after PriorAnchor"
            )
        return observations[keys.ANCHOR]

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Replace the chunk by the bounded residual."""
        self.decoder.check_env(self.parent)
        actions = input_spec["full_action_spec"]
        leaf, delta = actions[keys.CHUNK], self.decoder.delta
        actions[keys.DELTA] = Bounded(-delta, delta, leaf.shape, dtype=leaf.dtype, device=leaf.device)
        # With its branch, which would count as an action when it is empty.
        del actions[keys.CHUNK[0]]
        return input_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the source and the chunk."""
        anchor = self._anchor_of(observation_spec)
        for key in self.out_keys:
            observation_spec[key] = anchor.clone()
        return observation_spec
