"""The Hugging Face hub: what is fetched from it, and calls that end within a time."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from warmprior.io.extras import require

__all__ = ["deadline", "is_repository", "snapshot", "until"]

LIMIT_SECONDS = 3600.0
"""For everything that one call fetches or sends, whatever a server does."""


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
    return bool(re.fullmatch(f"{part}/{part}", name))


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
        Exception: the hub client's own, most of them an ``OSError``.
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
