"""The source of a LeRobot policy's chunk: a prior on its warm positions, standard normal elsewhere."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

import torch
from torch import Tensor

from warmprior.lerobot.ports import port_for
from warmprior.modules.prior import Prior

__all__ = ["ChunkSource", "SigmaUnit", "action_std"]

SigmaUnit = Literal["model", "std"]


class ChunkSource:
    """Draws ``a_0`` ``[B, T, D]`` for a chunk of ``lead`` past, ``P`` predicted and further positions.

    The prior decides about the ``P`` positions from the current step on and the ``d_a`` dimensions of the
    action. Positions before and after, and the dimensions of padding, stay ``N(0, 1)``, as pretrained
    checkpoints saw them.

    Args:
        prior: the source distribution; any that needs neither observations as a vector nor a network that
            sees the mean.
        length: ``T``.
        width: ``D``.
        action_dim: ``d_a``.
        lead: positions before the current step.
        std: standard deviation of the data in the model's units, ``[d_a]``, if ``sigma`` is in units of it;
            by default ``sigma`` is in the model's units, as in the paper.

    Raises:
        ValueError: if the prior does not fit the policy.

    See Also:
        - :class:`~warmprior.lerobot.LeRobotFlow`: integrates from its samples.
        - :class:`~warmprior.lerobot.WarmPriorAdapter`: puts it into a policy of LeRobot.

    Examples:
        >>> import torch
        >>> from warmprior import PastPrior
        >>> source = ChunkSource(PastPrior(4, sigma=0.0), length=6, width=3, action_dim=2, lead=1)
        >>> warm = torch.ones(1, 4, 1, dtype=torch.bool)
        >>> generator = torch.Generator().manual_seed(0)
        >>> a0 = source.place(source.draw(torch.full((1, 4, 2), 7.0), warm, generator), generator)
        >>> a0.shape, (a0 == 7).sum(1).tolist()
        (torch.Size([1, 6, 3]), [[4, 4, 0]])
    """

    def __init__(
        self,
        prior: Prior,
        *,
        length: int,
        width: int,
        action_dim: int,
        lead: int = 0,
        std: Tensor | None = None,
    ) -> None:
        room = length - lead
        if prior.prediction_length > room:
            raise ValueError(
                f"{prior} predicts {prior.prediction_length} actions, but the policy's chunks have {room} "
                f"from the current step on: use chunk_length <= "
                f"{room // prior.prediction_chunks}, or a policy with longer chunks"
            )
        told = f"{prior} cannot be the source of a policy of LeRobot: "
        if prior.needs_vector:
            raise ValueError(told + "it needs the observation as one vector")
        if prior.teacher is not None:
            raise ValueError(told + f"it needs a trained policy of {prior.teacher}")
        if prior.conditions_network:
            raise ValueError(told + "the network would have to see its mean")
        if prior.start_time > 0:
            raise ValueError(
                told + f"it starts at time {prior.start_time}, and LeRobot integrates from 0"
            )
        if not prior.is_flow:
            raise ValueError(told + "it is trained at t = 0 alone, and LeRobot trains at all times")
        if std is not None and not (
            tuple(std.shape) == (action_dim,) and (std > 0).all() and std.isfinite().all()
        ):
            raise ValueError(
                f"the standard deviation of the actions must be {action_dim} finite numbers > 0, one per "
                f"dimension, got {std.tolist()}"
            )
        self.prior = prior
        self.length, self.width, self.action_dim, self.lead = length, width, action_dim, lead
        self._std = std

    @property
    def positions(self) -> slice:
        """Where the prior's ``P`` positions are in the chunk."""
        return slice(self.lead, self.lead + self.prior.prediction_length)

    def learn(
        self,
        history: Tensor,
        history_valid: Tensor,
        target: Tensor,
        generator: torch.Generator | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Source and target of training windows.

        Args:
            history: the ``H`` actions before the current step, ``[B, H, >= d_a]``, the model's units.
            history_valid: which of them lie inside of the episode, bool ``[B, H]``.
            target: the chunk, ``[B, T, >= d_a]``, the model's units.
            generator: source of randomness on their device; PyTorch's global one by default.

        Returns:
            ``a_0`` ``[B, T, D]`` and the target, which is another only where the prior couples it.
        """
        unit = self._unit(target)
        wanted = target[:, self.positions, : self.action_dim] / unit
        loc, warm = self.prior.training_mean(
            history[..., : self.action_dim] / unit, history_valid, wanted
        )
        warm = self.prior.withhold(warm, generator)
        a0 = self.prior.sample(loc, warm, generator)
        a0, a1 = self.prior.couple(a0, wanted, generator)
        if a1 is not wanted:
            target = target.clone()
            target[:, self.positions, : self.action_dim] = a1 * unit
        return self.place(self._scaled(a0, warm, unit), generator), target

    def draw(self, loc: Tensor, warm: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """The prior's part of the source of a decision.

        Args:
            loc: mean, ``[B, P, d_a]``, the model's units.
            warm: bool ``[B, P, 1]``.
            generator: see :meth:`learn`.

        Returns:
            ``[B, P, d_a]``, the model's units.
        """
        unit = self._unit(loc)
        return self._scaled(self.prior.start(loc / unit, warm, generator), warm, unit)

    def place(self, a0: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """The whole source around the prior's part of it: ``N(0, 1)`` everywhere else.

        Args:
            a0: ``[B, P, d_a]``.
            generator: see :meth:`learn`.

        Returns:
            ``[B, T, D]``.
        """
        whole = torch.randn(
            (len(a0), self.length, self.width),
            dtype=a0.dtype,
            device=a0.device,
            generator=generator,
        )
        whole[:, self.positions, : self.action_dim] = a0
        return whole

    def _unit(self, like: Tensor) -> Tensor:
        one = torch.ones(self.action_dim, dtype=like.dtype, device=like.device)
        return one if self._std is None else self._std.to(one)

    def _scaled(self, a0: Tensor, warm: Tensor, unit: Tensor) -> Tensor:
        # What is cold is N(0, 1) in the model's units, whatever those of sigma.
        return torch.where(warm | self.prior.always_warm, a0 * unit, a0)


def action_std(policy: Any, stats: Mapping[str, Mapping[str, Any]] | None) -> Tensor:
    """Standard deviation of a dataset's actions in the units of a policy, ``[d_a]``.

    Args:
        policy: of LeRobot; its port tells the units.
        stats: of the dataset (``dataset.meta.stats``).

    Raises:
        ValueError: if the statistics that the policy's units need are missing, a dimension never varies
            between its bounds, or the policy normalises actions elsewhere, or has no port.

    See Also:
        :class:`~warmprior.lerobot.WarmPriorAdapter`: warms the source in these units.

    Examples:
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
        raise ValueError(
            f"{type(policy).__name__} normalises actions by its own means ({mode}): give their standard "
            "deviation in the model's units as action_std, or use sigma_unit='model'"
        )
    missing = [name for name in needs[mode] if name not in own]
    if missing:
        raise ValueError(
            f"sigma_unit='std' needs the statistics {', '.join(missing)} of 'action' for {mode} "
            "normalisation: give stats=dataset.meta.stats"
        )
    std, *bounds = (torch.as_tensor(own[name], dtype=torch.float32) for name in needs[mode])
    if mode == "MEAN_STD":
        return torch.ones_like(std)
    low, high = bounds
    unit = 2 * std / (high - low)
    still = [i for i, value in enumerate(unit.tolist()) if not 0 < value < math.inf]
    if still:
        raise ValueError(
            f"sigma_unit='std' needs actions that vary: dimensions {still} have std "
            f"{std[still].tolist()} between {needs[mode][1]} {low[still].tolist()} and {needs[mode][2]} "
            f"{high[still].tolist()}. Give action_std in the model's units, or use sigma_unit='model'"
        )
    return unit
