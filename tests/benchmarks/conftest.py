"""What the tests of the manipulation benchmarks share."""

from __future__ import annotations

import pytest

from tests.data.synthetic import write_robomimic_file
from warmprior.envs.tasks import TaskSpec


@pytest.fixture(scope="module", autouse=True)
def short_episodes():
    """Policies of a few iterations solve nothing: their episodes need not go to the time limit."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TaskSpec, "horizon", lambda spec, style: 40)
        yield


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


@pytest.fixture
def no_work(monkeypatch):
    """Nothing is generated, downloaded or trained."""
    pytest.importorskip("tyro")
    from warmprior.experiments import Store, problem

    def never(*args, **options):
        raise AssertionError("work was begun")

    monkeypatch.setattr(Store, "train", never)
    for name in ("generate_demonstrations", "download_robomimic", "download_mimicgen"):
        monkeypatch.setattr(problem, name, never)
