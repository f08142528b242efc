"""Options of evaluations."""

EVALUATION_SEED = 10_000_000
"""Simulator seed of the first evaluation episode.

Demonstrations are generated from smaller ones, so a policy is never evaluated on an initial state it was
trained on.
"""
