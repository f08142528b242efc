"""Rows of a comparison with known averages."""

from __future__ import annotations

from warmprior.experiments import Row
from warmprior.experiments.results import played

FACTS = {
    "task": "square",
    "data": "ph",
    "prior": "gaussian",
    "options": "",
    "sigma": 1.0,
    "chunk": 8,
    "seed": 0,
    "iterations": 100,
    "checkpoint": 100,
    "nfe": 1,
}


def row(successes: int = 5, episodes: int = 10, measures=None, **facts) -> Row:
    """An evaluation; what is not named is that of ``FACTS``."""
    outcomes = [episode < successes for episode in range(episodes)]
    return played(FACTS | facts, outcomes, **({"mean_steps": 200.0} | (measures or {})))


def compared() -> list[Row]:
    """Three seeds, two checkpoints; WP-Past is better by 30 points, and less spread than that."""
    return [
        row(successes, prior=prior, seed=seed, checkpoint=checkpoint)
        for prior, wins in (("gaussian", (4, 5, 6)), ("past", (7, 8, 9)), ("preview", (5, 5, 5)))
        for seed, k in enumerate(wins)
        for checkpoint, successes in ((50, 0), (100, k))
    ]
