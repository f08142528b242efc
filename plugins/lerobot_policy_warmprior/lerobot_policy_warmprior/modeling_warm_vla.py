"""SmolVLA and PI05 with the source of a prior: the policy's own methods go through the adapter."""

from __future__ import annotations

import inspect
from typing import Any

import torch
from lerobot.configs.types import NormalizationMode
from lerobot.policies.pi05.modeling_pi05 import PI05Policy
from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy
from torch import Tensor

from lerobot_policy_warmprior.check_observed import check_observed
from lerobot_policy_warmprior.configuration_warm_vla import WarmPI05Config, WarmSmolVLAConfig
from lerobot_policy_warmprior.loading import WholePolicy, check_known, check_statistics
from warmprior.checks import check_choice
from warmprior.lerobot import WarmPriorAdapter, action_std
from warmprior.lerobot.adapter import LEFT_OVER

IDENTITY = NormalizationMode.IDENTITY

REAL_TIME = ("inference_delay", LEFT_OVER, "execution_horizon")
"""Arguments that LeRobot's real-time chunking passes."""


class WarmPolicyMixin(WholePolicy):
    """Base class in front of a policy of LeRobot, so that its losses and chunks start from the prior.

    ``dataset_stats`` and ``dataset_meta`` are those of the training dataset, which give ``action_std``.
    """

    warm_adapter: Any

    def __init__(self, config: Any, *, dataset_stats: Any = None, dataset_meta: Any = None) -> None:
        if getattr(config, "use_relative_actions", False):
            raise ValueError(
                "use_relative_actions=true needs the robot's state at both decisions: use "
                "warmprior.lerobot.WarmPriorAdapter with RelativeActions around the policy"
            )
        self.__dict__["warm_adapter"] = None  # the policy's own constructor calls reset
        if dataset_meta is not None:
            check_statistics(config, dataset_meta)
        super().__init__(config)
        check_choice("sigma_unit", config.sigma_unit, ("model", "std"))
        if config.sigma_unit == "std" and (config.action_std is None or dataset_meta is not None):
            config.action_std = action_std(self, dataset_stats).tolist()
        std = torch.tensor(config.action_std) if config.sigma_unit == "std" else None
        prior = config.make_prior()
        # Not a submodule: it refers back to the policy.
        self.__dict__["warm_adapter"] = WarmPriorAdapter(
            self,
            prior,
            std=std,
            cold_probability=config.cold_probability,
        )

    def forward(self, batch: dict[str, Any], *args: Any, **kwargs: Any) -> Any:
        """Return the policy's own loss, with source samples from the prior."""
        forward = super().forward
        arguments = inspect.signature(forward).bind(batch, *args, **kwargs).arguments
        return self.warm_adapter.loss(arguments.pop("batch"), forward, **arguments)

    def select_action(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """Return the next action of every environment."""
        check_known("select_action", kwargs, ["noise"])
        self._check_observed(batch)
        return self.warm_adapter.select_action(batch, super().select_action, **kwargs)  # type: ignore[misc]

    def predict_action_chunk(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """Return a new chunk; ``executed_steps=`` is the number of executed actions of the last one.

        ``prev_chunk_left_over=``, which LeRobot's real-time chunking passes, gives it as well.
        """
        executed = kwargs.pop("executed_steps", None)
        check_known("predict_action_chunk", kwargs, ["noise", *REAL_TIME])
        rtc = getattr(self.config, "rtc_config", None)
        if rtc is not None and not rtc.enabled and LEFT_OVER in kwargs and executed is None:
            raise ValueError(
                "with --inference.rtc.enabled=false chunks are executed one after the other, however late, "
                "so the executed actions are unknown: turn it on, or use --inference.type=sync"
            )
        self._check_observed(batch)
        predict = super().predict_action_chunk  # type: ignore[misc]
        return self.warm_adapter.predict_action_chunk(batch, executed, predict, **kwargs)

    def _check_observed(self, batch: dict[str, Any]) -> None:
        config: Any = self.config
        vectors = config.input_features.keys() - config.image_features.keys()
        scaled = config.normalization_mapping.get("VISUAL", IDENTITY) != IDENTITY
        # GR00T's processor packs images, and names the state otherwise.
        check_observed(batch, [*vectors, "state"], () if scaled else config.image_features)

    def reset(self) -> None:
        """Start new episodes in all environments."""
        super().reset()  # type: ignore[misc]
        if self.warm_adapter is not None:
            self.warm_adapter.forget()


class WarmSmolVLAPolicy(WarmPolicyMixin, SmolVLAPolicy):
    """SmolVLA whose chunks start from a prior; its checkpoints load unchanged."""

    config_class = WarmSmolVLAConfig
    name = "warm_smolvla"


class WarmPI05Policy(WarmPolicyMixin, PI05Policy):
    """PI05 whose chunks start from a prior; its checkpoints load unchanged."""

    config_class = WarmPI05Config
    name = "warm_pi05"
