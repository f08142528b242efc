"""Progress bars that the environment can turn off."""

from __future__ import annotations

from typing import Any

from tqdm import tqdm


def progress_bar(description: str | None, *args: Any, **options: Any) -> Any:
    """Return a bar of tqdm, hidden without a description.

    ``TQDM_DISABLE`` hides the others; ``disable=False`` would overrule it. The numbers
    beside a bar are set by its loop.
    """
    hidden = {"disable": True} if description is None else {}
    return tqdm(*args, desc=description, **options, **hidden)
