"""Priors: the source of an action chunk as a function of the history."""

from __future__ import annotations

from typing import ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import ReplayBuffer

from warmprior.checks import check_between, check_not_negative, check_shape, check_whole_numbers
from warmprior.history import check_history
from warmprior.modules.registry import Registered
from warmprior.modules.source import Source


class Prior(Registered):
    r"""Base class of source distributions; a prior of your own overrides :meth:`mean`.

    A prior is a Gaussian around a mean on the *warm* positions and standard normal on the *cold* ones
    (`WarmPrior <https://sinnnj.github.io/WarmPrior/>`_, Eq. 1):

    .. math::
        a_0[\tau] = \mu_\tau + \sigma \varepsilon_\tau \;\; (\tau \in W), \qquad
        a_0[\tau] = \varepsilon_\tau \;\; (\tau \in C), \qquad \varepsilon \sim N(0, I).

    The mean is a function of the history (:mod:`warmprior.history`), which has the same layout in training
    and deployment. Override :meth:`distribution` for another source, such as a learned one: a subclass that
    is also an ``nn.Module`` (call ``nn.Module.__init__`` first) is trained with the flow, and saved with the
    policy. One that overrides :meth:`fit` learns before the flow, and is then frozen.

    Args:
        chunk_length: ``H``, the number of actions executed per decision.
        sigma: standard deviation around the mean, in normalised action units; 0 is the deterministic limit.
        correlation: share of the noise's variance that is common to all warm positions of a dimension, in
            [0, 1]. 0 is the paper's white noise, which a network can remove by averaging over the chunk.

    Raises:
        ValueError: if a number is out of range.

    Examples:
        >>> import torch
        >>> from warmprior import Prior
        >>> from warmprior.history import advance, cold_history
        >>> class LastAction(Prior):  # hold the last action
        ...     def mean(self, history):
        ...         actions, warm = history["actions"], (history["steps"] > 0).unsqueeze(-1)
        ...         return actions[..., -1:, :].expand_as(actions), warm.expand_as(actions[..., :1])
        >>> chunk, executed = torch.arange(4.0).view(1, 4, 1).expand(2, 4, 1), torch.tensor([[4], [2]])
        >>> history = advance(cold_history([2], 4, 4, 1), chunk, executed)
        >>> LastAction(4, sigma=0.1).distribution(history).loc[..., 0].tolist()
        [[3.0, 3.0, 3.0, 3.0], [1.0, 1.0, 1.0, 1.0]]
    """

    prediction_chunks: int = 1
    """The ratio ``P / H`` of predicted to executed actions."""
    default_sigma: ClassVar[float] = 1.0
    """The ``sigma`` used if none is given."""

    def __init__(self, chunk_length: int, *, sigma: float | None = None, correlation: float = 0.0) -> None:
        check_whole_numbers(chunk_length=chunk_length)
        sigma = self.default_sigma if sigma is None else sigma
        check_not_negative(sigma=sigma)
        check_between(0.0, 1.0, correlation=correlation)
        self.chunk_length = int(chunk_length)
        self.sigma = float(sigma)
        self.correlation = float(correlation)

    @property
    def prediction_length(self) -> int:
        """The number ``P`` of actions that the network predicts."""
        return self.chunk_length * self.prediction_chunks

    @property
    def history_length(self) -> int:
        """The number of executed actions that :meth:`mean` needs, at least ``H``."""
        return self.chunk_length

    def mean(self, history: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return the mean ``loc`` ``[*B, P, d_a]`` and the mask ``warm``, bool ``[*B, P, 1]``.

        They are for histories ``[*B]``. ``loc`` is ignored where ``warm`` is False. In training, only the
        first ``P - H`` steps of the forecast are known.
        """
        raise NotImplementedError(f"{type(self).__name__} needs a method mean(history)")

    def distribution(
        self, history: TensorDictBase, observation: Tensor | TensorDictBase | None = None
    ) -> Source:
        """Return the source for histories ``[*B]`` (Eq. 1).

        The observation is the network's input, ``[*B, To, d_o]``; the paper's sources ignore it.

        Raises:
            KeyError: if an entry of the history is missing.
            ValueError: if the history's lengths differ from the prior's, or a shape of :meth:`mean` is wrong.
        """
        loc, warm = checked_mean(self, history)
        scale = torch.where(warm, self.sigma, loc.new_ones(()))  # a plain number has no dtype
        return Source(torch.where(warm, loc, 0.0), scale, warm, self.correlation)

    def fit(
        self,
        windows: ReplayBuffer,
        held_out: ReplayBuffer,
        *,
        iterations: int,
        generator: torch.Generator,
    ) -> None:
        """Learn from training windows before the flow; by default do nothing.

        :func:`~warmprior.training.train_policy` calls it once, freezes the result, and saves it with the
        policy: constructor arguments, which this method may set, and if the prior is an ``nn.Module`` its
        parameters and buffers. PyTorch's global generator, seeded, is for initial weights.

        Args:
            windows: the windows of the flow (:func:`~warmprior.window_replay_buffer`), without images.
            held_out: windows of episodes that ``windows`` leaves out, such as every tenth.
            iterations: the number of gradient steps to take.
            generator: for all other draws, on the device of the windows.
        """


def checked_mean(prior: Prior, history: TensorDictBase) -> tuple[Tensor, Tensor]:
    """Check the result of :meth:`Prior.mean`, and return it in the history's dtype."""
    check_history(history, prior.history_length, prior.prediction_length, prior)
    if getattr(prior.mean, "__module__", None) == __name__:
        return prior.mean(history)
    # A mean of a user's own may write into what it reads, which the environment keeps.
    mean, forecast = prior.mean(history.clone()), history.get("forecast")
    name = f"{type(prior).__name__}.mean"
    loc, warm = mean if isinstance(mean, tuple) and len(mean) == 2 else (mean, None)
    if getattr(warm, "dtype", None) != torch.bool:
        raise ValueError(f"{name} must return two tensors, loc and a bool warm, got {type(mean).__name__}")
    check_shape(f"loc of {name}", loc, forecast.shape)
    check_shape(f"warm of {name}", warm, (*forecast.shape[:-1], 1))
    return loc.to(forecast.dtype), warm


class GaussianPrior(Prior):
    """The usual standard normal source; no position is ever warm.

    Args:
        chunk_length: ``H``, the number of actions executed per decision.

    Examples:
        >>> from warmprior import GaussianPrior
        >>> from warmprior.history import cold_history
        >>> GaussianPrior(8).distribution(cold_history([3], 8, 8, 2)).scale.unique()
        tensor([1.])
    """

    name = "gaussian"

    def __init__(self, chunk_length: int) -> None:
        super().__init__(chunk_length)

    def mean(self, history: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return zeros; every position is cold."""
        loc = torch.zeros_like(history["forecast"])
        return loc, torch.zeros_like(loc[..., :1], dtype=torch.bool)


class PastPrior(Prior):
    """WP-Past: the mean is the last ``H`` executed actions (Eq. 2).

    No position is warm until ``H`` actions of the episode have been executed.

    Args:
        chunk_length: ``H``, the number of actions executed per decision.
        sigma: standard deviation around the mean, 0.5 by default.
        correlation: see :class:`Prior`.

    See Also:
        :class:`~warmprior.HistoryObservation`: lets the network see the last actions instead.

    Examples:
        >>> import torch
        >>> from warmprior import PastPrior
        >>> from warmprior.history import window_history
        >>> before, target = torch.tensor([[[1.0], [2.0]]]), torch.zeros(1, 2, 1)
        >>> source = PastPrior(2).distribution(
        ...     window_history(before, torch.tensor([[2]]), target, chunk_length=2))
        >>> source.loc.flatten().tolist(), source.scale.flatten().tolist(), bool(source.warm.all())
        ([1.0, 2.0], [0.5, 0.5], True)
    """

    name = "past"
    default_sigma = 0.5

    def mean(self, history: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return the last ``H`` executed actions; they are warm if there are that many."""
        warm = (history["steps"] >= self.chunk_length).unsqueeze(-1)
        loc = history["actions"][..., -self.chunk_length :, :]
        return loc, warm.expand(*loc.shape[:-1], 1)


class PreviewPrior(Prior):
    """WP-Preview: the mean is the policy's own earlier forecast of this chunk.

    The network predicts ``P = 2H`` actions. In training the forecast is the target's own first ``H`` actions
    (Eq. 3); at decisions it is the next ``H`` actions of the previous prediction (Eq. 4). The second half is
    always cold. At an episode's start the first half is cold too. Algorithm 1 never trains cold starts;
    :class:`~warmprior.WithheldHistory` does, which matters for small ``sigma``.

    Args:
        chunk_length: ``H``, the number of actions executed per decision.
        sigma: standard deviation around the mean, 1 by default.
        correlation: see :class:`Prior`.

    Examples:
        >>> import torch
        >>> from warmprior import PreviewPrior
        >>> from warmprior.history import advance, cold_history
        >>> chunk = torch.arange(4.0).view(1, 4, 1)
        >>> source = PreviewPrior(2).distribution(
        ...     advance(cold_history([1], 2, 4, 1), chunk, torch.tensor([[2]])))
        >>> source.loc.flatten().tolist(), source.warm.flatten().tolist()
        ([2.0, 3.0, 0.0, 0.0], [True, True, False, False])
    """

    name = "preview"
    prediction_chunks = 2

    def mean(self, history: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return the forecast; its first ``H`` steps are warm if it reaches that far."""
        forecast, steps = history["forecast"], history["forecast_steps"]
        position = torch.arange(self.prediction_length, device=steps.device)
        warm = (steps >= self.chunk_length) & (position < self.chunk_length)
        return forecast, warm.unsqueeze(-1)
