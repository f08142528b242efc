"""The files of a saved policy: their layout, and their way to the hub and back."""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from warmprior.io.files import file_digest, read_json
from warmprior.io.hub import explained, is_repository, snapshot, upload

__all__ = [
    "CARD",
    "CONFIG",
    "FORMAT",
    "WEIGHTS",
    "pretrained_digest",
    "pretrained_folder",
    "push",
    "read_config",
]

FORMAT = 3
"""Version of the layout that :meth:`WarmPriorActor.save_pretrained` writes."""

CONFIG, WEIGHTS, CARD = "config.json", "model.safetensors", "README.md"


def pretrained_digest(config: dict[str, Any], weights: Path) -> str:
    """Digest of a configuration and of the file of weights that belongs to it.

    Args:
        config: without the digest, or with it.
        weights: the file.
    """
    text = json.dumps({k: v for k, v in config.items() if k != "sha256"}, sort_keys=True)
    return hashlib.sha256((text + file_digest(weights)).encode()).hexdigest()


def read_config(path: Path) -> dict[str, Any]:
    """Read the configuration of a saved policy.

    Args:
        path: of the file.

    Raises:
        FileNotFoundError: if it is missing.
        ValueError: if it is damaged, of another format version or of something else.
    """
    if not path.exists():
        raise FileNotFoundError(f"no policy at {path.parent}: {path.name} is missing")
    config = read_json(path)
    found = config.get("format") if isinstance(config, dict) else None
    if found != FORMAT:
        raise ValueError(
            f"{path} has format {found}, this version of warmprior reads {FORMAT}: "
            "save the policy again with a matching version"
        )
    missing = [part for part in ("prior", "network", "actor", "normalizer") if part not in config]
    if missing:
        raise ValueError(f"{path} is incomplete: it lacks {', '.join(missing)}")
    return config


def pretrained_folder(
    place: str | Path,
    *,
    revision: str | None = None,
    token: str | None = None,
    endpoint: str | None = None,
) -> Path:
    """Where the files of a policy lie, fetched from the hub if need be.

    Args:
        place: a folder; or, as text, ``"user/name"`` of a repository, where there is no such folder.

    Keyword Args:
        revision: branch, tag or commit of the repository.
        token: for a private one.
        endpoint: address of the hub.

    Raises:
        FileNotFoundError: if there is no such repository or revision, or no policy in it.
        ValueError: if what is there is of something else, or a revision of a folder is asked for.
        OSError: if it cannot be had.
        ImportError: if huggingface_hub is not installed.
    """
    path = Path(place)
    remote = isinstance(place, str) and is_repository(place) and not path.exists()
    if not remote:
        if revision is not None:
            raise ValueError(
                f"{place} is a folder on this machine, or no user/name of a repository at the hub: leave out "
                f"revision={revision!r}"
            )
        return path
    name = str(place)
    # The small file first: a repository of something else may be large.
    folder = _fetched(name, CONFIG, revision, token, endpoint)
    try:
        config = read_config(folder / CONFIG)
        if not isinstance(config.get("sha256"), str):
            raise ValueError(f"it lacks the digest that push_to_hub writes into {CONFIG}")
    except ValueError as error:
        raise ValueError(f"{name} at the hub holds no policy of warmprior: {error}") from error
    # Of the same commit, whatever happens to the branch meanwhile.
    return _fetched(name, WEIGHTS, folder.name, token, endpoint)


def _fetched(
    repository: str, file: str, revision: str | None, token: str | None, endpoint: str | None
) -> Path:
    """The folder of a commit, with a file of it."""
    where = f"there is no folder {repository} here, and "
    try:
        folder = snapshot(repository, [file], revision=revision, token=token, endpoint=endpoint)
    except ImportError as error:
        raise ImportError(f"{where}to ask the hub {error}") from error
    except Exception as error:  # the client's share no base class
        told = explained(error, repository, revision)
        raise type(told)(f"{where}{told}") from error
    if not (folder / file).exists():
        raise FileNotFoundError(f"{repository} at the hub holds no policy: {file} is missing")
    return folder


def push(
    save: Callable[[Path], object],
    repository: str,
    *,
    card: str | None,
    private: bool | None,
    revision: str | None,
    message: str,
    token: str | None,
    endpoint: str | None,
) -> str:
    """Save a policy in a repository of the hub, see :meth:`WarmPriorActor.push_to_hub`.

    Args:
        save: writes its files into a folder.
        repository: such as ``"user/name"``.

    Keyword Args:
        card: text of its card; ``None`` leaves what is there.
        private: whether a new repository is private.
        revision: branch.
        message: of the commit.
        token: with which to write.
        endpoint: address of the hub.

    Returns:
        The commit.

    Raises:
        ValueError: if the name is none, or of a public repository where a private one is asked for.
        OSError: if the hub does not take it.
        ImportError: if huggingface_hub is not installed.
    """
    if not is_repository(repository):
        raise ValueError(f"{repository!r} is no name of a repository at the hub: use user/name")
    files = [CONFIG, WEIGHTS] + [CARD] * (card is not None)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        save(folder)
        if card is not None:
            (folder / CARD).write_text(card)
        try:
            return upload(
                folder,
                repository,
                files,
                message=message,
                private=private,
                revision=revision,
                endpoint=endpoint,
                token=token,
            )
        except Exception as error:  # the client's share no base class
            if isinstance(error, ImportError) or type(error) is ValueError:
                raise
            raise explained(error, repository, revision) from error
