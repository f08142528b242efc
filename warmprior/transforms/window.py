"""Training windows, gathered from contiguous demonstrations when a buffer is sampled."""

from __future__ import annotations

import warnings
from contextlib import suppress
from typing import Any

import torch
from tensordict import MemoryMappedTensor, TensorDict, TensorDictBase, is_leaf_nontensor, is_non_tensor
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, TensorDictReplayBuffer, TensorStorage
from torchrl.envs.transforms import Compose, Transform

from warmprior import keys
from warmprior.checks import check_finite_steps, check_keys, check_whole_numbers
from warmprior.history import window_history
from warmprior.modules.prior import PastPrior, Prior
from warmprior.transforms.history import HistoryObservation, WithheldHistory


class ActionWindow(Transform):
    """A transform that replaces sampled steps with training windows and their history.

    For the step ``i``, int64 ``[*B]`` under ``"frame"``, it gathers the last ``To`` observations, the target
    chunk ``[i, i+P)`` and the history (:mod:`warmprior.history`): the actions before step ``i``, and the
    target's first ``P - H`` actions as a forecast. Windows never cross episode borders: the episode's first
    observation is repeated before its start, and its last action past its end, marked in
    ``"action_is_pad"``. One transform serves all priors with the same lengths.

    Args:
        data: contiguous steps ``[N]`` in normalised units, with ``"observation"`` ``[N, d_o]``,
            ``"action"`` ``[N, d_a]`` and ``"episode"`` ``[N]``; in memory, memory-mapped or on a GPU.
            An observation may be an image ``[N, C, H, W]``, or several entries nested under its key. Actions,
            and vectors in memory, are copied with what pads the ends of every episode.
        chunk_length: ``H``.
        prediction_length: ``P``; ``H`` by default.
        history_length: number of executed actions that are remembered, at least ``H``; ``H`` by default.
        observation_steps: ``To``.
        observation_key: key of the observation, in ``data`` and in windows.

    Raises:
        KeyError: if ``data`` lacks a key.
        ValueError: if not ``1 <= chunk_length <= min(prediction_length, history_length)``, or if ``data`` is
            empty or not flat, an action is not one vector, an entry holds NaN or Inf, or an
            episode is not contiguous.
        IndexError: (on a call) if a step number is outside the data.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import ActionWindow
        >>> data = TensorDict({"observation": torch.zeros(5, 3), "action": torch.arange(5.0)[:, None],
        ...                    "episode": torch.zeros(5, dtype=torch.int64)}, [5])
        >>> batch = ActionWindow(data, 2)(TensorDict({"frame": torch.tensor([0, 2, 4])}, [3]))
        >>> batch["vla_action", "chunk"].squeeze(-1).tolist()
        [[0.0, 1.0], [2.0, 3.0], [4.0, 4.0]]
        >>> batch["action_is_pad"].tolist()
        [[False, False], [False, False], [False, True]]
        >>> batch["history", "actions"].squeeze(-1).tolist()
        [[0.0, 0.0], [0.0, 1.0], [2.0, 3.0]]
    """

    def __init__(
        self,
        data: TensorDictBase,
        chunk_length: int,
        *,
        prediction_length: int | None = None,
        history_length: int | None = None,
        observation_steps: int = 2,
        observation_key: NestedKey = keys.OBSERVATION,
    ) -> None:
        out_keys = [observation_key, keys.CHUNK, keys.IS_PAD, keys.HISTORY]
        super().__init__(in_keys=[keys.FRAME], out_keys=out_keys)
        check_whole_numbers(observation_steps=observation_steps)
        prediction_length = chunk_length if prediction_length is None else prediction_length
        history_length = chunk_length if history_length is None else history_length
        if not 1 <= chunk_length <= min(prediction_length, history_length):
            lengths = f"{chunk_length}, {prediction_length} and {history_length}"
            raise ValueError(f"need 1 <= chunk_length <= prediction_length and history_length, got {lengths}")
        self.chunk_length, self.history_length = chunk_length, history_length
        self.prediction_length, self.observation_steps = prediction_length, observation_steps
        observations, action, episode = _checked(data, observation_key)
        ordinal, first, length = _episodes(episode)
        step = torch.arange(len(episode), device=episode.device)
        before, behind = max(history_length, observation_steps - 1), prediction_length - 1
        padded, outside = _padding(first, length, before, behind)
        oldest, recent = before - history_length, before - observation_steps + 1
        buffers = {
            "steps": (step - first[ordinal]).unsqueeze(-1),
            # Windows are ranges of the padded steps, which begin at these rows.
            "rows": step + ordinal * (before + behind),
            "action": _rows(action, padded).masked_fill_((outside < 0).unsqueeze(-1), 0)[oldest:],
            "is_pad": (outside > 0)[before:],
            "observation_offsets": torch.arange(1 - observation_steps, 1, device=episode.device),
        }
        self._ranges, self._gathered = {}, {}
        for i, (key, value) in enumerate(observations.items()):
            name, value = f"observation_{i}", value.detach() if value.requires_grad else value
            if value.ndim == 2 and not isinstance(value, MemoryMappedTensor):
                self._ranges[name], value = key, _rows(value, padded)[recent:]
            else:  # there may be no room for a second copy
                self._gathered[name] = key
            buffers[name] = value
        for name, value in buffers.items():
            self.register_buffer(name, value, persistent=False)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the windows of the sampled steps."""
        check_keys(tensordict, self.in_keys, "ActionWindow", ": see window_replay_buffer")
        frame = tensordict.get(keys.FRAME)
        if frame.dtype not in (torch.int64, torch.int32):
            raise ValueError(f"{keys.FRAME!r} holds step numbers and must be int64, got {frame.dtype}")
        windows = self._windows(frame.reshape(-1)).reshape(tensordict.batch_size)
        return tensordict.update(windows).set(keys.FRAME, frame)  # which may have more dimensions

    def _windows(self, frame: Tensor) -> TensorDict:
        """Return the windows of some steps ``[B]``."""
        try:
            steps = self.steps.index_select(0, frame)
        except IndexError as error:
            found, last = f"{int(frame.min())} to {int(frame.max())}", len(self.steps) - 1
            raise IndexError(f"{keys.FRAME!r} has steps {found}, but the data hold 0 to {last}") from error
        row, batch, before = self.rows.index_select(0, frame), frame.shape, self.history_length
        action = _ranges(self.action, row, before + self.prediction_length)
        target = action[:, before:]
        group, name = keys.CHUNK
        entries = {
            keys.FRAME: frame,
            group: TensorDict._new_unsafe({name: target}, batch_size=batch),
            keys.IS_PAD: _ranges(self.is_pad, row, self.prediction_length),
            keys.HISTORY: window_history(action[:, :before], steps, target, self.chunk_length),
        }
        # Unchecked, because the checks take as long as the gathers.
        windows = TensorDict._new_unsafe(entries, batch_size=batch)
        for name, key in self._ranges.items():
            windows.set(key, _ranges(getattr(self, name), row, self.observation_steps))
        if self._gathered:
            frame = frame.unsqueeze(-1)
            recent = (frame + self.observation_offsets).clamp_min(frame - steps)
            for name, key in self._gathered.items():
                windows.set(key, _rows(getattr(self, name), recent))
        return windows


def _ranges(values: Tensor, row: Tensor, length: int) -> Tensor:
    """Return ranges of rows of contiguous values, ``[B, length, *]``."""
    shape, stride = values.shape, values.stride()
    ranges = values.as_strided((shape[0] - length + 1, length, *shape[1:]), (stride[0], *stride))
    return ranges.index_select(0, row)


def _rows(values: Tensor, index: Tensor) -> Tensor:
    """Return ``values[index]``, along the first dimension."""
    # index_select of a plain tensor is twice as fast as indexing, and for images thirty times.
    rows = values.as_subclass(Tensor).index_select(0, index.flatten())
    return rows.view(*index.shape, *values.shape[1:])


def _checked(
    data: TensorDictBase, observation_key: NestedKey
) -> tuple[dict[NestedKey, Tensor], Tensor, Tensor]:
    """Check the data, and return the observation's entries, the action and the episode numbers."""
    needed = (observation_key, keys.ACTION, keys.EPISODE)
    check_keys(data, needed, "ActionWindow", f"; the data hold {sorted(map(str, data.keys(True)))}")
    action, episode = data.get(keys.ACTION), data.get(keys.EPISODE)
    if data.ndim != 1 or not len(data):
        raise ValueError(f"the data must be flat steps [N] with N > 0, got {tuple(data.shape)}")
    if action.ndim != 2 or action.is_complex():
        raise ValueError(
            f"actions must be vectors of real numbers, {keys.ACTION!r} [N, d_a], got {tuple(action.shape)} "
            f"of {action.dtype}: flatten it"
        )
    action = action.detach()  # an expert's rollouts may hold its gradients
    if not action.is_floating_point():
        action = action.to(torch.get_default_dtype())
    observations = dict(data.select(observation_key).items(True, True, is_leaf=is_leaf_nontensor))
    for key, value in (*observations.items(), (keys.ACTION, action)):
        if value.ndim < 2 or is_non_tensor(value):
            raise ValueError(
                f"observations must be vectors or images, but {key!r} is a number or text per step: "
                "unsqueeze it, or keep text beside the observation"
            )
        check_finite_steps(key, value)
    return observations, action, episode.flatten()


