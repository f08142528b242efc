"""Errors of runs, some of which failed in part."""

from __future__ import annotations

from warmprior.io import script


class PartialFailure(RuntimeError):
    """Raised if some of the work failed; the rest is done and saved."""


ERRORS = (*script.ERRORS, PartialFailure)
"""Errors that a user can mend; they are reported without a traceback."""
