"""Names of repositories at the Hugging Face hub; its own client fetches and sends."""

from __future__ import annotations

import re

__all__ = ["is_repository"]


def is_repository(name: str) -> bool:
    """Whether a text has the form of a repository's name at the hub.

    Examples:
        >>> [is_repository(name) for name in ("user/name", "runs/a/b", "../name", "policy", "/tmp/name")]
        [True, False, False, False, False]
    """
    part = r"[A-Za-z0-9_]([A-Za-z0-9._-]*[A-Za-z0-9_])?"
    return bool(re.fullmatch(f"{part}/{part}", name))
