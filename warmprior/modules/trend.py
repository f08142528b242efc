"""The part of sources and targets that follows from the grippers' poses."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn.functional import pad

from warmprior import keys
from warmprior.modules.normalize import Normalizer
from warmprior.modules.prior import Prior
from warmprior.rotation import HAND_TO_SITE, matrix_to_rotation_6d, quaternion_to_matrix

__all__ = ["PoseTrend", "RestingAction"]

DRAWS = 16
"""Of the source, per window: their mean has little noise, which belongs to no observation."""

VARIANCE_FLOOR = 1e-4
"""Of a resting action; one that varies less predicts nothing."""

_POSE, _ABSOLUTE = 7, 10  # numbers per arm: position and quaternion; position, rotation and gripper


class RestingAction(nn.Module):
    """The absolute action that asks every gripper to stay where the observation says it is.

    Args:
        columns: int64 ``[arms, 7]``, where in the observation each gripper's position and the
            ``(x, y, z, w)`` quaternion of its hand are, as robomimic's files have them.
        normalizer: of the observations ``[d_o]`` and the actions ``[10 * arms]``; an identity by default, to
            be replaced by loading a state dict.

    Examples:
        >>> import torch
        >>> from warmprior import RestingAction
        >>> rest = RestingAction(torch.arange(7)[None])
        >>> observation = torch.tensor([0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0])
        >>> rest(observation).tolist()[:3], rest(observation).shape
        ([0.1..., 0.2..., 0.3...], torch.Size([10]))
    """

    columns: Tensor
    loc: Tensor
    scale: Tensor
    action_loc: Tensor
    action_scale: Tensor

    def __init__(self, columns: Tensor, normalizer: Normalizer | None = None) -> None:
        super().__init__()
        if columns.ndim != 2 or columns.shape[1] != _POSE:
            raise ValueError(f"columns must be [arms, {_POSE}], got {list(columns.shape)}")
        shapes = columns.shape, (len(columns), _ABSOLUTE)
        affine = [make(shape) for shape in shapes for make in (torch.zeros, torch.ones)]
        if normalizer is not None:
            ends = normalizer.loc, normalizer.scale
            affine = [end(keys.OBSERVATION)[columns] for end in ends]
            affine += [end(keys.ACTION).unflatten(0, (-1, _ABSOLUTE)) for end in ends]
        self.register_buffer("columns", columns)
        for name, value in zip(("loc", "scale", "action_loc", "action_scale"), affine, strict=True):
            self.register_buffer(name, value.clone())

    @property
    def width(self) -> int:
        """``d_a``."""
        return self.action_loc.numel()

    def forward(self, observation: Tensor) -> Tensor:
        """The action, ``[*B, 10 * arms]``, 0 for the gripper, at ``[*B, d_o]``; both normalised."""
        pose = observation[..., self.columns] * self.scale + self.loc
        hand = quaternion_to_matrix(pose[..., 3:])
        site = hand @ quaternion_to_matrix(hand.new_tensor(HAND_TO_SITE))
        action = torch.cat((pose[..., :3], matrix_to_rotation_6d(site)), -1)
        normalised = (action - self.action_loc[:, :-1]) / self.action_scale[:, :-1]
        return pad(normalised, (0, 1)).flatten(-2)


class PoseTrend(nn.Module):
    """Best linear predictions of source :math:`a_0` and target :math:`a_1` from the resting action.

    Absolute poses lie near the present pose, which explains most of their variance. A network without a trend
    spends its precision on that, and passes on source noise that is many times as large as the change of a
    pose in one step. With a trend, :class:`PreconditionedNetwork` learns the remainder: where to go from
    here, as with deltas. Every action dimension is predicted from the same dimension of the resting action at
    the last observation: a regression on the whole observation fits better, but fails away from the
    demonstrations.

    Args:
        rest: the resting action of an observation.
        centre: ``[d_a]``, its mean.
        source: ``[P, d_a]``, slopes of :math:`a_0 - E[a_0]`.
        target: ``[P, d_a]``, slopes of :math:`a_1 - E[a_1]`.

    Raises:
        ValueError: if the shapes differ, or an entry is NaN or infinite.

    Examples:
        >>> import torch
        >>> from warmprior import PoseTrend, RestingAction
        >>> rest = RestingAction(torch.arange(7)[None])
        >>> trend = PoseTrend(rest, torch.zeros(10), torch.zeros(4, 10), torch.ones(4, 10))
        >>> observation = torch.tensor([0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0]).expand(2, 1, 7)
        >>> source, target = trend(observation)  # the targets follow the gripper, the source does not
        >>> source.abs().max(), target[1, 3, :3]
        (tensor(0.), tensor([0.1000, 0.2000, 0.3000]))
    """

    centre: Tensor
    source: Tensor
    target: Tensor

    def __init__(self, rest: RestingAction, centre: Tensor, source: Tensor, target: Tensor) -> None:
        super().__init__()
        shapes = [tuple(value.shape) for value in (centre, source, target)]
        width = rest.width
        if source.ndim != 2 or shapes != [(width,), (len(source), width), (len(source), width)]:
            raise ValueError(
                f"a trend of {width} actions needs [d_a] and twice [P, d_a], got the shapes {shapes}"
            )
        self.rest = rest
        for name, value in (("centre", centre), ("source", source), ("target", target)):
            if not torch.isfinite(value).all():
                raise ValueError(f"the trend's {name} holds NaN or infinity: check the data")
            self.register_buffer(name, value.clone())

    @classmethod
    def zero(cls, arms: int, prediction_length: int) -> PoseTrend:
        """No trend, to be replaced by loading a state dict."""
        rest = RestingAction(torch.zeros(arms, _POSE, dtype=torch.int64))
        none = torch.zeros(prediction_length, _ABSOLUTE * arms)
        return cls(rest, none[0], none, none)

    @classmethod
    @torch.no_grad()
    def fit(
        cls,
        windows: TensorDictBase,
        prior: Prior,
        rest: RestingAction,
        *,
        generator: torch.Generator | None = None,
    ) -> PoseTrend:
        """Estimate it, as float32, from unpadded positions of windows ``[N]`` and draws of the prior.

        The observations are ``[N, To, d_o]``; a position that is padded in all windows gets 0. The generator
        is of the source samples, on the windows' device.
        """
        resting = rest(windows[keys.OBSERVATION][:, -1].float()).double()
        centre = resting.mean(0)
        source = prior.distribution(windows[keys.HISTORY], windows[keys.OBSERVATION])
        draws = [source.sample(generator).double() for _ in range(DRAWS)]
        ends = torch.stack((torch.stack(draws).mean(0), windows[keys.CHUNK].double()))
        # Padded positions do not count: they would pull the trend to the episode's last action.
        weight = (~windows[keys.IS_PAD]).double().unsqueeze(-1)
        weight = weight / weight.sum(0).clamp_min(1)
        deviation = resting.unsqueeze(1) - (weight * resting.unsqueeze(1)).sum(0)
        variance = (weight * deviation.square()).sum(0)
        slopes = (weight * deviation * ends).sum(1) / variance.clamp_min(VARIANCE_FLOOR)
        return cls(rest, centre.float(), *slopes.float())

    def config(self) -> dict[str, Any]:
        """JSON-serialisable arguments of :meth:`zero`; the values themselves are buffers."""
        return {"arms": len(self.rest.columns), "prediction_length": len(self.source)}

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """The predicted deviations of source and target from their means, each ``[B, P, d_a]``.

        Of normalised observations ``[B, To, d_o]`` the last step counts.
        """
        deviation = (self.rest(observation[:, -1]) - self.centre).unsqueeze(1)
        return deviation * self.source, deviation * self.target
