"""One episode in pictures: a video, or a strip of a few frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

from warmprior.evaluation.episodes import play_episode
from warmprior.io.extras import require
from warmprior.io.files import check_writable, write_atomic
from warmprior.keys import SUCCESS
from warmprior.modules.actor import WarmPriorActor
from warmprior.transforms.inner_step import EnvTransform


class _Recorder(EnvTransform):
    """A recorder of a function's results after the reset and after every control step."""

    def __init__(self, look: Callable[[], Any]) -> None:
        super().__init__()
        self.look = look
        self.records: list[Any] = []

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        self.records.append(self.look())
        return next_tensordict


def _write(path: Path, pictures: Iterable[np.ndarray], size: int, rate: float) -> None:
    """Write a video with ``rate`` pictures per second."""
    av = require("av", "lerobot")

    def write(temporary: Path) -> None:
        with av.open(str(temporary), "w", format="mp4") as container:
            stream = container.add_stream("h264", rate=Fraction(float(rate)).limit_denominator(1000))
            stream.width = stream.height = size
            stream.pix_fmt = "yuv420p"
            for picture in pictures:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            container.mux(stream.encode())

    write_atomic(path, write)


def _resized(image: np.ndarray, size: int) -> np.ndarray:
    from PIL import Image

    return np.asarray(Image.fromarray(image).convert("RGB").resize((size, size)))


def _picture(env: Any) -> np.ndarray:
    try:
        # Gymnasium's MuJoCo environments raise another error if they were made without a render mode.
        picture = env.render() if getattr(env, "render_mode", "rgb_array") is not None else None
    except NotImplementedError:
        picture = None
    picture = np.array(picture)  # copied, because an environment may draw all into one buffer
    if picture.dtype != np.uint8 or picture.ndim > 3:
        raise ValueError(
            "the environment draws no pictures, uint8 [h, w, 3]: make it with render_mode='rgb_array', or "
            "request no videos (video_rate=None)"
        )
    return picture


@dataclass(frozen=True)
class Filmstrip:
    """The evenly spaced frames of one episode.

    Attributes:
        frames: pictures, uint8 ``[h, w, 3]`` each; the first before the first action, the last at the end.
        steps: control steps executed before each frame.
        success: True if the task was solved.

    Examples:
        >>> import numpy as np
        >>> from warmprior.evaluation import Filmstrip
        >>> strip = Filmstrip([np.zeros((160, 160, 3), np.uint8)] * 3, steps=[0, 38, 76], success=True)
        >>> np.hstack(strip.frames).shape
        (160, 480, 3)
    """

    frames: list[np.ndarray]
    steps: list[int]
    success: bool


def record_filmstrip(
    actor: WarmPriorActor,
    *,
    seed: int,
    nfe: int | None = None,
    policy_seed: int = 0,
    frames: int = 9,
    size: int = 160,
    video: Path | None = None,
    env: TransformedEnv | None = None,
    rate: float | None = None,
    **options: Any,
) -> Filmstrip:
    """Play the same episode as :func:`play_episode`, and render evenly spaced control steps.

    Args:
        actor: a policy that keeps its environment's description.

    Keyword Args:
        seed: simulator seed of the episode.
        nfe: network evaluations per chunk; the policy's own by default.
        policy_seed: seed of the source samples.
        frames: number of pictures.
        size: side of a picture in pixels; it must be even for a video.
        video: path of an MP4 of the episode, if one is to be written; needs PyAV.
        env: environment to play instead of the one that the policy describes, with the policy's transforms;
            its base must have a method ``render`` that returns a picture, uint8 ``[h, w, 3]``. It is closed
            at the end.
        rate: control steps per second of a video; that of the policy's environment by default.
        options: further options of :func:`~warmprior.envs.environment_of`; and ``success``, see
            :func:`play_episode`.

    Raises:
        ImportError: if this machine cannot render; the message names the packages to install.
        ValueError: if the policy keeps no description of its environment, or the size of a video is odd.

    Examples:
        >>> from pathlib import Path
        >>> from warmprior.evaluation import record_filmstrip
        >>> from warmprior.saving import load_policy
        >>> actor = load_policy("policy_010000")  # doctest: +SKIP
        >>> record_filmstrip(actor, seed=10_000_000, nfe=1, frames=5).steps  # doctest: +SKIP
        [0, 24, 48, 71, 95]
        >>> record_filmstrip(actor=None, seed=0, size=161, video=Path("video.mp4"))
        Traceback (most recent call last):
            ...
        ValueError: the side of a video must be an even number of pixels, got 161
    """
    if video is not None and (size < 2 or size % 2):  # the encoder takes pixels two by two
        raise ValueError(f"the side of a video must be an even number of pixels, got {size}")
    success = options.pop("success", SUCCESS)
    renders_itself = env is not None
    if env is None:
        from warmprior.envs.description import environment_of, is_registered
        from warmprior.envs.rendering import EnvRenderers, require_rendering

        renders_itself = is_registered(actor.environment)
        if renders_itself:
            options["render_mode"] = "rgb_array"
        else:
            require_rendering()
        env = environment_of(actor, **options)
    frame: Callable[[Any, int], np.ndarray] = _resized
    quick: Callable[[Any, int], np.ndarray] = _resized
    if renders_itself:
        look = partial(_picture, env.base_env)
        rate = rate or getattr(env.base_env, "metadata", {}).get("render_fps")
    else:
        simulator, loop = env.base_env, env.base_env.loop
        look = loop.state
        # Rendering every control step of a video in full quality would take ten times as long as the episode.
        renderer, nq = EnvRenderers(loop.env, fast=True), loop.env.sim.model.nq
        frame, quick = (
            lambda state, size: simulator.render_frame(size=size, state=state),
            lambda state, size: renderer.render(simulator.camera, size, size, state[1 : 1 + nq]),
        )
        rate = rate or round(1 / loop.env.control_timestep)
    # Inserted first, so that it runs at every control step inside a chunk.
    recorder = _Recorder(look)
    env.transform.insert(0, recorder)
    try:
        played = play_episode(actor, env, seed, nfe=nfe, policy_seed=policy_seed, success=success)
        records = recorder.records
        steps = np.unique(np.linspace(0, len(records) - 1, frames).round().astype(int))
        pictures = [frame(records[step], size) for step in steps]
        if video is not None:
            _write(video, (quick(record, size) for record in records), size, rate or 20)
    finally:
        env.close()
    return Filmstrip(pictures, steps.tolist(), played.success)


def check_video(path: Path, actor: WarmPriorActor) -> None:
    """Raise an error, before any episode, if a video could not be written or does not end in .mp4."""
    from warmprior.envs.description import is_registered
    from warmprior.envs.rendering import require_rendering

    if path.suffix != ".mp4":
        raise ValueError(f"{path} must end in .mp4: videos have no other format")
    require("av", "lerobot")
    if not is_registered(actor.environment):  # Gymnasium's environments draw by themselves
        require_rendering()
    check_writable(path.parent)
