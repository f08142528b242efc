"""What the tests of the manipulation benchmarks share."""

from __future__ import annotations

import pytest

from tests.data.synthetic import write_robomimic_file


@pytest.fixture(scope="session")
def dataset(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "lift.hdf5"
    write_robomimic_file(path, lengths=(30, 5, 40), task="lift")
    return path


@pytest.fixture(scope="session")
def validation(tmp_path_factory):
    path = tmp_path_factory.mktemp("held-out") / "val.hdf5"
    write_robomimic_file(path, lengths=(25, 30), task="lift", seed=1)
    return path
