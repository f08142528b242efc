"""Push-T: its demonstrations from a LeRobotDataset, and its environment where it is installed."""

from __future__ import annotations

import pytest

pytest.importorskip("tyro")
pytest.importorskip("lerobot")

import pusht

from tests.data.lerobot_parts import write_lerobot
from warmprior.training import DataOptions


def feature(width):
    return {"dtype": "float32", "shape": (width,), "names": None}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    widths = {"observation.state": 2, "observation.environment_state": 16, "action": 2}
    features = {name: feature(width) for name, width in widths.items()}
    root = tmp_path_factory.mktemp("data") / "pusht"
    write_lerobot(root, lengths=(6, 4, 9), features=features)
    return root


def test_it_takes_as_many_demonstrations_as_are_asked_for(folder):
    every = pusht.task(DataOptions(dataset=f"lerobot:{folder}"))
    two = pusht.task(DataOptions(dataset=f"lerobot:{folder}", demonstrations=(2,)))
    assert (len(every.data), len(two.data)) == (19, 10)
    # The agent, then the block's corners; both within [-1, 1].
    assert every.data["observation"].shape[-1] == 2 + 16
    assert every.data["observation"].abs().max().item() == pytest.approx(1.0)
    assert every.success == "is_success" and every.measures == {"coverage": "max"}
