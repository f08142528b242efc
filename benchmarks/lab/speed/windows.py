"""Windows per second, over bare torch and over LeRobot's own reader."""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import torch
from tensordict import TensorDict
from tqdm import tqdm

from lab.speed.timing import BATCH, D_A, D_O, PRIOR, TO, Clock, H, steps
from warmprior import window_replay_buffer
from warmprior.data import open_demonstrations


def bare_windows(data: TensorDict, batch: int) -> Callable[[], list[torch.Tensor]]:
    """Return a function that samples windows in bare torch."""
    observation, action, episode = (data[key] for key in ("observation", "action", "episode"))
    length = int((episode == 0).sum())
    before, ahead = torch.arange(1 - TO, 1), torch.arange(-H, H)

    def sample() -> list[torch.Tensor]:
        frame = torch.randint(len(data), (batch, 1))
        start = frame - frame % length
        index = frame + ahead
        warm = index[:, :1] >= start
        actions = action[index.clamp(start, start + length - 1)]
        history, target = actions[:, :H], actions[:, H:]
        observations = observation[(frame + before).clamp_min(start)]
        is_pad = index[:, H:] >= start + length
        return [observations, target, is_pad, history * warm.unsqueeze(-1), warm]

    return sample


def bare_ranges(data: TensorDict, batch: int) -> Callable[[], list[torch.Tensor]]:
    """Return a function that samples windows in bare torch, each as a range of padded episodes."""
    observation, action, episode = (data[key] for key in ("observation", "action", "episode"))
    episodes, length = int(episode[-1]) + 1, int((episode == 0).sum())
    actions = action.view(episodes, length, -1)
    before, behind = torch.zeros_like(actions[:, :H]), actions[:, -1:].expand(-1, H - 1, -1)
    actions = torch.cat([before, actions, behind], 1).flatten(0, 1)
    seen = observation.view(episodes, length, -1)
    seen = torch.cat([seen[:, :1].expand(-1, TO - 1, -1), seen], 1).flatten(0, 1)
    is_pad = torch.zeros(episodes, length + 2 * H - 1, dtype=torch.bool)
    is_pad[:, H + length :] = True
    frame = torch.arange(len(data))
    steps_before = (frame % length).clamp_max(H).unsqueeze(-1)
    rows, seen_rows = frame + episode * (2 * H - 1), frame + episode * (TO - 1)
    ranges = actions.unfold(0, 2 * H, 1).mT, seen.unfold(0, TO, 1).mT, is_pad.flatten()[H:].unfold(0, H, 1)

    def sample() -> list[torch.Tensor]:
        frame = torch.randint(len(data), (batch,))
        row = rows.index_select(0, frame)
        moved = ranges[0].index_select(0, row)
        history, target = moved[:, :H], moved[:, H:]
        observations = ranges[1].index_select(0, seen_rows.index_select(0, frame))
        known = steps_before.index_select(0, frame)
        forecast, forecast_steps = torch.zeros_like(target), torch.zeros_like(known)
        padding = ranges[2].index_select(0, row)
        return [observations, target, padding, history, known, forecast, forecast_steps]

    return sample


def windows_over_torch(
    clock: Clock, bare: Callable[[TensorDict, int], Callable[[], object]] = bare_windows
) -> dict[str, float]:
    """Measure windows per second of the replay buffer over bare torch, by batch size."""
    data, ratio_by_batch = steps(400, 200), {}
    for batch in (BATCH, 1024):
        buffer = window_replay_buffer(data, PRIOR, batch_size=batch, observation_steps=TO)
        ratio_by_batch[str(batch)] = clock.ratio(bare(data, batch), buffer.sample, calls=100)
    return ratio_by_batch


def lerobot_windows_over_getitem(clock: Clock) -> float | None:
    """Measure windows per second from a LeRobotDataset over its own ``__getitem__``."""
    os.environ |= {"HF_HUB_OFFLINE": "1", "HF_DATASETS_OFFLINE": "1"}
    if not all(find_spec(name) for name in ("lerobot", "datasets", "pyarrow")):
        tqdm.write("lerobot_windows_over_getitem: skipped, because it needs warmprior[lerobot]")
        return None
    logging.disable(logging.WARNING)  # LeRobot warns of video decoders, which are not used here
    from lerobot.datasets import LeRobotDataset

    data, fps = steps(25, 200), 20
    kind = {"dtype": "float32", "names": None}
    features = {"observation.state": kind | {"shape": (D_O,)}, "action": kind | {"shape": (D_A,)}}
    with tempfile.TemporaryDirectory() as folder:
        root, name = Path(folder) / "data", "local/windows"
        options = {"fps": fps, "features": features, "root": root}
        written = LeRobotDataset.create(name, use_videos=False, **options)
        for episode in data.view(25, 200):
            for row in episode:
                state, action = row["observation"].numpy(), row["action"].numpy()
                written.add_frame({"observation.state": state, "action": action, "task": "none"})
            written.save_episode()
        written.finalize()
        offsets = {
            "action": [i / fps for i in range(-H, H)],
            "observation.state": [i / fps for i in range(1 - TO, 1)],
        }
        dataset = LeRobotDataset(name, root=root, delta_timestamps=offsets)
        demonstrations = open_demonstrations(f"lerobot:{root}").steps()
        buffer = window_replay_buffer(demonstrations, PRIOR, batch_size=BATCH, observation_steps=TO)
        ratio = clock.ratio(
            lambda: [dataset[i] for i in torch.randint(len(data), (64,)).tolist()],
            lambda: [buffer.sample() for _ in range(20)],
        )
    return ratio * 20 * BATCH / 64


windows_over_ranges = partial(windows_over_torch, bare=bare_ranges)
