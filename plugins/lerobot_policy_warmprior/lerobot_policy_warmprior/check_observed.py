"""Refusal of observations of a robot on which a policy would act wrongly."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any


def check_observed(batch: Mapping[str, Any], vectors: Iterable[str], images: Iterable[str]) -> None:
    """Raise ValueError for vectors with NaN or infinity, and for images that are not floats in [0, 1].

    Entries that a batch lacks are left to the policy.
    """
    for name in vectors:
        if name in batch and not batch[name].isfinite().all():
            raise ValueError(f"{name} holds NaN or infinity: check the robot's sensors")
    for name in images:
        if name not in batch or not batch[name].numel():
            continue
        image, held = batch[name], "whole numbers"
        if image.is_floating_point():
            low, high = image.aminmax()
            if low > -0.5 and high < 1.5:  # where images are resized, they may overshoot a little
                continue
            held = (
                "NaN or infinity" if not (low + high).isfinite() else f"numbers from {low:.4g} to {high:.4g}"
            )
        raise ValueError(
            f"{name} is {image.dtype} with {held}, but policies see images as floats in [0, 1], as LeRobot "
            "loads them: divide bytes by 255"
        )
