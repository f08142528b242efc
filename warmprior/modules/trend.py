"""The part of absolute actions that follows from the robot's current position."""

from __future__ import annotations

from typing import Any, override

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn.functional import pad

from warmprior import keys
from warmprior.checks import check_shape
from warmprior.modules.normalize import Normalizer, RawUnits
from warmprior.modules.prior import Prior
from warmprior.modules.registry import Registered, from_config
from warmprior.rotation import HAND_TO_SITE, matrix_to_rotation_6d, quaternion_to_matrix

DRAWS = 16
"""The number of source samples per window, so many that little noise is left in their mean."""

VARIANCE_FLOOR = 1e-4
"""0.01 squared: dimensions that deviate by less than half a percent of their range count as constant."""

NEAR = 0.2
"""The largest distance of actions from the observed joints they set, as a share of the actions' variance."""

_POSE, _ABSOLUTE = 7, 10  # numbers per arm: position and quaternion; position, rotation and gripper


class RestingAction(Registered, RawUnits):
    """The absolute action that asks a robot to stay where the observation says it is.

    The subclasses :class:`RestingJoints` and :class:`RestingPose` find the robot's position in the
    observation. Called with normalised observations ``[*B, d_o]`` they return normalised actions
    ``[*B, d_a]``, 0 where an action is not a position target.

    Args:
        columns: indices of the position in the observation.
        action_shape: shape of an action before it is flattened to ``d_a`` numbers.
        normalizer: normaliser of the observations ``[d_o]`` and the actions ``[d_a]``; an identity by
            default, to be replaced by loading a state dict.

    Examples:
        >>> import torch
        >>> from warmprior import RestingAction, RestingJoints, RestingPose
        >>> [issubclass(kind, RestingAction) for kind in (RestingJoints, RestingPose)]
        [True, True]
    """

    positive = ("scale", "action_scale")

    def __init__(self, columns: Tensor, action_shape: tuple[int, ...], normalizer: Normalizer | None) -> None:
        super().__init__()
        affine = [
            make(shape) for shape in (columns.shape, action_shape) for make in (torch.zeros, torch.ones)
        ]
        if normalizer is not None:
            ends = normalizer.loc, normalizer.scale
            vector = next(key for key in normalizer.keys if key != keys.ACTION)
            affine = [end(vector)[columns] for end in ends]
            affine += [end(keys.ACTION).reshape(action_shape) for end in ends]
        self.columns = nn.Buffer(columns)
        self.loc, self.scale, self.action_loc, self.action_scale = (nn.Buffer(v.clone()) for v in affine)

    @property
    def width(self) -> int:
        """The number ``d_a`` of actions."""
        return self.action_loc.numel()

    @property
    def is_target(self) -> Tensor:
        """Return whether each action is a position target, bool ``[d_a]``."""
        raise NotImplementedError

    def config(self) -> dict[str, Any]:
        """Return name and columns as JSON holds them; the units are buffers."""
        return {"name": self.name, "columns": self.columns.tolist()}


class RestingPose(RestingAction):
    """The absolute pose at which every gripper stays where the observation says it is.

    Args:
        columns: ``[arms, 7]``, the indices in the observation of each gripper's position and the
            ``(x, y, z, w)`` quaternion of its hand, as robomimic's files have them.
        normalizer: see :class:`RestingAction`; the actions are ``[10 * arms]``, with 0 for the grippers.

    Examples:
        >>> import torch
        >>> from warmprior import RestingPose
        >>> rest = RestingPose(torch.arange(7)[None])
        >>> observation = torch.tensor([0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0])
        >>> rest(observation).tolist()[:3], rest(observation).shape
        ([0.1..., 0.2..., 0.3...], torch.Size([10]))
    """

    name = "pose"

    def __init__(self, columns: Tensor | list[list[int]], normalizer: Normalizer | None = None) -> None:
        columns = torch.as_tensor(columns)
        check_shape("columns", columns, ("arms", _POSE))
        super().__init__(columns, (len(columns), _ABSOLUTE), normalizer)

    @property
    @override
    def is_target(self) -> Tensor:
        return (torch.arange(self.width) + 1) % _ABSOLUTE != 0

    def forward(self, observation: Tensor) -> Tensor:
        """Return the resting action ``[*B, 10 * arms]``."""
        pose = observation[..., self.columns] * self.scale + self.loc
        hand = quaternion_to_matrix(pose[..., 3:])
        site = hand @ quaternion_to_matrix(hand.new_tensor(HAND_TO_SITE))
        action = torch.cat((pose[..., :3], matrix_to_rotation_6d(site)), -1)
        normalised = (action - self.action_loc[:, :-1]) / self.action_scale[:, :-1]
        return pad(normalised, (0, 1)).flatten(-2)


class RestingJoints(RestingAction):
    """The joint targets at which every joint stays where the observation says it is.

    Args:
        columns: ``[d_a]``, for every action the index in the observation of the position that it sets, in
            the same units; -1 for an action that sets no position.
        normalizer: see :class:`RestingAction`.

    Examples:
        >>> import torch
        >>> from warmprior import RestingJoints
        >>> rest = RestingJoints([1, 2, -1])  # two joints and a gripper's command
        >>> rest(torch.tensor([9.0, 0.5, -0.25])).tolist()
        [0.5, -0.25, 0.0]
    """

    name = "joints"

    def __init__(self, columns: Tensor | list[int], normalizer: Normalizer | None = None) -> None:
        columns = torch.as_tensor(columns)
        check_shape("columns", columns, ("d_a",))
        super().__init__(columns, (len(columns),), normalizer)

    @property
    @override
    def is_target(self) -> Tensor:
        return self.columns >= 0

    def forward(self, observation: Tensor) -> Tensor:
        """Return the resting action ``[*B, d_a]``."""
        joints = observation[..., self.columns] * self.scale + self.loc
        return torch.where(self.is_target, (joints - self.action_loc) / self.action_scale, 0.0)

    def farthest(self, observation: Tensor, action: Tensor) -> int | None:
        """Return the action farthest from the number it should set, or ``None`` if they are near it.

        Observations and actions are normalised, ``[N, d_o]`` and ``[N, d_a]``.
        """
        # All targets together: joints may sag below their targets, and one may move less than its noise.
        targets = self.is_target
        off = (action - self(observation)).var(0, correction=0)[targets]
        spread = action.var(0, correction=0)[targets]
        if off.sum() <= NEAR * spread.sum():
            return None
        return int(targets.nonzero()[(off / spread.clamp_min(VARIANCE_FLOOR)).argmax()])


