"""Options of the guidance of Real-Time Chunking."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from warmprior.checks import check_choice, check_not_negative, check_positive, check_whole_numbers, given

Schedule = Literal["exp", "linear"]


@dataclass(frozen=True)
class GuidanceOptions:
    """The options of :class:`~warmprior.RealTimeChunking`.

    Attributes:
        execution_horizon: first position without guidance (LeRobot's name; prefix_attention_horizon in the
            official code); by default the end of the old chunk, as in the official studies.
        schedule: "exp" (the official default) or "linear" (LeRobot's).
        max_guidance_weight: largest weight; 5 in the official code, 10 in LeRobot.
        jacobian: False takes the identity for the Jacobian, as LeRobot 0.6 does. That needs no gradients and
            takes 0.6 of the time, but is no longer exact in the Gaussian case.
        sigma: the source's standard deviation in the weight; by default that of the policy's source. 1 gives
            the published weight.

    Examples:
        >>> from warmprior.options.guidance import GuidanceOptions
        >>> GuidanceOptions(schedule="linear").max_guidance_weight
        5.0
    """

    execution_horizon: int | None = None
    schedule: Schedule = "exp"
    max_guidance_weight: float = 5.0
    jacobian: bool = True
    sigma: float | None = None

    def __post_init__(self) -> None:
        check_choice("schedule", self.schedule, get_args(Schedule))
        check_whole_numbers(**given(execution_horizon=self.execution_horizon))
        check_positive(max_guidance_weight=self.max_guidance_weight)
        check_not_negative(**given(sigma=self.sigma))
