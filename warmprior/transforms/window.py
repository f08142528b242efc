"""Training windows, gathered from contiguous demonstrations when a buffer is sampled."""

from __future__ import annotations

import warnings
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, is_leaf_nontensor, is_non_tensor
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
            An observation may be an image ``[N, C, H, W]``, or several entries nested under its key.
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
        observations, action, episode = _checked(data, observation_key)
        self._observations = {f"observation_{i}": key for i, key in enumerate(observations)}
        buffers = dict(zip(self._observations, observations.values(), strict=True)) | {"action": action}
        buffers["start"], buffers["end"] = _episode_borders(episode)
        buffers["action_offsets"] = torch.arange(-history_length, prediction_length, device=episode.device)
        buffers["observation_offsets"] = torch.arange(1 - observation_steps, 1, device=episode.device)
        for name, value in buffers.items():
            self.register_buffer(name, value, persistent=False)

    @torch.no_grad()  # an expert's rollouts may hold its gradients
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the windows of the sampled steps."""
        check_keys(tensordict, self.in_keys, "ActionWindow", ": see window_replay_buffer")
        frame = tensordict.get(keys.FRAME)
        if frame.dtype not in (torch.int64, torch.int32):
            raise ValueError(f"{keys.FRAME!r} holds step numbers and must be int64, got {frame.dtype}")
        batch, before = tensordict.batch_size, self.history_length
        frame = frame.reshape(-1, 1)
        try:
            start, end = _rows(self.start, frame), _rows(self.end, frame)
        except IndexError as error:
            steps, last = f"{int(frame.min())} to {int(frame.max())}", len(self.start) - 1
            raise IndexError(f"{keys.FRAME!r} has steps {steps}, but the data hold 0 to {last}") from error
        index = frame + self.action_offsets
        is_pad = index[:, before:] > end
        action = _rows(self.action, index.clamp(start, end))
        target = action[:, before:]
        # Before the episode the gather repeats its first action, which belongs to the target: zero it.
        executed = action[:, :before] * (index[:, :before] >= start).unsqueeze(-1)
        history = window_history(executed, frame - start, target, self.chunk_length)
        recent = (frame + self.observation_offsets).clamp_min(start)
        written = ((key, _rows(self.get_buffer(name), recent)) for name, key in self._observations.items())
        for key, value in (*written, *zip(self.out_keys[1:], (target, is_pad, history), strict=True)):
            tensordict.set(key, value.reshape(*batch, *value.shape[1:]))
        return tensordict


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


def _episode_borders(episode: Tensor) -> tuple[Tensor, Tensor]:
    """Return the first and the last step of every step's episode, each ``[N]``."""
    values, lengths = torch.unique_consecutive(episode, return_counts=True)
    numbers, times = values.unique(return_counts=True)
    if (times > 1).any():
        number = int(numbers[times > 1][0])
        raise ValueError(f"the steps of episode {number} are not contiguous: order all by episode and time")
    last = lengths.cumsum(0) - 1
    first = last - lengths + 1
    return first.repeat_interleave(lengths), last.repeat_interleave(lengths)


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

    It stores only step numbers; :class:`ActionWindow` gathers the windows, which is faster than reading whole
    steps.

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
    windows = window_transforms(data, prior, generator=generator, **options)
    window = windows[0]
    frames = torch.arange(len(data), device=window.start.device)
    if isinstance(prior, PastPrior) and (reach := int((frames - window.start).max())) < prior.chunk_length:
        words = f"no episode has more than {reach + 1} steps, so {prior} is never warm: shorten the chunk"
        warnings.warn(words, stacklevel=1)  # from one place, so the two buffers of a training warn once
    return TensorDictReplayBuffer(
        # The sampler draws on the storage's device, where the generator must be too.
        storage=TensorStorage(TensorDict({keys.FRAME: frames}, [len(data)]), device=frames.device),
        writer=ImmutableDatasetWriter(),
        batch_size=batch_size,
        transform=windows,
        generator=generator,
    )


def without_images(data: TensorDictBase) -> TensorDictBase:
    """Return steps without images, which would fill the memory in thousands of windows."""
    observation = data.get(keys.OBSERVATION)
    if not isinstance(observation, TensorDictBase) or keys.STATE not in observation:
        return data
    return data.copy().set(keys.OBSERVATION, observation.select(keys.STATE))
