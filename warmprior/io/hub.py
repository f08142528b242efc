"""The Hugging Face hub: what is fetched from it and sent to it, within a time, and its errors in a line."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from warmprior.io.extras import require

__all__ = ["deadline", "explained", "is_repository", "snapshot", "until", "upload"]

LIMIT_SECONDS = 3600.0
"""For everything that one call fetches or sends, whatever a server does."""

_TOKEN = "give a token (token=..., HF_TOKEN, or hf auth login)"


def deadline() -> float:
    """When a call that begins now has to be done, by ``time.monotonic()``."""
    return time.monotonic() + LIMIT_SECONDS


def is_repository(name: str) -> bool:
    """Whether a text has the form of a repository's name at the hub.

    Examples:
        >>> [is_repository(name) for name in ("user/name", "runs/a/b", "../name", "policy", "/tmp/name")]
        [True, False, False, False, False]
    """
    part = r"[A-Za-z0-9_]([A-Za-z0-9._-]*[A-Za-z0-9_])?"
    return bool(re.fullmatch(f"{part}/{part}", name)) and not re.search(r"\.\.|--|\.git$", name)


def snapshot(
    repository: str,
    files: Sequence[str],
    *,
    repo_type: str = "model",
    revision: str | None = None,
    cache_dir: Path | None = None,
    endpoint: str | None = None,
    token: str | None = None,
    extra: str = "sim",
) -> Path:
    """Fetch files of one commit of a repository, those that are not in the hub client's cache.

    Args:
        repository: such as ``"user/name"``.
        files: patterns of what is needed.

    Keyword Args:
        repo_type: ``"model"`` or ``"dataset"``.
        revision: branch, tag or commit; the main branch by default.
        cache_dir: the hub client's own by default.
        endpoint: address of the hub or of a server like it; by default the hub client's own.
        token: the hub client's own by default.
        extra: of this package, that has the hub's client.

    Returns:
        The folder of the commit, called by its name.

    Raises:
        ImportError: if huggingface_hub is not installed.
        Exception: the hub client's own, which share no base class; see :func:`explained`.
    """
    hub = require("huggingface_hub", extra)
    fetch = partial(
        hub.snapshot_download,
        repository,
        repo_type=repo_type,
        revision=revision,
        cache_dir=cache_dir,
        endpoint=endpoint,
        token=token,
        allow_patterns=list(files),
    )
    return until(deadline(), lambda: Path(fetch()))


def upload(
    folder: Path,
    repository: str,
    files: Sequence[str],
    *,
    message: str,
    private: bool | None = None,
    revision: str | None = None,
    endpoint: str | None = None,
    token: str | None = None,
) -> str:
    """Send files to a repository in one commit; repository and branch are made if needed.

    Args:
        folder: where the files lie.
        repository: such as ``"user/name"``.
        files: their names.

    Keyword Args:
        message: of the commit.
        private: whether a new repository is private; by default what the account has set.
        revision: branch; the main one by default.
        endpoint: see :func:`snapshot`.
        token: likewise.

    Returns:
        The commit.

    Raises:
        ImportError: if huggingface_hub is not installed.
        ValueError: if it is to be private, and there is a public one of the name. Nothing is sent.
        Exception: the hub client's own, see :func:`explained`.
    """
    hub = require("huggingface_hub", "sim")
    api = hub.HfApi(endpoint=endpoint, token=token)

    def send() -> str:
        api.create_repo(repository, private=private, exist_ok=True)
        if private and not api.repo_info(repository).private:
            raise ValueError(
                f"{repository} is there already, and public: choose another name, or make it private "
                "at the hub"
            )
        if revision is not None:
            api.create_branch(repository, branch=revision, exist_ok=True)
        commit = api.create_commit(
            repository,
            [hub.CommitOperationAdd(name, folder / name) for name in files],
            commit_message=message,
            revision=revision,
        )
        return str(commit.oid)

    return until(deadline(), send)


def explained(error: Exception, repository: str, revision: str | None = None) -> OSError:
    """What the hub client raised, in a line that tells what to do.

    Args:
        error: of :func:`snapshot` or :func:`upload`.
        repository: which was asked for.
        revision: likewise.

    Returns:
        ``FileNotFoundError`` if there is no such repository or revision, ``PermissionError`` if it is not
        for this user, ``ConnectionError`` if the hub may not or cannot be asked, else ``OSError``.
    """
    # Both by their own names: the package loads them when they are asked for.
    kinds = require("huggingface_hub.errors", "sim")
    offline = require("huggingface_hub.constants", "sim").HF_HUB_OFFLINE
    if isinstance(error, RuntimeError) and isinstance(error.__cause__, Exception):
        error = error.__cause__  # a file's upload tells no more than that it failed
    status = getattr(getattr(error, "response", None), "status_code", None)
    if isinstance(error, kinds.GatedRepoError):
        return PermissionError(
            f"the owner of {repository} decides who may read it: ask for access on its page at the hub, "
            f"and {_TOKEN}"
        )
    if isinstance(error, kinds.RevisionNotFoundError):
        return FileNotFoundError(
            f"{repository} at the hub has no branch, tag or commit {revision or 'main'}: look at its page"
        )
    if isinstance(error, kinds.RepositoryNotFoundError):
        return FileNotFoundError(
            f"the hub has no repository {repository}, or a private one: check the name, and for a "
            f"private one {_TOKEN}"
        )
    if status in (401, 403):
        return PermissionError(
            f"the hub does not allow this with {repository}: {_TOKEN} that has the permission"
        )
    if offline and isinstance(error, kinds.OfflineModeIsEnabled | kinds.LocalEntryNotFoundError):
        cached = isinstance(error, kinds.LocalEntryNotFoundError)
        return ConnectionError(
            f"the hub may not be asked for {repository}, as HF_HUB_OFFLINE is set"
            f"{', and it is not in the cache' if cached else ''}: unset it"
        )
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    reason = f"{type(error).__name__}: {lines[0] if lines else 'no message'}"
    if status is None and not isinstance(error, kinds.RemoteEntryNotFoundError):
        return ConnectionError(
            f"the hub cannot be reached for {repository}: check the connection ({reason})"
        )
    return OSError(f"the hub failed on {repository}: try again later ({reason})")


def until[T](latest: float, call: Callable[[], T]) -> T:
    """Call something that may never end; left behind, it ends with the process.

    Args:
        latest: when it has to be done, see :func:`deadline`.
        call: what is called, in a thread.

    Raises:
        TimeoutError: if it has not returned by then.
    """
    result: list[T] = []
    failure: list[BaseException] = []

    def run() -> None:
        try:
            result.append(call())
        except BaseException as error:
            failure.append(error)

    thread = threading.Thread(target=run, name="hub", daemon=True)
    thread.start()
    thread.join(max(0.0, latest - time.monotonic()))
    if failure:
        raise failure[0]
    if not result:
        raise TimeoutError(f"not complete after {LIMIT_SECONDS:.0f} s")
    return result[0]
