"""robomimic's and MimicGen's demonstrations: the official files, and a TorchRL replay buffer of any file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from warmprior.data.hdf5 import RobomimicReader, open_robomimic, read_index
from warmprior.data.replay import DatasetError, DemonstrationReplay
from warmprior.envs.mimicgen import is_mimicgen
from warmprior.envs.tasks import TASKS
from warmprior.io.extras import require
from warmprior.io.files import file_digest

REPOSITORIES = ("robomimic/robomimic_datasets", "amandlek/robomimic")
"""The hub's dataset repositories that hold robomimic's files, in the order of trying."""

MIMICGEN_REPOSITORY = "amandlek/mimicgen_datasets"
"""The one that holds MimicGen's, under the licence CC BY-NC-SA 4.0."""


def download_robomimic(
    task: str, style: str | None = None, *, root: str | Path | None = None, force: bool = False
) -> Path:
    """Download an official low-dimensional file of robomimic or MimicGen, unless it is there already.

    robomimic's is ``v1.5/{task}/{style}/low_dim_v15.hdf5`` of the first of :data:`REPOSITORIES` that
    delivers it, and MimicGen's ``source/stack.hdf5`` or ``core/stack_d0.hdf5`` (and the like) of
    :data:`MIMICGEN_REPOSITORY`, whose licence, CC BY-NC-SA 4.0, excludes commercial use. The file, whose path
    is returned, is opened and compared with the digest that the hub gives, where that can be reached; one
    that fails is fetched once more.

    Args:
        task: ``lift``, ``can``, ``square``, ``transport`` or ``tool_hang``; ``stack_d0``, ``coffee_d0`` or
            ``threading_d0`` of MimicGen.
        style: ``"ph"`` (one proficient operator) or ``"mh"`` (six operators); of MimicGen ``"source"`` (ten
            human demonstrations) or ``"core"`` (a thousand that MimicGen made of them). The former by
            default.
        root: the folder under which to keep the file; by default the hub client's cache.
        force: download again even if the file is there.

    Raises:
        ValueError: if there is no official file of the task or style.
        OSError: if no repository delivers a readable file; names every attempt and its cause.

    Examples:
        >>> from warmprior.data import download_robomimic
        >>> download_robomimic("square", "mh")  # doctest: +SKIP
        PosixPath('.../v1.5/square/mh/low_dim_v15.hdf5')
        >>> download_robomimic("tool_hang", "mh")
        Traceback (most recent call last):
            ...
        ValueError: tool_hang has no official 'mh' data; it has: ph
    """
    official = {name: spec.official for name, spec in TASKS.items() if spec.official}
    if task not in official:
        raise ValueError(f"no official data for task {task!r}; choose one of {', '.join(official)}")
    style = official[task][0] if style is None else style
    if style not in official[task]:
        raise ValueError(f"{task} has no official {style!r} data; it has: {', '.join(official[task])}")
    if not is_mimicgen(TASKS[task].env_name):
        return _download(f"v1.5/{task}/{style}/low_dim_v15.hdf5", REPOSITORIES, root, force)
    # The human demonstrations belong to the task, those made of them to a variant of it.
    name = task.removesuffix("_d0") if style == "source" else task
    return _download(f"{style}/{name}.hdf5", (MIMICGEN_REPOSITORY,), root, force)


def _download(name: str, repositories: Sequence[str], root: str | Path | None, force: bool) -> Path:
    """Fetch and check a file of the first repository that delivers it."""
    hub = require("huggingface_hub", "sim")
    require("h5py", "sim")
    failures: list[str] = []
    for repository in repositories:
        where = {"repo_id": repository, "filename": name, "repo_type": "dataset"}
        for anew in dict.fromkeys((force, True)):  # a damaged copy is fetched once more
            try:
                path = Path(hub.hf_hub_download(**where, local_dir=root, force_download=anew))
                published = _published_digest(hub, where)
                if published is not None and file_digest(path) != published:
                    raise DatasetError(
                        f"{path}: its sha256 is not the {published} that the hub publishes: it was damaged "
                        "on the way or on this disk"
                    )
                with open_robomimic(path):
                    return path
            # The client's failures share no base class: its own errors, those of the HTTP library
            # underneath, and OSError for a broken connection, a full disk or a short file.
            except Exception as error:
                cause = error
                if not isinstance(error, DatasetError):
                    break
        failures.append(f"{repository}: {type(cause).__name__}: {str(cause).strip() or 'no message'}")
    raise OSError(
        f"could not download {name}:\n- "
        + "\n- ".join(failures)
        + "\nCheck the connection; force=True replaces a broken local copy, and a file fetched by "
        "other means can be given by its path."
    ) from cause