class RestingTrend(nn.Module):
    """Best linear predictions of source :math:`a_0` and target :math:`a_1` from the resting action.

    Absolute poses and joint targets lie near the present ones, which explain most of their variance. A
    network without a trend spends its precision on that, and passes on source noise that is many times as
    large as the change in one step. With a trend, :class:`~warmprior.PreconditionedNetwork` learns the
    remainder: where to go from here, as with deltas. Every action dimension is predicted from the same
    dimension of the resting action at the last observation: a regression on the whole observation fits
    better, but fails away from the demonstrations.

    Args:
        rest: the resting action of an observation.
        centre: ``[d_a]``, its mean.
        source: ``[P, d_a]``, slopes of :math:`a_0 - E[a_0]`.
        target: ``[P, d_a]``, slopes of :math:`a_1 - E[a_1]`.

    Raises:
        ValueError: if the shapes differ, or an entry is NaN or infinite.

    Examples:
        >>> import torch
        >>> from warmprior import RestingTrend, RestingPose
        >>> rest = RestingPose(torch.arange(7)[None])
        >>> trend = RestingTrend(rest, torch.zeros(10), torch.zeros(4, 10), torch.ones(4, 10))
        >>> observation = torch.tensor([0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0]).expand(2, 1, 7)
        >>> source, target = trend(observation)  # the targets follow the gripper, the source does not
        >>> source.abs().max(), target[1, 3, :3]
        (tensor(0.), tensor([0.1000, 0.2000, 0.3000]))
    """

    def __init__(self, rest: RestingAction, centre: Tensor, source: Tensor, target: Tensor) -> None:
        super().__init__()
        self.rest = rest
        for name, value, shape in (
            ("centre", centre, (rest.width,)),
            ("source", source, ("P", rest.width)),
            ("target", target, source.shape),
        ):
            check_shape(f"the trend's {name}", value, shape)
            if not torch.isfinite(value).all():
                raise ValueError(f"the trend's {name} holds NaN or infinity: check the data")
        self.centre, self.source, self.target = (nn.Buffer(v.clone()) for v in (centre, source, target))

    @classmethod
    def zero(cls, rest: dict[str, Any], prediction_length: int) -> RestingTrend:
        """Return a trend of zeros, to be replaced by loading a state dict."""
        made = from_config(RestingAction, rest)
        none = torch.zeros(prediction_length, made.width)
        return cls(made, none[0], none, none)

    @classmethod
    @torch.no_grad()
    def fit(
        cls,
        windows: TensorDictBase,
        prior: Prior,
        rest: RestingAction,
        *,
        generator: torch.Generator | None = None,
    ) -> RestingTrend:
        """Estimate a trend from unpadded positions of windows ``[N]`` and draws of the prior.

        The observations are ``[N, To, d_o]``; a position that is padded in all windows gets 0. The generator
        draws the source samples, on the windows' device.
        """
        resting = rest(vector_of(windows[keys.OBSERVATION])[:, -1].float()).double()
        centre = resting.mean(0)
        source = prior.distribution(windows[keys.HISTORY], windows[keys.OBSERVATION])
        draws = [source.sample(generator).double() for _ in range(DRAWS)]
        ends = torch.stack((torch.stack(draws).mean(0), windows[keys.CHUNK].double()))
        # Padded positions do not count: they would pull the trend to the episode's last action.
        weight = windows[keys.IS_PAD].logical_not().double().unsqueeze(-1)
        weight = weight / weight.sum(0).clamp_min(1)
        deviation = resting.unsqueeze(1) - (weight * resting.unsqueeze(1)).sum(0)
        variance = (weight * deviation.square()).sum(0)
        slopes = (weight * deviation * ends).sum(1) / variance.clamp_min(VARIANCE_FLOOR)
        return cls(rest, *(value.to(torch.get_default_dtype()) for value in (centre, *slopes)))

    def config(self) -> dict[str, Any]:
        """Return the arguments of :meth:`zero` as JSON holds them; the values themselves are buffers."""
        return {"rest": self.rest.config(), "prediction_length": len(self.source)}

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return the predicted deviations of source and target from their means, each ``[B, P, d_a]``.

        They depend on the last step of normalised observations ``[B, To, d_o]``, or of the ``"state"`` in
        observations with images.
        """
        # The resting action is in the precision of its units, which a cast does not lower.
        deviation = (
            (self.rest(vector_of(observation)[:, -1]) - self.centre).to(self.source.dtype).unsqueeze(1)
        )
        return deviation * self.source, deviation * self.target


def vector_of(observation: Tensor | TensorDictBase) -> Tensor:
    """Return the observation, or its state if it has images; an encoder's features begin with the state."""
    return observation[keys.STATE] if isinstance(observation, TensorDictBase) else observation
