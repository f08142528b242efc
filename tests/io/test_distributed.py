import json

import pytest
import torch

from lab.io.machine import check_device
from tests.errors import refuses
from tests.together import together
from warmprior.io.distributed import launched, leader_first, rank, world_size


@pytest.fixture
def under_torchrun(monkeypatch):
    names = {"RANK": 1, "LOCAL_RANK": 1, "WORLD_SIZE": 3, "LOCAL_WORLD_SIZE": 3, "MASTER_ADDR": "x"}
    for name, value in names.items():
        monkeypatch.setenv(name, str(value))


@pytest.fixture
def two_gpus(monkeypatch):
    """As far as names go; a tensor on one of them fails."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)


def test_alone(monkeypatch):
    assert not launched() and (rank(), world_size()) == (0, 1)
    monkeypatch.setenv("WORLD_SIZE", "4")  # as a cluster's scheduler may leave it, without the rest
    assert not launched()


def test_several_processes_share_no_gpu(under_torchrun, two_gpus):
    refuses(lambda: check_device("cuda"), ValueError, 3, 2)
    refuses(lambda: check_device("cuda:1"), ValueError, "--device cuda:1", "write --device cuda")
    check_device("cpu")


def _leaders_fail(folder):
    said = []
    for error in (FloatingPointError("NaN"), None, OSError("full")):
        try:
            with leader_first():
                if error is not None and rank() == 0:
                    raise error
        except BaseException as found:
            said.append([type(found).__name__, str(found)])
    (folder / str(rank())).write_text(json.dumps(said))


def test_what_fails_in_the_first_fails_in_all_and_nobody_waits(tmp_path):
    together(_leaders_fail, tmp_path)
    first, other = (json.loads((tmp_path / str(number)).read_text()) for number in range(2))
    assert first == [["FloatingPointError", "NaN"], ["OSError", "full"]]
    assert other == [first[0], ["SystemExit", "2"]]
