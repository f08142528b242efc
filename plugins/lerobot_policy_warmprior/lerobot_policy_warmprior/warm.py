"""What the warm policies share: options of the source, and where the policy's own methods go through it."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from warmprior import Prior
from warmprior.lerobot import WarmPriorAdapter, action_std, history_indices
from warmprior.modules.registry import find, make

__all__ = ["WarmConfigMixin", "WarmPolicyMixin"]


@dataclass
class WarmConfigMixin:
    """Options of the source, beside those of the policy.

    Attributes:
        prior: its name, with options, such as ``past``, ``preview`` or ``past,sigma=0.3``.
        prior_chunk: ``H``, the actions that it remembers; by default as many as the chunk allows.
        sigma_unit: what sigma is in units of: ``model`` or ``std``, see
            :class:`~warmprior.lerobot.WarmPriorAdapter`.
        action_std: taken from the dataset for ``std``, and kept with the policy.
        cold_probability: share of the training windows whose history is withheld.
    """

    prior: str = "past"
    prior_chunk: int | None = None
    sigma_unit: str = "model"
    action_std: list[float] | None = None
    cold_probability: float = 0.0

    def make_prior(self) -> Prior:
        """The source distribution.

        Raises:
            ValueError: if there is none of that name and these options.
        """
        kind = find(Prior, self.prior.partition(",")[0])
        room = self.chunk_size // kind.prediction_chunks
        return make(Prior, self.prior, room if self.prior_chunk is None else self.prior_chunk)

    @property
    def action_delta_indices(self) -> list[int]:
        """Steps that LeRobot loads of every action: the history, and the chunk."""
        return history_indices(self.make_prior().history_length, self.chunk_size)


class WarmPolicyMixin:
    """Comes before a policy of LeRobot: its losses and chunks start from the prior."""

    def __init__(self, config: Any, *args: Any, dataset_stats: Any = None, **kwargs: Any) -> None:
        if getattr(config, "use_relative_actions", False):
            raise ValueError(
                "use_relative_actions=true needs the robot's state at both decisions: use "
                "warmprior.lerobot.WarmPriorAdapter with RelativeActions around the policy"
            )
        self.__dict__["warm_adapter"] = None  # the policy's own constructor resets
        super().__init__(config, *args, **kwargs)
        if config.sigma_unit == "std" and config.action_std is None:
            config.action_std = action_std(self, dataset_stats).tolist()
        std = torch.tensor(config.action_std) if config.sigma_unit == "std" else None
        prior = config.make_prior()
        # Not a submodule: it refers back to the policy.
        self.__dict__["warm_adapter"] = WarmPriorAdapter(
            self,
            prior,
            sigma_unit=config.sigma_unit,
            action_std=std,
            cold_probability=config.cold_probability,
        )

    def forward(self, batch: dict[str, Any], *args: Any, **kwargs: Any) -> Any:
        """The policy's own loss, from the prior's source."""
        forward = super().forward
        arguments = inspect.signature(forward).bind(batch, *args, **kwargs).arguments
        return self.warm_adapter.loss(arguments.pop("batch"), forward, **arguments)

    def select_action(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """The next action of every environment."""
        return self.warm_adapter.select_action(batch, super().select_action, **kwargs)

    def predict_action_chunk(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """A new chunk; ``executed_steps=`` tells how much of the last one was executed."""
        executed = kwargs.pop("executed_steps", None)
        return self.warm_adapter.predict_action_chunk(batch, executed, super().predict_action_chunk, **kwargs)

    def reset(self) -> None:
        """New episodes in all environments."""
        super().reset()
        if self.warm_adapter is not None:
            self.warm_adapter.forget()
