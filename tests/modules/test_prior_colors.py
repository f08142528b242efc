"""Sources are told apart by their colours in figures."""

from __future__ import annotations

import itertools

import pytest

from warmprior import Prior

OURS = {n: p.color for n, p in Prior.registered().items() if p.__module__.startswith("warmprior.")}


def lab(color):
    """CIELAB, from linear light and the tristimulus values of sRGB at D65 (IEC 61966-2-1)."""
    parts = [int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    light = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
    rows = ((0.4125, 0.3576, 0.1804), (0.2127, 0.7152, 0.0722), (0.0193, 0.1192, 0.9503))
    white = (0.9505, 1.0, 1.0888)
    ratios = [
        sum(m * v for m, v in zip(row, light, strict=True)) / w
        for row, w in zip(rows, white, strict=True)
    ]
    x, y, z = (r ** (1 / 3) if r > 0.008856 else (903.3 * r + 16) / 116 for r in ratios)
    return 116 * y - 16, 500 * (x - y), 200 * (y - z)


@pytest.mark.parametrize(("one", "other"), list(itertools.combinations(sorted(OURS), 2)))
def test_no_two_sources_look_alike(one, other):
    distance = (
        sum((a - b) ** 2 for a, b in zip(lab(OURS[one]), lab(OURS[other]), strict=True)) ** 0.5
    )
    assert distance > 20, f"{one} and {other}: {OURS[one]} and {OURS[other]}"