def _published_digest(hub: Any, where: dict[str, Any]) -> str | None:
    """SHA-256 of a file at the hub; ``None`` if the hub cannot be reached or gives another kind."""
    try:
        etag = hub.get_hf_file_metadata(hub.hf_hub_url(**where)).etag
    except Exception:  # without a connection, what is there has to do
        return None
    return etag if etag is not None and len(etag) == 64 else None


class RobomimicExperienceReplay(DemonstrationReplay):
    """Demonstrations of an HDF5 file of robomimic or MimicGen, as one immutable TorchRL replay buffer.

    The whole selection becomes a flat, contiguous :class:`~tensordict.TensorDict` of ``N`` steps, in
    the order of the demos' numbers:

    - ``"observation"`` ``[N, d_o]`` float32, the observation keys side by side; with images nested,
      ``("observation", "state")`` ``[N, d_s]`` and each as uint8 ``[N, 3, size, size]``;
    - ``"action"`` ``[N, d_a]`` float32, as recorded (not normalised);
    - ``("next", "reward")`` ``[N, 1]`` float32;
    - ``("next", "done")``, ``("next", "terminated")``, ``("next", "truncated")`` ``[N, 1]`` bool: done
      on the last step of each demo, terminated there if its reward is positive, else truncated;
    - ``"episode"`` ``[N]`` int64, counted from 0, and ``"frame"`` ``[N]`` int64, the row itself.

    Names, shapes and masks are checked before values are read.

    Args:
        path: an HDF5 file, such as one of :func:`warmprior.data.download_robomimic`.
        filter_key: a mask of the file, such as ``"train"``; all demos if ``None``.
        demos: how many to take, the first ones by their numbers; all if ``None``.
        observation_keys: observations to concatenate; by default those of the task, or for an
            unknown environment the object and every robot's pose and gripper.
        image_keys: images to read as well, such as ``"agentview_image"``. They stay bytes; take
            ``storage="memmap"`` where they are many.
        absolute_actions: turn the recorded pose deltas into absolute poses
            (see :func:`warmprior.envs.absolute_actions`); ``d_a`` becomes 10 per arm.
        **kwargs: ``storage``: ``"memory"``, or ``"memmap"`` for files under ``scratch_dir``, by default
            temporary ones; ``device`` of the tensors in memory; and ``batch_size``, ``sampler``,
            ``transform``, ``prefetch``, ``pin_memory`` or ``generator`` of TorchRL's.

    Raises:
        FileNotFoundError: if there is no such file.
        DatasetError: if the file is not as it should be; says which demo and key.
        ValueError: if ``storage`` is unknown or does not fit ``device``, or absolute actions are asked
            of a controller without pose deltas.
        OSError: if there is no space for memory maps.

    Examples:
        >>> from warmprior.data import RobomimicExperienceReplay
        >>> data = RobomimicExperienceReplay("square.hdf5", batch_size=256)  # doctest: +SKIP
        >>> data.sample()["observation"].shape  # doctest: +SKIP
        torch.Size([256, 23])
        >>> RobomimicExperienceReplay("nowhere.hdf5")
        Traceback (most recent call last):
            ...
        FileNotFoundError: nowhere.hdf5: no such file; check the path, or fetch it (download_robomimic)
    """

    def __init__(
        self,
        path: str | Path,
        *,
        filter_key: str | None = None,
        demos: int | None = None,
        observation_keys: Sequence[str] | None = None,
        image_keys: Sequence[str] = (),
        absolute_actions: bool = False,
        **kwargs: Any,
    ) -> None:
        index = read_index(
            path,
            filter_key=filter_key,
            observation_keys=observation_keys,
            image_keys=image_keys,
            poses=absolute_actions,
            demos=demos,
        )
        with open_robomimic(path) as file:
            super().__init__(index, RobomimicReader(file), absolute_actions=absolute_actions, **kwargs)
