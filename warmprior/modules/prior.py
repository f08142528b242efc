"""What every source distribution is: where the flow of an action chunk starts."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor

__all__ = ["Prior"]


class Prior:
    r"""Base class of the source distributions; subclass it to try your own.

    A prior is a Gaussian around a mean on the *warm* positions and standard normal on the *cold* ones
    (`WarmPrior <https://sinnnj.github.io/WarmPrior/>`_, Eq. 1):

    .. math::
        a_0[\tau] = \mu_\tau + \sigma \varepsilon_\tau \;\; (\tau \in W), \qquad
        a_0[\tau] = \varepsilon_\tau \;\; (\tau \in C), \qquad \varepsilon \sim N(0, I).

    The same object serves the replay buffer (:meth:`training_mean`), the environment
    (:meth:`next_mean`) and the actor (:meth:`sample`), so the three cannot disagree. It holds no
    state. A subclass sets :attr:`name` and :attr:`prediction_chunks`, and overrides the two means;
    overriding :meth:`sample` gives any other source.

    Args:
        chunk_length: ``H``, the number of actions executed per decision.

    Keyword Args:
        sigma: residual noise on warm positions, in units of the normalised action space. ``0`` is the
            deterministic limit.
        cold_probability: share of training samples whose mean is withheld, so that the network also
            learns the cold start. ``0`` is the paper's Algorithm 1.

    Raises:
        ValueError: if ``chunk_length < 1``, ``sigma < 0`` or ``cold_probability`` is not in [0, 1].

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

    name: ClassVar[str]
    prediction_chunks: ClassVar[int] = 1
    default_sigma: ClassVar[float] = 1.0
    max_nfe: ClassVar[int | None] = None
    """The most network evaluations per chunk for which the trained field means anything."""
    conditions_network: ClassVar[bool] = False
    """Whether the network sees the mean as well, see :meth:`extend_observation`."""
    _registry: ClassVar[dict[str, type[Prior]]] = {}

    def __init__(
        self, chunk_length: int, *, sigma: float | None = None, cold_probability: float = 0.0
    ) -> None:
        if chunk_length < 1:
            raise ValueError(f"chunk_length must be at least 1, got {chunk_length}")
        sigma = self.default_sigma if sigma is None else float(sigma)
        if not sigma >= 0 or sigma == float("inf"):
            raise ValueError(f"sigma must be a finite number >= 0, got {sigma}")
        if not 0.0 <= cold_probability <= 1.0:
            raise ValueError(f"cold_probability must be in [0, 1], got {cold_probability}")
        self.chunk_length = int(chunk_length)
        self.sigma = sigma
        self.cold_probability = float(cold_probability)

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "name" in cls.__dict__:
            Prior._registry[cls.name] = cls

    @property
    def prediction_length(self) -> int:
        """``P``, the number of actions that the network predicts."""
        return self.chunk_length * self.prediction_chunks

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

    def sample(self, loc: Tensor, warm: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Draw the source ``a_0`` (Eq. 1).

        Args:
            loc: mean, ``[*B, P, d_a]``; ignored on cold positions.
            warm: bool ``[*B, P, 1]``.
            generator: source of randomness on ``loc``'s device; PyTorch's global one by default.

        Returns:
            ``a_0``, ``[*B, P, d_a]``.
        """
        eps = torch.randn(loc.shape, generator=generator, dtype=loc.dtype, device=loc.device)
        return torch.where(warm, loc + self.sigma * eps, eps)

    def sample_times(
        self, batch_shape: torch.Size, generator: torch.Generator | None, like: Tensor
    ) -> Tensor:
        r"""Draw the times at which the field is trained: :math:`t \sim U(0, 1)` here.

        Args:
            batch_shape: ``*B``.
            generator: source of randomness on ``like``'s device.
            like: gives the device and dtype.

        Returns:
            Times in [0, 1], ``[*B]``.
        """
        return torch.rand(batch_shape, generator=generator, device=like.device, dtype=like.dtype)

    def context_dim(self, action_dim: int) -> int:
        """By how much :meth:`extend_observation` widens the observation: ``P * d_a + 1``, or 0.

        Args:
            action_dim: ``d_a``.
        """
        return self.prediction_length * action_dim + 1 if self.conditions_network else 0

    def extend_observation(self, observation: Tensor, loc: Tensor, warm: Tensor) -> Tensor:
        """What the network sees: the observation, and the mean where :attr:`conditions_network`.

        The mean (zero on cold positions) is flattened, followed by 1 if anything is warm and else 0,
        and repeated over the observation steps. The network is then built with
        ``observation_dim = d_o + prior.context_dim(d_a)``.

        Args:
            observation: ``[*B, To, d_o]``.
            loc: mean, ``[*B, P, d_a]``.
            warm: bool ``[*B, P, 1]``.

        Returns:
            ``[*B, To, d_o + context_dim]``.
        """
        if not self.conditions_network:
            return observation
        mean = torch.where(warm, loc, 0.0).flatten(-2)
        context = torch.cat([mean, warm.any(-2).to(mean)], dim=-1).unsqueeze(-2)
        steps = observation.shape[-2]
        context = context.expand(*context.shape[:-2], steps, -1)
        return torch.cat([observation, context], dim=-1)

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

    def config(self) -> dict[str, Any]:
        """JSON-serialisable description; :meth:`from_config` reverses it."""
        return {
            "name": self.name,
            "chunk_length": self.chunk_length,
            "sigma": self.sigma,
            "cold_probability": self.cold_probability,
        }

    @staticmethod
    def from_config(config: dict[str, Any]) -> Prior:
        """Build a prior from :meth:`config`'s output; subclasses are found by their :attr:`name`.

        Raises:
            ValueError: if no imported class has that name.

        Examples:
            >>> Prior.from_config({"name": "past", "chunk_length": 8})
            PastPrior(chunk_length=8, sigma=0.5, cold_probability=0.0)
        """
        kwargs = dict(config)
        name = kwargs.pop("name", None)
        if name not in Prior._registry:
            known = ", ".join(sorted(Prior._registry))
            raise ValueError(
                f"unknown prior {name!r}; known: {known}. Import the module that defines a custom "
                "prior before loading it."
            )
        return Prior._registry[name](**kwargs)

    def describe(self) -> str:
        """The prior in a few words, for progress bars and figures.

        Examples:
            >>> Prior.from_config({"name": "past", "chunk_length": 8}).describe()
            'past, sigma 0.5, H 8'
        """
        return f"{self.name}, sigma {self.sigma:g}, H {self.chunk_length}"

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}(chunk_length={self.chunk_length}, sigma={self.sigma}, "
            f"cold_probability={self.cold_probability})"
        )
