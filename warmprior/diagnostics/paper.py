"""What the paper reports, to stand beside measured numbers and never to be mixed in."""

from __future__ import annotations

__all__ = ["PAPER_CURVATURE", "PAPER_PRIORS", "PAPER_SIGMA", "PAPER_SUCCESS", "paper_success"]

PAPER_PRIORS = ("gaussian", "past", "preview")

#: Table 1, Robomimic with state observations, H = 8, percent:
#: (task, data) -> NFE -> (Gaussian, WP-Past, WP-Preview).
PAPER_SUCCESS: dict[tuple[str, str], dict[int, tuple[float, float, float]]] = {
    ("square", "ph"): {9: (86.7, 88.1, 88.1), 3: (86.2, 88.0, 87.9), 1: (83.6, 86.6, 87.3)},
    ("square", "mh"): {9: (65.9, 69.2, 72.7), 3: (65.4, 73.2, 72.9), 1: (65.9, 70.1, 77.8)},
    ("transport", "ph"): {9: (34.1, 36.2, 43.3), 3: (39.0, 44.0, 49.1), 1: (36.8, 39.8, 47.6)},
    ("transport", "mh"): {9: (16.3, 20.7, 24.3), 3: (21.3, 30.7, 30.4), 1: (23.3, 30.2, 34.5)},
    ("tool_hang", "ph"): {9: (79.4, 80.6, 82.8), 3: (72.3, 75.1, 75.8), 1: (77.7, 78.2, 81.9)},
}

#: Table 2, curvature relative to the Gaussian source: (task, data) -> (WP-Past, WP-Preview).
PAPER_CURVATURE: dict[tuple[str, str], tuple[float, float]] = {
    ("square", "ph"): (0.823, 0.803),
    ("square", "mh"): (0.705, 0.559),
    ("transport", "ph"): (0.720, 0.692),
    ("transport", "mh"): (0.695, 0.637),
    ("tool_hang", "ph"): (0.806, 0.807),
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
    row = PAPER_SUCCESS.get((task, data), {}).get(nfe)
    return row[PAPER_PRIORS.index(prior)] if row and prior in PAPER_PRIORS else None
