"""The same observations for every policy, each with its own history."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from warmprior import keys
from warmprior.diagnostics.flow import (
    depends_on_history,
    drawn,
    encoded_windows,
    evaluation_mode,
    flat_windows,
    seen_anew,
    sees_history,
)
from warmprior.history import advance
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.prior import Prior
from warmprior.transforms.window import window_transforms

__all__ = ["SharedObservations", "deployed_history"]


def deployed_history(
    policy: WarmPriorActor,
    previous: TensorDictBase,
    *,
    generator: torch.Generator | None = None,
) -> TensorDict:
    """``[*B]`` with the ``"history"`` at deployment, from the policy's own prediction one decision earlier.

    ``previous`` are windows ``[*B]``, ``H`` steps before those of interest in the same episodes, with the
    history of the training.
    """
    windows = flat_windows(policy, previous)
    data = previous.select(*policy.in_keys).to(windows.loc.device)
    with evaluation_mode(policy):
        data.set(keys.NOISE, drawn(policy, data, generator))
        chunk = policy.integrate(data).get(keys.CHUNK)
        steps = torch.full((*data.batch_size, 1), policy.prior.chunk_length, device=chunk.device)
        history = advance(data[keys.HISTORY], chunk, steps)
    return TensorDict({keys.HISTORY: history}, batch_size=data.batch_size, device=chunk.device)


class SharedObservations:
    """Observations that give policies of any prior (of one chunk length) their windows.

    It uses only steps with ``H`` earlier ones in their episode, so every history is complete.

    Args:
        data: contiguous normalised steps, see :class:`~warmprior.ActionWindow`; held-out ones for a fair
            measure.
        chunk_length: ``H``.
        observation_steps: ``To``.
        count: how many to draw, without replacement; all by default.
        generator: source of the draw, on the CPU; PyTorch's global one by default.

    Raises:
        KeyError: if the data lack a key.
        ValueError: if there are fewer observations than asked for.

    Examples:
        >>> from warmprior import PastPrior
        >>> from warmprior.diagnostics import SharedObservations
        >>> from warmprior.envs import navigation_demonstrations
        >>> shared = SharedObservations(navigation_demonstrations(), 4)  # 6 episodes of 64 steps
        >>> len(shared), shared.windows(PastPrior(4))["history", "actions"].shape
        (360, torch.Size([360, 4, 1]))
    """

    def __init__(
        self,
        data: TensorDictBase,
        chunk_length: int,
        *,
        observation_steps: int = 1,
        count: int | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        self.data, self.chunk_length = data, chunk_length
        self.observation_steps = observation_steps
        episode = data.get(keys.EPISODE, None)
        if episode is None:
            raise KeyError(f"the data lack {keys.EPISODE!r}, the number of each step's episode")
        episode = episode.flatten().cpu()
        first = torch.arange(len(episode)) - chunk_length
        frames = ((first >= 0) & (episode[first.clamp_min(0)] == episode)).nonzero().flatten()
        if count is not None:
            if not 1 <= count <= len(frames):
                raise ValueError(
                    f"{count} observations are asked for, but {len(frames)} of {len(episode)} steps "
                    f"have {chunk_length} earlier ones in their episode: give more demonstrations, or "
                    "ask for fewer observations"
                )
            frames = frames[torch.randperm(len(frames), generator=generator)[:count]].sort()[0]
        self.frames = frames
        self.episodes = episode[frames]

    def __len__(self) -> int:
        return len(self.frames)

    def windows(self, prior: Prior, offset: int = 0, *, see_history: bool = False) -> TensorDictBase:
        """Windows ``[n]`` with the history of the training, cut ``offset`` steps earlier, at most ``H``.

        Of the prior only the lengths matter. ``see_history`` tells whether a network sees the last actions. A
        ``ValueError`` if the prior has another chunk length.
        """
        if not 0 <= offset <= self.chunk_length:
            raise ValueError(f"offset must be between 0 and {self.chunk_length}, got {offset}")
        if prior.chunk_length != self.chunk_length:
            raise ValueError(
                f"compare policies of one chunk length: these observations have H = {self.chunk_length}, "
                f"{prior} has {prior.chunk_length}"
            )
        window = window_transforms(
            self.data, prior, observation_steps=self.observation_steps, see_history=see_history
        )
        frames = (self.frames - offset).to(self.data[keys.EPISODE].device)
        return window(TensorDict({keys.FRAME: frames}, [len(frames)]))

    def deployed(self, policy: WarmPriorActor, *, generator: torch.Generator | None = None) -> TensorDictBase:
        """Windows with the history at deployment, from the policy's own earlier prediction.

        See :func:`deployed_history`. Observations with images are encoded, see :func:`encoded_windows`.
        """
        see = sees_history(policy)
        earlier = self.windows(policy.prior, offset=self.chunk_length, see_history=see)
        met = deployed_history(policy, encoded_windows(policy, earlier), generator=generator)
        windows = self.windows(policy.prior, see_history=see).to(met.device).update(met)
        return encoded_windows(policy, seen_anew(policy, windows))

    def met(self, policy: WarmPriorActor, *, generator: torch.Generator | None = None) -> TensorDictBase:
        """Windows as at deployment: :meth:`deployed`, if the policy depends on the history."""
        see = sees_history(policy)
        windows = encoded_windows(policy, self.windows(policy.prior, see_history=see))
        if depends_on_history(policy, windows):
            return self.deployed(policy, generator=generator)
        return windows

    def subset(self, index: Tensor) -> SharedObservations:
        """The observations with these indices, int64 ``[m]``."""
        part = object.__new__(SharedObservations)
        part.__dict__.update(self.__dict__)
        part.frames, part.episodes = self.frames[index], self.episodes[index]
        return part
