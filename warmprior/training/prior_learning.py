"""Training of priors that learn before the flow does."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch.optim import AdamW

from warmprior import keys
from warmprior.modules.learned import LearnedPrior
from warmprior.modules.learning_windows import LearningWindows
from warmprior.training.optim import warmup_cosine
from warmprior.transforms.window import window_replay_buffer, without_images

__all__ = ["learn_prior"]

CALIBRATION_WINDOWS = 4_096


def learn_prior(
    prior: LearnedPrior,
    data: TensorDictBase,
    *,
    iterations: int,
    batch_size: int = 256,
    learning_rate: float = 1e-3,
    weight_decay: float = 1e-2,
    observation_steps: int = 2,
    held_out: float = 0.1,
    seed: int = 0,
) -> None:
    """Train the networks of a prior, in place, and calibrate it on episodes that it does not learn from.

    Args:
        prior: with networks (:meth:`LearnedPrior.sized`).
        data: contiguous normalised steps, see :class:`~warmprior.ActionWindow`.

    Keyword Args:
        iterations: gradient steps.
        batch_size: windows per step.
        learning_rate: peak of the schedule.
        weight_decay: AdamW's.
        observation_steps: ``To``.
        held_out: share of the episodes to calibrate on, evenly spread; with a single episode there are none,
            and it is calibrated on what it learnt from.
        seed: of initial weights, batches and draws; PyTorch's own generator stays as it is.

    Raises:
        ValueError: if ``iterations < 1`` or ``held_out`` is not in (0, 0.5].
        FloatingPointError: if the loss becomes NaN or infinite.

    Examples:
        >>> import torch
        >>> from warmprior import ForecastPrior
        >>> from warmprior.envs import navigation_demonstrations
        >>> prior = ForecastPrior(4).sized(action_dim=1, observation_dim=9, observation_steps=1)
        >>> learn_prior(prior, navigation_demonstrations(), iterations=10, observation_steps=1)
    """
    if iterations < 1 or not 0.0 < held_out <= 0.5:
        raise ValueError(
            f"need iterations >= 1 and 0 < held_out <= 0.5, got {iterations} and {held_out}"
        )
    data = without_images(data)  # no such prior sees them
    episodes = data[keys.EPISODE].flatten()
    number = episodes.unique(return_inverse=True)[1]
    every = max(2, round(1 / held_out))
    apart = number % every == every - 1 if int(number.max()) + 1 >= every else number == 1
    device = data.device or torch.device("cpu")
    generator = torch.Generator(device).manual_seed(seed)

    def windows(part: TensorDictBase, size: int) -> Any:
        return window_replay_buffer(
            part, prior, batch_size=size, observation_steps=observation_steps, generator=generator
        )

    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        torch.manual_seed(seed)
        prior.build()
        prior.to(device)
    buffer = windows(data[~apart], batch_size)
    prior.requires_grad_(True).train()
    optimizer = AdamW(prior.parameters(), lr=learning_rate, weight_decay=weight_decay, fused=True)
    schedule = warmup_cosine(optimizer, iterations, 0.1)
    for _ in range(iterations):
        loss = prior.learning_loss(_learning_windows(buffer.sample()), generator)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    prior.requires_grad_(False).eval()
    if not all(bool(torch.isfinite(p).all()) for p in prior.parameters()):
        raise FloatingPointError(
            f"the networks of {prior.name} became NaN or infinite: lower the learning rate"
        )
    unseen = data[apart] if bool(apart.any()) else data
    with torch.no_grad():
        prior.calibrate(_learning_windows(windows(unseen, CALIBRATION_WINDOWS).sample()))


def _learning_windows(batch: TensorDictBase) -> LearningWindows:
    """What a prior takes of a batch of the buffer."""
    return LearningWindows(
        a1=batch[keys.CHUNK],
        counted=~batch[keys.IS_PAD].unsqueeze(-1),
        loc=batch[keys.LOC],
        warm=batch[keys.WARM],
        observation=batch[keys.OBSERVATION],
    )
