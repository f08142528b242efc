"""The source of a LeRobot policy's chunk: a prior on its warm positions, standard normal elsewhere."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from warmprior.checks import check_positive, check_shape
from warmprior.history import check_history, cold_history, window_history, without
from warmprior.lerobot.ports import port_for
from warmprior.modules.prior import Prior
from warmprior.modules.source import Source


class ChunkSource:
    """The source ``a_0`` ``[B, T, D]`` of a chunk with ``lead`` past, ``P`` predicted and further positions.

    The prior draws the ``P`` positions from the current step on, in the ``d_a`` dimensions of the action. All
    other positions and the padded dimensions stay ``N(0, 1)``, as in pretrained checkpoints. For ``std`` see
    :class:`~warmprior.lerobot.WarmPriorAdapter`.
    """

    def __init__(self, policy: Any, prior: Prior, std: Tensor | None = None) -> None:
        self.port = port_for(policy)
        self.length, self.width = self.port.length(policy), self.port.width(policy)
        self.lead, self.action_dim = self.port.lead(policy), policy.config.action_feature.shape[0]
        self.observation_steps = policy.config.n_obs_steps
        self.prior, self._std = prior, std
        room = self.length - self.lead
        if prior.prediction_length > room:
            most = room // prior.prediction_chunks
            raise ValueError(
                f"{prior} is longer than the {room} actions of the policy: chunk_length <= {most}"
            )
        weights = prior.parameters() if isinstance(prior, nn.Module) else ()
        device = next((weight.device for weight in weights), None)
        self._lengths = prior.history_length, prior.prediction_length
        #: The slice of the prior's ``P`` positions in the chunk.
        self.positions = slice(self.lead, self.lead + prior.prediction_length)
        try:
            prior.distribution(cold_history([1], *self._lengths, self.action_dim, device=device))
        except Exception as error:
            raise ValueError(f"{prior} needs more than the history, the only input here: {error}") from error
        if std is not None:
            check_shape("std", std, (self.action_dim,))
            for value in std.tolist():
                check_positive(std=value)

    def distribution(self, history: TensorDictBase) -> Source:
        """Return the source, in units of ``sigma``, for histories ``[*B]`` in the model's units."""
        check_history(history, *self._lengths, self.prior)
        unit = self._unit(history["actions"])
        own = {name: history[name] / unit for name in ("actions", "forecast")}
        return self.prior.distribution(history.copy().update(own))

    def scaled(self, values: Tensor, warm: Tensor) -> Tensor:
        """Convert source values ``[*B, P, d_a]``, in units of ``sigma`` where warm, to the model's units."""
        return torch.where(warm, values * self._unit(values), values)

    def draw(self, history: TensorDictBase, generator: torch.Generator | None = None) -> Tensor:
        """Draw the prior's part of a source for a history, ``[*B, P, d_a]`` in the model's units."""
        source = self.distribution(history)
        return self.scaled(source.sample(generator), source.warm)

    def draw_for_training(
        self,
        before: Tensor,
        valid: Tensor,
        target: Tensor,
        generator: torch.Generator | None = None,
        cold_probability: float = 0.0,
    ) -> Tensor:
        """Draw the source ``a_0`` ``[B, T, D]`` of training windows with this target, ``[B, T, >= d_a]``.

        ``before`` are the ``history_length`` actions before the current step; ``valid``, bool ``[B, *]``,
        marks those inside the episode.
        """
        model_actions = target[:, self.positions, : self.action_dim]
        executed = torch.where(valid.unsqueeze(-1), before[..., : self.action_dim], 0.0)
        steps = valid.sum(1, keepdim=True)
        history = window_history(executed, steps, model_actions, self.prior.chunk_length)
        if cold_probability > 0:
            draw = torch.rand(len(target), generator=generator, device=target.device)
            history = without(history, draw < cold_probability)
        return self.place(self.draw(history, generator), generator)

    def place(self, a0: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Return the whole source ``[B, T, D]``: the prior's part ``[B, P, d_a]``, ``N(0, 1)`` elsewhere."""
        whole = torch.randn(
            (len(a0), self.length, self.width), dtype=a0.dtype, device=a0.device, generator=generator
        )
        whole[:, self.positions, : self.action_dim] = a0
        return whole

    def _unit(self, like: Tensor) -> Tensor:
        one = torch.ones(self.action_dim, dtype=like.dtype, device=like.device)
        return one if self._std is None else self._std.to(one)


def action_std(policy: Any, stats: Mapping[str, Mapping[str, Any]] | None) -> Tensor:
    """Return the standard deviation of a dataset's actions in the units of a LeRobot policy, ``[d_a]``.

    Pass ``dataset.meta.stats`` as statistics.

    Raises:
        ValueError: if needed statistics are missing, a dimension never varies, the policy normalises actions
            in another way, or it has no port.

    Examples:
        >>> from warmprior.lerobot import action_std
        >>> from types import SimpleNamespace
        >>> class Policy:
        ...     name = "smolvla"
        ...     config = SimpleNamespace(normalization_mapping={"ACTION": SimpleNamespace(value="MIN_MAX")})
        >>> action_std(Policy(), {"action": {"std": [0.5], "min": [-1.0], "max": [3.0]}})
        tensor([0.2500])
    """
    mode = port_for(policy).normalization(policy)
    own = (stats or {}).get("action", {})
    needs = {
        "MEAN_STD": ("std",),
        "MIN_MAX": ("std", "min", "max"),
        "QUANTILES": ("std", "q01", "q99"),
        "QUANTILE10": ("std", "q10", "q90"),
    }
    if mode not in needs:
        name = type(policy).__name__
        raise ValueError(
            f"{name} normalises actions by its own means ({mode}): give std in the model's units"
        )
    if missing := [name for name in needs[mode] if name not in own]:
        raise ValueError(
            f"{mode} needs the statistics {', '.join(missing)} of 'action', as in dataset.meta.stats"
        )
    std, *bounds = (torch.as_tensor(own[name], dtype=torch.float32) for name in needs[mode])
    if mode == "MEAN_STD":
        return torch.ones_like(std)
    low, high = bounds
    unit = 2 * std / (high - low)
    if still := [i for i, value in enumerate(unit.tolist()) if not 0 < value < math.inf]:
        raise ValueError(
            f"actions {still} do not vary: std {std[still].tolist()}; give std in the model's units"
        )
    return unit
