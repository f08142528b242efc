"""What the paper reports, to stand beside measured numbers and never to be mixed in."""

from __future__ import annotations

__all__ = ["PAPER_CURVATURE", "PAPER_SIGMA", "PAPER_SUCCESS", "paper_success"]

#: Table 1, Robomimic with state and MimicGen with image observations, H = 8, percent: (task, data) -> prior
#: -> NFE -> success rate.
PAPER_SUCCESS: dict[tuple[str, str], dict[str, dict[int, float]]] = {
    ("square", "ph"): {
        "gaussian": {9: 86.7, 3: 86.2, 1: 83.6},
        "past": {9: 88.1, 3: 88.0, 1: 86.6},
        "preview": {9: 88.1, 3: 87.9, 1: 87.3},
    },
    ("square", "mh"): {
        "gaussian": {9: 65.9, 3: 65.4, 1: 65.9},
        "past": {9: 69.2, 3: 73.2, 1: 70.1},
        "preview": {9: 72.7, 3: 72.9, 1: 77.8},
    },
    ("transport", "ph"): {
        "gaussian": {9: 34.1, 3: 39.0, 1: 36.8},
        "past": {9: 36.2, 3: 44.0, 1: 39.8},
        "preview": {9: 43.3, 3: 49.1, 1: 47.6},
    },
    ("transport", "mh"): {
        "gaussian": {9: 16.3, 3: 21.3, 1: 23.3},
        "past": {9: 20.7, 3: 30.7, 1: 30.2},
        "preview": {9: 24.3, 3: 30.4, 1: 34.5},
    },
    ("tool_hang", "ph"): {
        "gaussian": {9: 79.4, 3: 72.3, 1: 77.7},
        "past": {9: 80.6, 3: 75.1, 1: 78.2},
        "preview": {9: 82.8, 3: 75.8, 1: 81.9},
    },
    ("stack_d0", "source"): {
        "gaussian": {9: 21.4, 3: 21.3, 1: 21.3},
        "past": {9: 22.8, 3: 23.7, 1: 22.4},
        "preview": {9: 31.6, 3: 30.7, 1: 28.7},
    },
    ("coffee_d0", "source"): {
        "gaussian": {9: 26.8, 3: 23.3, 1: 16.2},
        "past": {9: 29.6, 3: 24.1, 1: 20.4},
        "preview": {9: 34.7, 3: 33.4, 1: 29.4},
    },
    ("threading_d0", "source"): {
        "gaussian": {9: 13.8, 3: 16.3, 1: 12.5},
        "past": {9: 15.5, 3: 16.6, 1: 15.6},
        "preview": {9: 20.9, 3: 22.0, 1: 18.0},
    },
}

#: Table 2, curvature relative to the Gaussian source: (task, data) -> prior -> ratio.
PAPER_CURVATURE: dict[tuple[str, str], dict[str, float]] = {
    ("square", "ph"): {"past": 0.823, "preview": 0.803},
    ("square", "mh"): {"past": 0.705, "preview": 0.559},
    ("transport", "ph"): {"past": 0.720, "preview": 0.692},
    ("transport", "mh"): {"past": 0.695, "preview": 0.637},
    ("tool_hang", "ph"): {"past": 0.806, "preview": 0.807},
}

#: Appendix on sigma, square mh, H = 8, NFE 1: prior -> sigma -> success rate, where a number is given.
PAPER_SIGMA: dict[str, dict[float, float]] = {
    "past": {0.5: 0.701, 0.0: 0.05},
    "preview": {1.0: 0.778, 0.0: 0.31},
}


def paper_success(task: str, data: str, prior: str, nfe: int, chunk: int = 8) -> float | None:
    """The paper's success rate in percent, or ``None`` where it reports none.

    Examples:
        >>> paper_success("square", "mh", "preview", 1)
        77.8
    """
    if chunk != 8:
        return None
    return PAPER_SUCCESS.get((task, data), {}).get(prior, {}).get(nfe)
