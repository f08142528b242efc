"""Options of the source, and its defaults.

A source is named by the ``name`` of a prior that ``warmprior/modules/__init__.py`` imports.
"""

from __future__ import annotations

from dataclasses import dataclass

DEFAULT_PRIOR = "past,correlation=0.5"
"""The source of ``train`` and of the plugin, with its options, unless actions are absolute targets."""

PRIOR_OF_TARGETS = "gaussian"
"""The source of ``train`` and of the plugin for absolute targets; it needs the same steps."""


@dataclass(frozen=True)
class SourceOptions:
    """The options of the source.

    Attributes:
        prior: source (gaussian, past, preview, cvae, or package.module:Class of your own), with options as
            in past,sigma=0.3; by default {DEFAULT_PRIOR}, or {PRIOR_OF_TARGETS} if actions are absolute
            targets
        chunk: chunk length H
    """

    prior: str | None = None
    chunk: int = 8


SourceOptions.__doc__ = str(SourceOptions.__doc__).format(
    DEFAULT_PRIOR=DEFAULT_PRIOR, PRIOR_OF_TARGETS=PRIOR_OF_TARGETS
)
