"""The policy: prior sampler and ODE actor as one stateless TensorDict module."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import nn

from warmprior import keys
from warmprior.modules.normalize import Normalizer
from warmprior.modules.ode import ODEActor, Solver
from warmprior.modules.prior import Prior
from warmprior.modules.real_time_chunking import RealTimeChunking
from warmprior.modules.sampler import PriorSampler
from warmprior.modules.start import StartPoint

__all__ = ["WarmPriorActor"]


class WarmPriorActor(TensorDictModuleBase):
    """Flow-matching policy with a choice of source: ``(observation, history) -> (loc, warm, noise, chunk)``.

    Composes :class:`PriorSampler` and :class:`ODEActor`. It holds no state between calls.
    :class:`~warmprior.ActionHistory` in an environment, and :class:`~warmprior.ActionWindow` in a replay
    buffer, write the history that it reads, so it works unchanged in ``env.rollout``, collectors, batched
    environments and replay buffers. It ignores TorchRL's ``ExplorationType``, because a flow needs its noise:
    seed the generator, or take a prior with ``sigma=0``.

    Args:
        network: velocity network, see :class:`ODEActor`.
        prior: the source distribution.

    Keyword Args:
        nfe: network evaluations per chunk; per call: ``actor(data, nfe=1)``. 9 by default, or ``max_nfe``.
        max_nfe: the largest ``nfe`` that the training allows: 1 for a network that was trained at ``t = 0``
            alone. Saved with the policy.
        start: the point from which samplers start, if that is not the source itself.
        solver: see :func:`~warmprior.modules.ode.integrate`.
        grid: see :func:`~warmprior.modules.ode.integrate`.
        clip: see :class:`ODEActor`.
        guidance: makes chunks continue the one being executed; none by default.
        normalizer: the normaliser of the data, saved with the policy; its
            :meth:`~warmprior.Normalizer.env_transforms` go next to the base environment.
        environment: JSON description of the environment that the policy was made for, saved with the policy
            (``python -m warmprior evaluate FOLDER``).
        generator: source of randomness of the sampler; per call: ``actor(data, generator=...)``.
        observation_key: key of the observation, ``[*B, To, d_o]``, or of several nested under it;
            :data:`warmprior.keys.CONDITIONED` where the network sees the last actions
            (:class:`~warmprior.HistoryObservation`).

    Raises:
        ValueError: if the network was built for another prediction length than the prior's, ``nfe`` exceeds
            ``max_nfe``, the grid is unknown, or the policy to guide is no flow.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior.history import cold_history
        >>> prior = PastPrior(chunk_length=8)
        >>> actor = WarmPriorActor(VelocityMLP(7, 23, prior.prediction_length), prior, nfe=1)
        >>> data = TensorDict({
        ...     "observation": torch.zeros(2, 23),  # [To, d_o]: one environment
        ...     "history": cold_history([], 8, 8, action_dim=7),
        ... }, [])
        >>> actor(data)["vla_action", "chunk"].shape
        torch.Size([8, 7])
    """

    def __init__(
        self,
        network: nn.Module,
        prior: Prior,
        *,
        nfe: int | None = None,
        max_nfe: int | None = None,
        start: StartPoint | None = None,
        solver: Solver = "euler",
        grid: str = "uniform",
        clip: float | Sequence[float] | None = None,
        guidance: RealTimeChunking | None = None,
        normalizer: Normalizer | None = None,
        environment: Mapping[str, Any] | None = None,
        generator: torch.Generator | None = None,
        observation_key: NestedKey = keys.OBSERVATION,
    ) -> None:
        super().__init__()
        built_for = getattr(network, "prediction_length", prior.prediction_length)
        if built_for != prior.prediction_length:
            raise ValueError(
                f"the network was built for prediction_length={built_for}, but {prior} needs "
                f"{prior.prediction_length}"
            )
        self._nfe_was_given = nfe is not None
        self.sampler = PriorSampler(prior, start=start, observation_key=observation_key, generator=generator)
        self.ode = ODEActor(
            network,
            nfe=nfe,
            max_nfe=max_nfe,
            start_time=0.0 if start is None else start.time,
            solver=solver,
            grid=grid,
            clip=clip,
            guidance=guidance,
            observation_key=observation_key,
        )
        self.normalizer = normalizer
        self.environment = environment
        guided = [] if guidance is None else [keys.DELAY]
        self.in_keys = list(dict.fromkeys([observation_key, *self.sampler.in_keys, *guided]))
        self.out_keys = [*self.sampler.out_keys, *self.ode.out_keys]

    @property
    def prior(self) -> Prior:
        """The source distribution."""
        return self.sampler.prior

    @property
    def start(self) -> StartPoint | None:
        """The point from which samplers start, if that is not the source itself."""
        return self.sampler.start

    @property
    def network(self) -> nn.Module:
        """The velocity network."""
        return self.ode.network

    def forward(
        self, tensordict: TensorDictBase, nfe: int | None = None, generator: torch.Generator | None = None
    ) -> TensorDictBase:
        """Sample the source and integrate it to the chunk."""
        return self.integrate(self.sampler(tensordict, generator=generator), nfe=nfe)

    def integrate(self, tensordict: TensorDictBase, nfe: int | None = None) -> TensorDictBase:
        """Integrate a given source sample to the chunk, with the policy's guidance.

        The sample, ``[*B, P, d_a]``, stands under ``keys.NOISE``.
        """
        sigma = None if self.ode.guidance is None else self.sampler.source(tensordict).scale
        return self.ode(tensordict, nfe=nfe, sigma=sigma)

    def replace(self, **changes: Any) -> WarmPriorActor:
        """A copy of the policy, with the same parts, and some constructor arguments changed.

        Args:
            changes: constructor arguments, such as ``nfe``, ``generator`` or ``network``. A smaller
                ``max_nfe`` lowers ``nfe``.

        Examples:
            >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor
            >>> actor = WarmPriorActor(VelocityMLP(2, 3, 4), PastPrior(4))
            >>> one_step = actor.replace(nfe=1)
            >>> actor.ode.nfe, one_step.ode.nfe, one_step.network is actor.network
            (9, 1, True)
        """
        ode = self.ode
        mine = {
            "network": self.network,
            "prior": self.prior,
            "nfe": ode.nfe if self._nfe_was_given else None,
            "max_nfe": ode.max_nfe,
            "start": self.start,
            "solver": ode.solver,
            "grid": ode.grid,
            "clip": ode.clip,
            "guidance": ode.guidance,
            "normalizer": self.normalizer,
            "environment": self.environment,
            "generator": self.sampler.generator,
            "observation_key": self.in_keys[0],
        }
        options = mine | changes
        if "nfe" not in changes and ode.nfe > (options["max_nfe"] or ode.nfe):
            options["nfe"] = None
        return type(self)(**options)
