"""One episode as a film."""

from __future__ import annotations

from pathlib import Path

from tensordict import TensorDictBase
from torchrl.envs.transforms import Transform

from warmprior.envs.description import environment_of
from warmprior.envs.rendering import require_rendering
from warmprior.envs.robosuite import RobosuiteEnv
from warmprior.io.extras import require
from warmprior.io.files import check_writable, write_atomic
from warmprior.modules.actor import WarmPriorActor
from warmprior.training.evaluation import play_episode

__all__ = ["record_video"]


class _Recorder(Transform):
    """Renders the simulator after the reset and after every control step."""

    def __init__(self, env: RobosuiteEnv, size: int) -> None:
        super().__init__()
        self.__dict__["env"], self.size = env, size  # no submodule: the environment contains this
        self.frames: list = []

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        self.frames.append(self.env.render_frame(size=self.size))
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)


def check_video(path: Path) -> None:
    """Refuse what :func:`record_video` could not write, before anything is played.

    Raises:
        ImportError: if PyAV is missing.
        RuntimeError: if nothing on this machine can render.
        OSError: if the folder cannot be written to.
    """
    require("av", "lerobot")
    require_rendering()
    check_writable(path.parent)


def record_video(
    actor: WarmPriorActor,
    path: Path,
    *,
    seed: int,
    nfe: int | None = None,
    policy_seed: int = 0,
    size: int = 256,
) -> bool:
    """Play the episode of one seed and write it as an MP4, a frame per control step.

    It is the very episode that :func:`play_episode` plays.

    Args:
        actor: a policy that keeps its environment's description.
        path: of the MP4.

    Keyword Args:
        seed: simulator seed of the episode.
        nfe: network evaluations per chunk; the policy's own by default.
        policy_seed: of the source samples.
        size: side of the picture in pixels, even.

    Returns:
        Whether the task was solved.

    Raises:
        ImportError: if PyAV is missing.
        RuntimeError: if nothing on this machine can render; the message names the packages to install.
        ValueError: if the policy keeps no description of its environment.
    """
    av = require("av", "lerobot")
    env = environment_of(actor)
    recorder = _Recorder(env.base_env, size)
    assert actor.environment is not None  # or there were no environment
    kwargs = actor.environment["robosuite"]["env_args"]["env_kwargs"]
    # First, and so one of the transforms that run at every control step inside of a chunk.
    env.transform.insert(0, recorder)
    try:
        outcome = play_episode(actor, env, seed, nfe=nfe, policy_seed=policy_seed)
    finally:
        env.close()

    def write(temporary: Path) -> None:
        with av.open(str(temporary), "w", format="mp4") as container:
            stream = container.add_stream("h264", rate=round(kwargs.get("control_freq", 20)))
            stream.width = stream.height = size
            stream.pix_fmt = "yuv420p"
            for frame in recorder.frames:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
            container.mux(stream.encode())

    write_atomic(path, write)
    return outcome.success
