"""Behaviour cloning by flow matching from any source distribution."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.utils import NestedKey
from torch import nn
from torchrl.objectives.common import LossModule

from warmprior import keys
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.interpolant import Interpolant, LinearInterpolant
from warmprior.modules.network import network_observation, velocity_field

__all__ = ["FlowMatchingLoss"]


class FlowMatchingLoss(LossModule):
    r"""Conditional flow matching with the actor's own source (Algorithm 1, training).

    For each window: draw :math:`a_0` from the prior, pair it with :math:`a_1` (:meth:`Prior.couple`), draw
    :math:`t \sim U(0, 1)` (:math:`t = 0` where the prior is no flow), set
    :math:`a_t = \alpha(t) a_0 + \beta(t) a_1`, and regress
    :math:`v_\theta(t, a_t, o)` on :math:`\dot\alpha a_0 + \dot\beta a_1`. Positions past the episode's
    end do not count.

    Args:
        actor_network: the policy whose velocity network is trained; its prior gives the source.

    Keyword Args:
        interpolant: the path; by default the one that the network is preconditioned for
            (:class:`~warmprior.PreconditionedNetwork`), or the straight line.
        reduction: ``"mean"`` over unpadded coordinates (Algorithm 1 divided by their number),
            ``"sum"`` (Algorithm 1's squared norm, summed over the batch) or ``"none"``
            (``[*B, P, d_a]``, zero where padded).
        generator: source of randomness of ``t`` and :math:`a_0`; the actor sampler's by default.

    .. note::
        Keys read (all renameable by :meth:`set_keys`): ``chunk`` ``[*B, P, d_a]``, ``pad_mask`` bool
        ``[*B, P]`` (True = padded; optional), ``loc`` ``[*B, P, d_a]``, ``warm`` bool ``[*B, P, 1]``
        and ``observation`` ``[*B, To, d_o]``; by default those of the actor. Batches of any device are
        moved to the network's, where the generator has to be.

    Raises:
        ValueError: for an unknown ``reduction``, a curved path with a prior whose field is used for
            a single step, or another path than the network is preconditioned for.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import FlowMatchingLoss, PastPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior import window_replay_buffer
        >>> data = TensorDict({"observation": torch.randn(100, 3), "action": torch.randn(100, 2),
        ...                    "episode": torch.arange(100) // 25}, [100])
        >>> prior = PastPrior(8)
        >>> actor = WarmPriorActor(VelocityMLP(2, 3, prior.prediction_length), prior)
        >>> loss_module = FlowMatchingLoss(actor)
        >>> batch = window_replay_buffer(data, prior, batch_size=16).sample()
        >>> loss_module(batch)["loss_flow_matching"].backward()
    """

    @dataclass
    class _AcceptedKeys:
        """Configurable tensordict keys, see the class docstring."""

        chunk: NestedKey = keys.CHUNK
        pad_mask: NestedKey = keys.IS_PAD
        loc: NestedKey = keys.LOC
        warm: NestedKey = keys.WARM
        observation: NestedKey = keys.OBSERVATION

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    velocity_network: nn.Module
    velocity_network_params: TensorDictParams
    target_velocity_network_params: TensorDictParams

    def __init__(
        self,
        actor_network: WarmPriorActor,
        *,
        interpolant: Interpolant | None = None,
        reduction: str = "mean",
        generator: torch.Generator | None = None,
    ) -> None:
        self._in_keys: list[NestedKey] | None = None
        self._out_keys: list[NestedKey] | None = None
        super().__init__()
        if reduction not in ("none", "mean", "sum"):
            raise ValueError(f"reduction must be 'none', 'mean' or 'sum', got {reduction!r}")
        self.convert_to_functional(actor_network.network, "velocity_network")
        self.prior = actor_network.prior
        built_for = getattr(actor_network.network, "interpolant", None)
        if interpolant is None:
            interpolant = LinearInterpolant() if built_for is None else built_for
        elif built_for is not None and built_for.config() != interpolant.config():
            raise ValueError(
                f"the network is preconditioned for the path {built_for.config()}, but the loss is given "
                f"{interpolant.config()}: give both the same interpolant"
            )
        self.interpolant = interpolant
        if not self.prior.is_flow and not isinstance(self.interpolant, LinearInterpolant):
            raise ValueError(
                f"{self.prior} is evaluated with one step, which ends at the data only on a straight "
                f"path: use LinearInterpolant, not {type(self.interpolant).__name__}"
            )
        self.reduction = reduction
        self.generator = actor_network.sampler.generator if generator is None else generator
        observation, loc, warm = actor_network.in_keys
        self.set_keys(observation=observation, loc=loc, warm=warm, chunk=actor_network.chunk_key)

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        self._in_keys = None

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys that :meth:`forward` reads."""
        if self._in_keys is None:
            k = self.tensor_keys
            self._in_keys = [k.observation, k.chunk, k.pad_mask, k.loc, k.warm]
        return self._in_keys

    @in_keys.setter
    def in_keys(self, value: list[NestedKey]) -> None:
        self._in_keys = value

    @property
    def out_keys(self) -> list[NestedKey]:
        """Keys of the result."""
        return ["loss_flow_matching"] if self._out_keys is None else self._out_keys

    @out_keys.setter
    def out_keys(self, value: list[NestedKey]) -> None:
        self._out_keys = value

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Compute the loss.

        Args:
            tensordict: a batch of windows, see the class docstring.

        Returns:
            TensorDict with ``"loss_flow_matching"``, reduced as configured.

        Raises:
            KeyError: if a needed key is missing.
        """
        k = self.tensor_keys
        needed = (k.chunk, k.loc, k.warm, k.observation)
        a1, loc, warm, observation = (tensordict.get(key, None) for key in needed)
        missing = [
            key
            for key, value in zip(needed, (a1, loc, warm, observation), strict=True)
            if value is None
        ]
        if missing:
            raise KeyError(f"FlowMatchingLoss needs the keys {list(needed)}; missing: {missing}")
        weight = next(iter(self.velocity_network_params.values(True, True)), a1)
        device = weight.device
        a1, loc, warm, observation = (v.to(device) for v in (a1, loc, warm, observation))
        batch = a1.shape[:-2]
        a0 = self.prior.sample(loc, warm, self.generator, observation)
        a0, a1 = self.prior.couple(a0, a1, self.generator, observation)
        t = a1.new_zeros(batch)
        if self.prior.is_flow:
            t = torch.rand(batch, generator=self.generator, device=a1.device, dtype=a1.dtype)
        observation = network_observation(observation, batch)
        a_t, velocity = self.interpolant(a0, a1, t)
        interrupt: KeyboardInterrupt | None = None
        with self.velocity_network_params.to_module(
            self.velocity_network, preserve_module_state=False
        ):
            field = velocity_field(self.velocity_network, observation)
            try:
                predicted = field(t.reshape(-1), a_t.reshape(-1, *a1.shape[-2:]))
            except KeyboardInterrupt as key:
                interrupt = key  # leaving the context with it would make a RuntimeError of it
        if interrupt is not None:
            raise interrupt
        error = (predicted.reshape(a1.shape) - velocity).square()
        pad = tensordict.get(k.pad_mask, None)
        if pad is not None:
            pad = pad.to(device)
            error = error.masked_fill(pad.unsqueeze(-1), 0.0)
        if self.reduction == "none":
            return TensorDict({self.out_keys[0]: error}, batch_size=[])
        loss = error.sum()
        if self.reduction == "mean":
            count = error.numel() if pad is None else (~pad).sum() * error.shape[-1]
            # A batch that is padding only has no error, and must not become NaN.
            loss = loss / torch.as_tensor(count, device=loss.device).clamp_min(1)
        return TensorDict({self.out_keys[0]: loss}, batch_size=[])
