"""The paper's numbers, which reports show next to measured ones."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

STATE, IMAGE = "state", "image"


def _row(*values: float) -> dict[str, dict[int, float]]:
    """Return a line of Table 1, which has Gaussian source, WP-Past and WP-Preview for each NFE."""
    return {
        prior: {nfe: values[3 * column + place] for column, nfe in enumerate((9, 3, 1))}
        for place, prior in enumerate(("gaussian", "past", "preview"))
    }


#: Table 1, H = 8, percent: (task, data, observations) -> prior -> NFE -> success rate.
PAPER_SUCCESS: dict[tuple[str, str, str], dict[str, dict[int, float]]] = {
    ("square", "ph", STATE): _row(86.7, 88.1, 88.1, 86.2, 88.0, 87.9, 83.6, 86.6, 87.3),
    ("square", "mh", STATE): _row(65.9, 69.2, 72.7, 65.4, 73.2, 72.9, 65.9, 70.1, 77.8),
    ("transport", "ph", STATE): _row(34.1, 36.2, 43.3, 39.0, 44.0, 49.1, 36.8, 39.8, 47.6),
    ("transport", "mh", STATE): _row(16.3, 20.7, 24.3, 21.3, 30.7, 30.4, 23.3, 30.2, 34.5),
    ("tool_hang", "ph", STATE): _row(79.4, 80.6, 82.8, 72.3, 75.1, 75.8, 77.7, 78.2, 81.9),
    ("square", "ph", IMAGE): _row(86.9, 88.2, 88.7, 87.7, 89.2, 89.6, 88.7, 89.3, 89.1),
    ("square", "mh", IMAGE): _row(76.1, 78.0, 77.8, 73.8, 77.9, 77.1, 72.4, 77.6, 75.1),
    ("transport", "ph", IMAGE): _row(92.8, 94.5, 94.3, 92.1, 93.9, 94.9, 91.3, 93.4, 93.7),
    ("transport", "mh", IMAGE): _row(74.8, 79.7, 79.8, 73.8, 80.0, 80.7, 74.3, 78.6, 79.7),
    ("tool_hang", "ph", IMAGE): _row(43.7, 45.8, 56.3, 36.9, 38.4, 50.7, 41.3, 38.9, 54.0),
    ("stack_d0", "source", IMAGE): _row(21.4, 22.8, 31.6, 21.3, 23.7, 30.7, 21.3, 22.4, 28.7),
    ("coffee_d0", "source", IMAGE): _row(26.8, 29.6, 34.7, 23.3, 24.1, 33.4, 16.2, 20.4, 29.4),
    ("threading_d0", "source", IMAGE): _row(13.8, 15.5, 20.9, 16.3, 16.6, 22.0, 12.5, 15.6, 18.0),
}

#: Table 2, curvature relative to the Gaussian source: (task, data) -> prior -> ratio.
PAPER_CURVATURE: dict[tuple[str, str], dict[str, float]] = {
    ("square", "ph"): {"past": 0.823, "preview": 0.803},
    ("square", "mh"): {"past": 0.705, "preview": 0.559},
    ("transport", "ph"): {"past": 0.720, "preview": 0.692},
    ("transport", "mh"): {"past": 0.695, "preview": 0.637},
    ("tool_hang", "ph"): {"past": 0.806, "preview": 0.807},
}

#: Appendix on sigma, square mh, H = 8, NFE 1: prior -> sigma -> success rate, where the text has a number.
PAPER_SIGMA: dict[str, dict[float, float]] = {
    "past": {0.5: 0.701, 0.0: 0.05},
    "preview": {1.0: 0.778, 0.0: 0.31},
}

#: The number of executed actions, and the noise of the sources, in the paper's tables.
PAPER_CHUNK, PAPER_DEFAULT_SIGMA = 8, {"gaussian": 1.0, "past": 0.5, "preview": 1.0}


def _setting(row: Mapping[str, Any]) -> tuple[str, str, str] | None:
    """Return task, data and observations of a row; None if it was trained or played unlike the paper's."""
    texts = {name: value for name, value in row.items() if isinstance(value, str)}  # others are NaN
    if row["chunk"] != PAPER_CHUNK or "delay" in row or row.get("temperature", 1.0) != 1.0:
        return None
    if texts.get("options") or texts.get("actions"):
        return None
    return row["task"], row["data"], texts.get("obs", STATE)


def paper_success(row: Mapping[str, Any]) -> float:
    """Return the paper's success rate, between 0 and 1, for the experiment of a row; NaN if it has none.

    >>> row = {"task": "square", "data": "mh", "prior": "preview", "sigma": 1.0, "nfe": 1, "chunk": 8}
    >>> [round(paper_success(row | more), 3) for more in ({}, {"obs": "image"}, {"sigma": 0.0})]
    [0.778, 0.751, 0.31]
    """
    setting, prior, sigma = _setting(row), row["prior"], row["sigma"]
    if setting == ("square", "mh", STATE) and row["nfe"] == 1 and sigma in PAPER_SIGMA.get(prior, {}):
        return PAPER_SIGMA[prior][sigma]
    if setting is None or sigma != PAPER_DEFAULT_SIGMA.get(prior):
        return math.nan
    return PAPER_SUCCESS.get(setting, {}).get(prior, {}).get(row["nfe"], math.nan) / 100


def paper_curvature(row: Mapping[str, Any]) -> float:
    """Return the paper's curvature over the Gaussian source's for the experiment of a row; NaN if not given.

    >>> row = {"task": "square", "data": "mh", "prior": "past", "sigma": 0.5, "chunk": 8}
    >>> paper_curvature(row), paper_curvature(row | {"options": "correlation=0.5"})
    (0.705, nan)
    """
    task, data, observations = _setting(row) or ("", "", "")
    if observations != STATE or row["sigma"] != PAPER_DEFAULT_SIGMA.get(row["prior"]):
        return math.nan
    return PAPER_CURVATURE.get((task, data), {}).get(row["prior"], math.nan)
