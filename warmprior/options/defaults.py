"""Defaults that several rooms share."""

DEFAULT_NFE = 3
"""The default number of network evaluations per chunk; docs/which_source.md has the reasons."""

EVALUATION_SEED = 10_000_000
"""Simulator seed of the first evaluation episode.

Demonstrations are generated from smaller ones, so a policy is never evaluated on an initial state it was
trained on.
"""
