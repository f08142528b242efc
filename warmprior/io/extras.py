"""Optional dependencies: the core needs only what `pip install warmprior` brings."""

from __future__ import annotations

import importlib
import importlib.util
from types import ModuleType


def require(module: str, extra: str) -> ModuleType:
    """Import an optional module, or raise ImportError with the extra of this package that provides it.

    It is looked up before, so an error *inside* an installed module is not mistaken for a missing one.

    Examples:
        >>> from warmprior.io.extras import require
        >>> require("no_such_module", "sim")
        Traceback (most recent call last):
            ...
        ImportError: no_such_module is not installed; run: pip install 'warmprior[sim]'
    """
    try:
        spec = importlib.util.find_spec(module)
    except ModuleNotFoundError:  # a parent package is missing
        spec = None
    if spec is None:
        raise ImportError(f"{module} is not installed; run: pip install 'warmprior[{extra}]'")
    return importlib.import_module(module)
