"""Downloads of the official files of robomimic and MimicGen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from warmprior.checks import check_choice
from warmprior.io.extras import require
from warmprior.io.files import file_digest

REPOSITORIES = ("robomimic/robomimic_datasets", "amandlek/robomimic")
"""Dataset repositories of the hub with robomimic's files, in the order in which they are tried."""

OFFICIAL = {
    **dict.fromkeys(("lift", "can", "square", "transport"), ("ph", "mh")),
    "tool_hang": ("ph",),
    **dict.fromkeys(("stack_d0", "coffee_d0", "threading_d0"), ("source", "core")),
}
"""The styles of data that robomimic or MimicGen publish, by task."""

MIMICGEN_REPOSITORY = "amandlek/mimicgen_datasets"
"""The dataset repository of MimicGen's files, under the licence CC BY-NC-SA 4.0."""


def download_robomimic(
    task: str, style: str | None = None, *, root: str | Path | None = None, force: bool = False
) -> Path:
    """Download an official low-dimensional file of robomimic or MimicGen, unless it is already here.

    robomimic's file is ``v1.5/{task}/{style}/low_dim_v15.hdf5`` from the first of :data:`REPOSITORIES` that
    delivers it. MimicGen's is, for example, ``source/stack.hdf5`` or ``core/stack_d0.hdf5`` from
    :data:`MIMICGEN_REPOSITORY`, whose licence, CC BY-NC-SA 4.0, excludes commercial use. The file, whose path
    is returned, is opened and, if the hub can be reached, compared with the hub's digest. A damaged file is
    downloaded once more.

    Args:
        task: ``lift``, ``can``, ``square``, ``transport`` or ``tool_hang``; ``stack_d0``, ``coffee_d0`` or
            ``threading_d0`` of MimicGen.
        style: ``"ph"`` (one proficient operator) or ``"mh"`` (six operators); for MimicGen ``"source"`` (ten
            human demonstrations) or ``"core"`` (a thousand that MimicGen made from them). The first of each
            pair by default.
        root: folder for the file; by default the hub client's cache.
        force: download again, even if the file is here.

    Raises:
        ValueError: if there is no official file of the task or style.
        OSError: if no repository delivers a readable file; it names every attempt and its cause.

    Examples:
        >>> from lab.demonstrations.downloads import download_robomimic
        >>> download_robomimic("square", "mh")  # doctest: +SKIP
        PosixPath('.../v1.5/square/mh/low_dim_v15.hdf5')
        >>> download_robomimic("tool_hang", "mh")
        Traceback (most recent call last):
            ...
        ValueError: the style of official data of tool_hang must be one of ph, got 'mh'
    """
    from warmprior.envs.mimicgen import is_mimicgen
    from warmprior.envs.robosuite_tasks import TASKS

    check_choice("the task of official data", task, OFFICIAL)
    style = OFFICIAL[task][0] if style is None else style
    check_choice(f"the style of official data of {task}", style, OFFICIAL[task])
    if not is_mimicgen(TASKS[task].env_name):
        return _download(f"v1.5/{task}/{style}/low_dim_v15.hdf5", REPOSITORIES, root, force)
    # Human demonstrations are published per task, generated ones per variant of a task.
    name = task.removesuffix("_d0") if style == "source" else task
    return _download(f"{style}/{name}.hdf5", (MIMICGEN_REPOSITORY,), root, force)


def _download(name: str, repositories: Sequence[str], root: str | Path | None, force: bool) -> Path:
    """Download and check a file from the first repository that delivers it."""
    from warmprior.data.checks import DatasetError
    from warmprior.data.formats.hdf5 import open_robomimic

    hub = require("huggingface_hub", "sim")
    require("h5py", "sim")
    failures: list[str] = []
    for repository in repositories:
        where = {"repo_id": repository, "filename": name, "repo_type": "dataset"}
        for again in dict.fromkeys((force, True)):  # a damaged copy is downloaded once more
            try:
                path = Path(hub.hf_hub_download(**where, local_dir=root, force_download=again))
                published = _published_digest(hub, where)
                if published is not None and file_digest(path) != published:
                    raise DatasetError(
                        f"{path}: its sha256 is not the {published} that the hub publishes: it was damaged "
                        "on the way or on this disk"
                    )
                with open_robomimic(path):
                    return path
            # Errors of the client share no base class: there are its own, those of its HTTP library, and
            # OSError for a broken connection, a full disk or a short file.
            except Exception as error:
                cause = error
                if not isinstance(error, DatasetError):
                    break
        failures.append(f"{repository}: {type(cause).__name__}: {str(cause).strip() or 'no message'}")
    raise OSError(
        f"could not download {name}:\n- "
        + "\n- ".join(failures)
        + "\nCheck the connection; force=True replaces a broken local copy, and a file from elsewhere can be "
        "given by its path."
    ) from cause


def _published_digest(hub: Any, where: dict[str, Any]) -> str | None:
    """Return the SHA-256 of a file at the hub; ``None`` if the hub has none or cannot be reached."""
    try:
        etag = hub.get_hf_file_metadata(hub.hf_hub_url(**where)).etag
    except Exception:  # without a connection the local copy is used unchecked
        return None
    return etag if etag is not None and len(etag) == 64 else None
