"""Sources that learn from the demonstrations before the flow does."""

from __future__ import annotations

from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from warmprior.modules.checks import check_whole_numbers
from warmprior.modules.learning_windows import LearningWindows
from warmprior.modules.priors import PastPrior

__all__ = ["LearnedPrior"]


class LearnedPrior(PastPrior, nn.Module):
    r"""Base class of priors with a network :math:`f_\phi(o, \mu)` of observation and last ``H`` actions.

    It learns by a loss of its own, on the windows that the flow will be trained on
    (:func:`~warmprior.training.learn_prior`), and is fixed from then on: the flow, and the moments that it
    is preconditioned with, see one and the same source. The mean that it starts from,
    :math:`\mu`, is that of :class:`PastPrior`. Subclasses make their networks in :meth:`build`, and override
    :meth:`learning_loss` and :meth:`distribution` (or :meth:`sample`). Observations are single tensors.

    Args:
        chunk_length: ``H``.

    Keyword Args:
        action_dim: ``d_a``; like the other widths it is filled in by :meth:`sized`.
        observation_dim: ``d_o``.
        observation_steps: ``To``.
        hidden_dim: width of the network's two hidden layers.
        sigma: see the subclass.
        cold_probability: see :class:`Prior`; without effect if the network is given no last actions.

    Raises:
        ValueError: if only some of the widths are given, or one is no whole number of at least 1.

    Examples:
        >>> import torch
        >>> from torch import nn
        >>> class Shifted(LearnedPrior):  # the last chunk, with a learned shift
        ...     name = "shifted"
        ...     def build(self):
        ...         self.shift = nn.Parameter(torch.zeros(self.action_dim))
        ...     def distribution(self, loc, warm, observation=None):
        ...         return super().distribution(loc + self.shift, warm, observation)
        ...     def learning_loss(self, windows, generator=None):
        ...         error = windows.a1 - windows.loc - self.shift
        ...         return windows.mean(windows.warm * error.square())
        >>> prior = Shifted(4, sigma=0.1)
        >>> prior.is_sized, prior.sized(action_dim=2, observation_dim=3, observation_steps=1).shift
        (False, Parameter containing: tensor([0., 0.]))
    """

    sees_history: ClassVar[bool] = True
    """Whether the network is given the last actions."""
    sees_observation: ClassVar[bool] = True
    """Whether the network is given the observation."""
    untold = PastPrior.untold | {"action_dim", "observation_dim", "observation_steps"}
    action_dim: int
    observation_dim: int
    observation_steps: int

    def __init__(
        self,
        chunk_length: int,
        *,
        action_dim: int | None = None,
        observation_dim: int | None = None,
        observation_steps: int | None = None,
        hidden_dim: int = 256,
        sigma: float | None = None,
        cold_probability: float = 0.0,
    ) -> None:
        nn.Module.__init__(self)
        super().__init__(chunk_length, sigma=sigma, cold_probability=cold_probability)
        given = (action_dim, observation_dim, observation_steps)
        widths = [width for width in given if width is not None]
        if len(widths) not in (0, 3):
            raise ValueError(
                f"{type(self).__name__} needs action_dim, observation_dim and observation_steps, or none of "
                f"them, got {given}"
            )
        check_whole_numbers(hidden_dim=hidden_dim)
        if widths:
            check_whole_numbers(
                action_dim=action_dim,
                observation_dim=observation_dim,
                observation_steps=observation_steps,
            )
        self.hidden_dim, self.is_sized = hidden_dim, bool(widths)
        if self.is_sized:
            self.action_dim, self.observation_dim, self.observation_steps = widths
            self.build()
            self.requires_grad_(False)

    @classmethod
    def takes(cls, argument: str) -> bool:
        """Whether the constructor has such an argument, and it has an effect.

        A network without the last actions does not notice that they are withheld: where it is given none
        (:attr:`sees_history`), ``cold_probability`` has no effect.

        Args:
            argument: its name.

        Examples:
            >>> from warmprior import Prior
            >>> [Prior.find(name).takes("cold_probability") for name in ("forecast", "leap")]
            [True, False]
        """
        return super().takes(argument) and (cls.sees_history or argument != "cold_probability")

    @property
    def needs_vector(self) -> bool:
        """If the network is given the observation."""
        return self.sees_observation

    @property
    def chunk_dim(self) -> int:
        """Numbers in a chunk, ``P d_a``."""
        return self.prediction_length * self.action_dim

    @property
    def seen_dim(self) -> int:
        """Numbers that the network is given.

        Raises:
            ValueError: if the widths are not known.
        """
        self._check_sized()
        history = self.chunk_length * self.action_dim + 1
        observed = self.observation_steps * self.observation_dim
        return self.sees_history * history + self.sees_observation * observed

    def build(self) -> None:
        """Make the networks, once the widths are known."""
        raise NotImplementedError

    def mlp(self, inputs: int, outputs: int) -> MLP:
        """A network of the prior's width.

        Args:
            inputs: its number of inputs.
            outputs: its number of outputs.
        """
        return MLP(inputs, outputs, num_cells=[self.hidden_dim] * 2, activation_class=nn.GELU)

    def sized(self, action_dim: int, observation_dim: int, observation_steps: int) -> Self:
        """The prior with fresh networks for data of these widths; itself if it has them already."""
        widths: dict[str, Any] = {
            "action_dim": action_dim,
            "observation_dim": observation_dim,
            "observation_steps": observation_steps,
        }
        if self.is_sized:
            mine = {name: getattr(self, name) for name in widths}
            if mine != widths:
                raise ValueError(f"{self.name} was built for {mine}, but the data have {widths}")
            return self
        return type(self)(**(self._resolved() | widths))

    def seen(self, loc: Tensor, warm: Tensor, observation: Tensor | None) -> Tensor:
        """What the network is given, ``[*B, seen_dim]``.

        Raises:
            ValueError: if there is no observation or a nested one, or the networks were not built.
        """
        self._check_sized()
        parts = []
        if self.sees_observation:
            if observation is None:
                raise ValueError(
                    f"{self.name} needs the observation: give the sampler its observation_key"
                )
            if not isinstance(observation, Tensor):
                raise ValueError(
                    f"{self.name} takes one tensor [*B, To, d_o] as the observation, and no nested one: "
                    "concatenate its entries, or use a prior that sees none"
                )
            parts.append(observation.flatten(-2))
        if self.sees_history:
            known = warm[..., 0, :].to(loc.dtype)
            parts += [torch.where(warm, loc, 0.0).flatten(-2), known]
        return torch.cat(parts, -1)

    def _check_sized(self) -> None:
        if not self.is_sized:
            raise ValueError(
                f"{self.name} has no networks yet: take prior.sized(d_a, d_o, To), and learn_prior to "
                "train it"
            )

    def learning_loss(
        self, windows: LearningWindows, generator: torch.Generator | None = None
    ) -> Tensor:
        """What the prior's networks minimise.

        Args:
            windows: to learn from.
            generator: source of randomness on their device.

        Returns:
            A scalar.
        """
        raise NotImplementedError

    def calibrate(self, windows: LearningWindows) -> None:
        """Correct the source by its error on windows that it did not learn from; nothing by default.

        Args:
            windows: of episodes that were held out.
        """