def _episodes(episode: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the ordinal of every step's episode ``[N]``, and the episodes' first steps and lengths."""
    values, ordinal, lengths = torch.unique_consecutive(episode, return_inverse=True, return_counts=True)
    numbers, times = values.unique(return_counts=True)
    if (times > 1).any():
        number = int(numbers[times > 1][0])
        raise ValueError(f"the steps of episode {number} are not contiguous: order all by episode and time")
    return ordinal, lengths.cumsum(0) - lengths, lengths


def _padding(first: Tensor, length: Tensor, before: int, behind: int) -> tuple[Tensor, Tensor]:
    """Return the steps that fill the rows of padded episodes, and -1, 0 or 1 before, inside or behind."""
    rows = length + before + behind
    ordinal = torch.arange(len(rows), device=rows.device).repeat_interleave(rows)
    place = torch.arange(len(ordinal), device=rows.device) - (rows.cumsum(0) - rows)[ordinal] - before
    inside = torch.minimum(place.clamp_min(0), length[ordinal] - 1)
    return first[ordinal] + inside, (place - inside).sign()


def window_transforms(
    data: TensorDictBase,
    prior: Prior,
    *,
    observation_steps: int = 2,
    see_history: bool = False,
    withhold: float = 0.0,
    generator: torch.Generator | None = None,
    observation_key: NestedKey = keys.OBSERVATION,
) -> Compose:
    """Return transforms that turn step numbers into the windows that a policy reads.

    They are :class:`ActionWindow`, and on request :class:`~warmprior.WithheldHistory` and
    :class:`~warmprior.HistoryObservation`: the counterpart of :func:`~warmprior.policy_transforms` for data.

    Args:
        data: contiguous normalised steps, see :class:`ActionWindow`.
        prior: the policy's prior (only its lengths are used).
        observation_steps: ``To``.
        see_history: True if the network sees the last actions.
        withhold: share of the windows whose history is withheld.
        generator: chooses the withheld windows, on the data's device.
        observation_key: see :class:`ActionWindow`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import PastPrior, window_transforms
        >>> data = TensorDict({"observation": torch.zeros(50, 3), "action": torch.arange(50.0)[:, None],
        ...                    "episode": torch.arange(50) // 25}, [50])
        >>> windows = window_transforms(data, PastPrior(2), observation_steps=1)
        >>> batch = windows(TensorDict({"frame": torch.tensor([10, 25])}, [2]))
        >>> batch["vla_action", "chunk"].squeeze(-1).tolist()
        [[10.0, 11.0], [25.0, 26.0]]
    """
    transforms: list[Transform] = [
        ActionWindow(
            data,
            prior.chunk_length,
            prediction_length=prior.prediction_length,
            history_length=prior.history_length,
            observation_steps=observation_steps,
            observation_key=observation_key,
        )
    ]
    if withhold:
        transforms.append(WithheldHistory(withhold, generator=generator))
    if see_history:
        transforms.append(HistoryObservation(observation_key=observation_key))
    return Compose(*transforms)


def window_replay_buffer(
    data: TensorDictBase,
    prior: Prior,
    *,
    batch_size: int,
    generator: torch.Generator | None = None,
    **options: Any,
) -> TensorDictReplayBuffer:
    """Return a replay buffer that samples training windows from demonstrations.

    Its storage holds step numbers, and :class:`ActionWindow` gathers the windows when they are read.

    Args:
        data: contiguous normalised steps ``[N]``, see :class:`ActionWindow`.
        prior: the policy's prior (only its lengths are used).
        batch_size: windows per sample.
        generator: draws the windows, and those whose history is withheld; PyTorch's global generator by
            default.
        **options: ``observation_steps``, ``see_history``, ``withhold`` and ``observation_key`` of
            :func:`window_transforms`.

    Raises:
        ValueError: if ``batch_size < 1``, or :class:`ActionWindow` rejects the data.

    Examples:
        >>> from warmprior import PreviewPrior, window_replay_buffer
        >>> from warmprior.envs import navigation_demonstrations
        >>> batch = window_replay_buffer(navigation_demonstrations(), PreviewPrior(8), batch_size=32).sample()
        >>> batch["vla_action", "chunk"].shape, batch["observation"].shape
        (torch.Size([32, 16, 1]), torch.Size([32, 2, 9]))
    """
    check_whole_numbers(batch_size=batch_size)
    transforms = window_transforms(data, prior, generator=generator, **options)
    window = transforms[0]
    if isinstance(prior, PastPrior) and (reach := int(window.steps.max())) < prior.chunk_length:
        words = f"no episode has more than {reach + 1} steps, so {prior} is never warm: shorten the chunk"
        warnings.warn(words, stacklevel=1)  # from one place, so the two buffers of a training warn once
    return TensorDictReplayBuffer(
        storage=_WindowStorage(window),
        writer=ImmutableDatasetWriter(),
        batch_size=batch_size,
        transform=transforms[1:] if len(transforms) > 1 else None,
        generator=generator,
    )


class _WindowStorage(TensorStorage):
    """A storage of steps that are read as their windows: a buffer's transforms take as long as the gathers.

    It names no device where draws are on it anyway, for TorchRL then moves nothing.
    """

    def __init__(self, window: ActionWindow) -> None:
        self.window = window
        self.frames = torch.arange(len(window.steps), device=window.steps.device)
        device = self.frames.device
        named = None if device == torch.get_default_device() else device
        super().__init__(
            TensorDict({keys.FRAME: self.frames}, [len(self.frames)], device=named), device="auto"
        )

    def get(self, index: Any) -> TensorDictBase:
        """Return the windows of some steps."""
        numbers = isinstance(index, Tensor) and index.dtype == torch.int64 and index.ndim == 1
        if numbers and index.is_cpu and self.frames.is_cpu:
            with suppress(IndexError):  # of a number that is negative, or outside
                return self.window._windows(index.clone())  # as below, without a twentieth of the time
        frame = self.frames[index]
        if frame.ndim == 1:
            return self.window._windows(frame)
        return self.window._windows(frame.reshape(-1)).reshape(frame.shape)


def without_images(data: TensorDictBase) -> TensorDictBase:
    """Return steps without images, which would fill the memory in thousands of windows."""
    observation = data.get(keys.OBSERVATION)
    if not isinstance(observation, TensorDictBase) or keys.STATE not in observation:
        return data
    return data.copy().set(keys.OBSERVATION, observation.select(keys.STATE))
