"""What every source distribution is: where the flow of an action chunk starts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor

from warmprior.modules.checks import check_finite_numbers
from warmprior.modules.named_prior import NamedPrior

__all__ = ["Prior"]

WARM_ARGUMENTS = frozenset({"sigma", "cold_probability", "correlation"})
"""Arguments without effect where nothing is ever warm."""


class Prior(NamedPrior):
    r"""Base class of the source distributions; subclass it to try your own.

    A prior is a Gaussian around a mean on the *warm* positions and standard normal on the *cold* ones
    (`WarmPrior <https://sinnnj.github.io/WarmPrior/>`_, Eq. 1):

    .. math::
        a_0[\tau] = \mu_\tau + \sigma \varepsilon_\tau \;\; (\tau \in W), \qquad
        a_0[\tau] = \varepsilon_\tau \;\; (\tau \in C), \qquad \varepsilon \sim N(0, I).

    The same object serves the replay buffer (:meth:`training_mean`), the environment
    (:meth:`next_mean`) and the actor (:meth:`sample`), so the three cannot disagree. It holds no
    state of an episode. A subclass sets :attr:`name`, and overrides the two means; overriding
    :meth:`distribution` gives another Gaussian, :meth:`sample` any other source, and :meth:`couple` another
    pairing of source and data. What else benchmarks, figures and agents need to know of it, it tells by the
    attributes below.

    The constructor's arguments are recorded, so that :meth:`config` is complete for any subclass. One
    that is an ``nn.Module`` as well (call ``nn.Module.__init__`` first) is trained, saved and frozen with
    the policy; see :class:`~warmprior.LearnedPrior` for those that learn before the flow.

    Args:
        chunk_length: ``H``, the number of actions executed per decision.

    Keyword Args:
        sigma: residual noise on warm positions, in units of the normalised action space. ``0`` is the
            deterministic limit.
        cold_probability: share of training samples whose mean is withheld, so that the network also
            learns the cold start. ``0`` is the paper's Algorithm 1.
        correlation: share of the residual noise's variance that all warm positions of a dimension have in
            common, in [0, 1]. ``0`` is the paper's white noise, which averages out over the chunk: a network
            that averages sees through it.

    Raises:
        ValueError: if ``chunk_length < 1``, ``sigma`` is not a finite number >= 0, or ``cold_probability`` or
            ``correlation`` is not in [0, 1].

    Examples:
        >>> import torch
        >>> class LastAction(Prior):  # a heuristic source: hold the last action
        ...     name = "last-action"
        ...     def training_mean(self, history, history_valid, target):
        ...         warm = history_valid[..., -1:, None].expand(*history.shape[:-1], 1)
        ...         return history[..., -1:, :].expand_as(history), warm
        ...     def next_mean(self, loc, chunk, executed_steps, elapsed_steps):
        ...         last = chunk.gather(-2, self.positions(executed_steps - 1, chunk, 1))
        ...         return last.expand_as(chunk), torch.ones_like(chunk[..., :1], dtype=torch.bool)
        >>> prior = LastAction(4, sigma=0.1)
        >>> loc, warm = prior.next_mean(
        ...     torch.zeros(2, 4, 1),
        ...     torch.arange(4.0).view(1, 4, 1).expand(2, 4, 1),
        ...     torch.tensor([[4], [2]]),
        ...     torch.tensor([[4], [2]]),
        ... )
        >>> loc[..., 0].tolist()
        [[3.0, 3.0, 3.0, 3.0], [1.0, 1.0, 1.0, 1.0]]
    """

    prediction_chunks: ClassVar[int] = 1
    """Predicted actions ``P`` per executed ones ``H``."""
    default_sigma: ClassVar[float] = 1.0
    """``sigma`` where none is given."""
    always_warm: ClassVar[bool] = False
    """Whether :meth:`anchor` holds where the window or decision has no mean, as in the first chunk of an
    episode."""
    ever_warm: ClassVar[bool] = True
    """Whether there is ever a mean. Otherwise ``sigma``, ``cold_probability`` and ``correlation`` are without
    effect."""
    is_flow: ClassVar[bool] = True
    """Whether the field is trained at all times. Otherwise it is at ``t = 0`` alone, and one network
    evaluation is all that it is good for."""
    conditions_network: ClassVar[bool] = False
    """Whether the network sees the mean as well, in an observation that :class:`~warmprior.MeanObservation`
    extends in environments and replay buffers."""
    start_time: float = 0.0
    """Time at which samplers start to integrate, see :meth:`start`."""
    least_batch: ClassVar[int] = 1
    """Windows per training step that :meth:`couple` needs."""
    teacher: ClassVar[str | None] = None
    """Name of the prior whose trained policy :meth:`couple` needs; it is handed to :meth:`learn_from`."""

    def __init__(
        self,
        chunk_length: int,
        *,
        sigma: float | None = None,
        cold_probability: float = 0.0,
        correlation: float = 0.0,
    ) -> None:
        if chunk_length < 1:
            raise ValueError(f"chunk_length must be at least 1, got {chunk_length}")
        sigma = self.default_sigma if sigma is None else sigma
        shares = {"cold_probability": cold_probability, "correlation": correlation}
        check_finite_numbers(sigma=sigma, **shares)
        if sigma < 0:
            raise ValueError(f"sigma must be a finite number >= 0, got {sigma}")
        for name, share in shares.items():
            if not 0.0 <= share <= 1.0:
                raise ValueError(f"{name} must be in [0, 1], got {share}")
        self.chunk_length = int(chunk_length)
        self.sigma = float(sigma)
        self.cold_probability = float(cold_probability)
        self.correlation = float(correlation)

    @classmethod
    def takes(cls, argument: str) -> bool:
        """Whether the constructor has such an argument, and it has an effect.

        Where nothing is ever warm, ``sigma``, ``cold_probability`` and ``correlation`` have none.

        Args:
            argument: its name.

        Examples:
            >>> [Prior.find(name).takes("correlation") for name in ("past", "gaussian", "history")]
            [True, False, False]
        """
        return super().takes(argument) and (cls.ever_warm or argument not in WARM_ARGUMENTS)

    @property
    def moves_source(self) -> bool:
        """Whether :meth:`anchor` is the centre of the source, so that an agent can search around it.

        It is not if nothing is ever warm, or if the mean conditions the network instead.
        """
        return self.ever_warm and not self.conditions_network

    @property
    def residual_sigma(self) -> float:
        """What residuals without an agent are drawn with: the typical deviation of :meth:`start` from the
        centre of the agent's search.

        By default ``sigma`` around :meth:`anchor`. Around zero, where the source is not centred
        (:attr:`moves_source`), 1: that of a standard normal one, and as wide as normalised actions are.
        """
        return self.sigma if self.moves_source else 1.0

    @property
    def needs_vector(self) -> bool:
        """Whether it reads the observation, and as one tensor: it cannot go with images."""
        return False

    @property
    def is_gaussian(self) -> bool:
        """Whether the source is that of Eq. 1, drawn independently of the data given the mean."""
        return all(
            getattr(type(self), name) is getattr(Prior, name)
            for name in ("distribution", "sample", "couple", "start")
        )

    @property
    def prediction_length(self) -> int:
        """``P``, the number of actions that the network predicts."""
        return self.chunk_length * self.prediction_chunks

    def sized(self, action_dim: int, observation_dim: int, observation_steps: int) -> Prior:
        """The prior for data of these widths: itself, unless it has networks of its own.

        Args:
            action_dim: ``d_a``.
            observation_dim: ``d_o`` of what the network sees.
            observation_steps: ``To``.
        """
        return self

    def training_mean(
        self, history: Tensor, history_valid: Tensor, target: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Mean of the source for a window cut from demonstrations.

        Args:
            history: the ``H`` actions before the window, ``[*B, H, d_a]``.
            history_valid: which of them lie inside the episode, bool ``[*B, H]``.
            target: the chunk to predict, ``[*B, P, d_a]``.

        Returns:
            ``loc`` ``[*B, P, d_a]`` and ``warm``, bool ``[*B, P, 1]``.
        """
        raise NotImplementedError

    def next_mean(
        self, loc: Tensor, chunk: Tensor, executed_steps: Tensor, elapsed_steps: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Mean of the source at the next decision, after ``k <= H`` actions of ``chunk`` were executed.

        Args:
            loc: mean at the decision just taken, ``[*B, P, d_a]``.
            chunk: the prediction just made, ``[*B, P, d_a]``.
            executed_steps: ``k``, int64 ``[*B, 1]``.
            elapsed_steps: actions executed since the reset, ``k`` included, int64 ``[*B, 1]``.

        Returns:
            ``loc`` ``[*B, P, d_a]`` and ``warm``, bool ``[*B, P, 1]``.
        """
        raise NotImplementedError

    def distribution(
        self, loc: Tensor, warm: Tensor, observation: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the source (Eq. 1).

        Args:
            loc: mean of the window or decision, ``[*B, P, d_a]``; ignored on cold positions.
            warm: bool ``[*B, P, 1]``.
            observation: what the network sees, ``[*B, To, d_o]``; the paper's sources make no use of it.

        Returns:
            Both, each broadcastable to ``[*B, P, d_a]``.
        """
        one = torch.ones((), dtype=loc.dtype, device=loc.device)
        return torch.where(warm, loc, 0.0), torch.where(warm, self.sigma * one, one)

    def sample(
        self,
        loc: Tensor,
        warm: Tensor,
        generator: torch.Generator | None = None,
        observation: Tensor | None = None,
    ) -> Tensor:
        """Draw the source ``a_0`` from :meth:`distribution`.

        Args:
            loc: see :meth:`distribution`.
            warm: see :meth:`distribution`.
            generator: source of randomness on ``loc``'s device; PyTorch's global one by default.
            observation: see :meth:`distribution`.

        Returns:
            ``a_0``, ``[*B, P, d_a]``.
        """
        like: dict[str, Any] = {"dtype": loc.dtype, "device": loc.device, "generator": generator}
        eps = torch.randn(loc.shape, **like)
        if self.correlation:
            common = torch.randn((*loc.shape[:-2], 1, loc.shape[-1]), **like)
            own, shared = math.sqrt(1.0 - self.correlation), math.sqrt(self.correlation)
            eps = torch.where(warm, own * eps + shared * common, eps)
        mean, scale = self.distribution(loc, warm, observation)
        return mean + scale * eps

    def start(
        self,
        loc: Tensor,
        warm: Tensor,
        generator: torch.Generator | None = None,
        observation: Tensor | None = None,
    ) -> Tensor:
        """Where samplers start to integrate, at :attr:`start_time`: by default a draw of the source.

        Args:
            loc: see :meth:`distribution`.
            warm: see :meth:`distribution`.
            generator: see :meth:`sample`.
            observation: see :meth:`distribution`.

        Returns:
            A point at :attr:`start_time`, ``[*B, P, d_a]``.
        """
        return self.sample(loc, warm, generator, observation)

    def anchor(self, loc: Tensor, warm: Tensor, observation: Tensor | None = None) -> Tensor:
        """Mean of :meth:`start`, around which an agent searches: that of :meth:`distribution` by default.

        It counts on warm positions, or on all (:attr:`always_warm`), if the prior :attr:`moves_source`.

        Args:
            loc: see :meth:`distribution`.
            warm: see :meth:`distribution`.
            observation: see :meth:`distribution`.

        Returns:
            A point at :attr:`start_time`, broadcastable to ``[*B, P, d_a]``.
        """
        return self.distribution(loc, warm, observation)[0]

    def couple(
        self,
        a0: Tensor,
        a1: Tensor,
        generator: torch.Generator | None = None,
        observation: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Pair the sources and targets of a batch; as they come by default.

        Called in training between :meth:`sample` and the loss. The observations belong to the targets:
        permute ``a0`` (optimal transport), or replace ``a1`` by what a teacher makes of ``a0`` (reflow).

        Args:
            a0: source samples, ``[*B, P, d_a]``.
            a1: targets, ``[*B, P, d_a]``.
            generator: source of randomness on their device; PyTorch's global one by default.
            observation: what the network sees, ``[*B, To, d_o]``.

        Returns:
            Both, paired.
        """
        return a0, a1

    def learn_from(self, policy: Any) -> None:
        """Take the trained policy of the :attr:`teacher` prior, for :meth:`couple`.

        Args:
            policy: a :class:`~warmprior.WarmPriorActor` of the same data.
        """
        raise ValueError(f"{self.name} has no teacher")

    def allowed_nfes(self, nfes: Sequence[int]) -> list[int]:
        """Those numbers of network evaluations per chunk for which the trained field means anything.

        Args:
            nfes: to choose from; their order stays.

        Raises:
            ValueError: if none is left.

        Examples:
            >>> Prior.find("regression")(8).allowed_nfes([9, 3, 1])
            [1]
        """
        allowed = [nfe for nfe in nfes if self.is_flow or nfe == 1]
        if not allowed:
            raise ValueError(
                f"{self.name} is trained for one network evaluation per chunk, and {list(nfes)} has none "
                "of 1: add NFE 1, or leave it out"
            )
        return allowed

    def withhold(self, warm: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Turn a share ``cold_probability`` of the samples cold, whole samples at a time.

        Args:
            warm: bool ``[*B, P, 1]``.
            generator: source of randomness on ``warm``'s device.
        """
        if self.cold_probability == 0.0:
            return warm
        draw = torch.rand(warm.shape[:-2], generator=generator, device=warm.device)
        return warm & (draw >= self.cold_probability)[..., None, None]

    @staticmethod
    def positions(start: Tensor, like: Tensor, length: int) -> Tensor:
        """Gather index of the ``length`` time steps from ``start`` (``[*B, 1]``) on, along dim -2."""
        index = start + torch.arange(length, device=start.device)
        return index.unsqueeze(-1).expand(*index.shape, like.shape[-1])
