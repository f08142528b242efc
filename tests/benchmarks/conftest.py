"""What the tests of the manipulation benchmarks share."""

from __future__ import annotations

import pytest

from tests.data.synthetic import write_robomimic_file


@pytest.fixture(scope="session")
def dataset(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "lift.hdf5"
    write_robomimic_file(path, lengths=(30, 5, 40), task="lift")
    return path


def options(path, out, **extra):
    """Command line of a run that takes seconds; ``None`` leaves an option out."""
    values = {
        "dataset": path,
        "task": "lift",
        "out": out,
        "iterations": 30,
        "episodes": 1,
        "envs": 1,
        "nfe": 1,
        "logger": "none",
    } | extra
    words = []
    for key, value in values.items():
        if value is not None:
            parts = value if isinstance(value, (list, tuple)) else [value]
            words += [f"--{key}", *map(str, parts)]
    return words
