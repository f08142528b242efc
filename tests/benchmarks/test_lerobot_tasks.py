"""Runs on datasets in LeRobot's format."""

import pusht
import pytest
import robomimic
import torch

from lab.demonstrations.data_options import DataOptions
from tests.benchmarks.script_parts import described, flow, options, stored, written
from tests.errors import refuses
from warmprior.data import DatasetError, convert_robomimic

pytest.importorskip("lerobot")

from tests.data.lerobot_parts import write_lerobot

pytestmark = pytest.mark.filterwarnings("ignore:.*curvature is NaN", "ignore:.*do not move")


def test_results_of_a_lerobot_dataset_are_those_of_the_file(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    place = f"lerobot:{convert_robomimic(dataset, tmp_path / 'lift')}"
    for name, data in (("file", dataset), ("lerobot", place)):
        few = {"prior": "past", "iterations": 10, "task": None}
        assert robomimic.main(options(data, tmp_path / name, **few)) == 0
    (mine,), (theirs,) = (stored(tmp_path / name) for name in ("lerobot", "file"))
    assert {k for k in mine if mine[k] != theirs[k]} <= {"policy", "training_seconds"}
    facts, others = (described(tmp_path / name, "tasks")[0] for name in ("lerobot", "file"))
    assert {k for k in facts if facts[k] != others[k]} == {"file", "sha256"}
    # Found again from another working directory, and by the other benchmarks.
    before = written(tmp_path / "policies")
    monkeypatch.chdir(tmp_path)
    assert robomimic.main(["--resume", "--out", "lerobot"]) == 0
    assert "TRAINING demonstrations" in flow("lerobot", place)
    assert written(tmp_path / "policies") == before


def test_push_t_takes_as_many_demonstrations_as_are_asked_for(tmp_path):
    widths = {"observation.state": 2, "observation.environment_state": 16, "action": 2}
    features = {name: {"dtype": "float32", "shape": (n,), "names": None} for name, n in widths.items()}
    write_lerobot(tmp_path / "pusht", lengths=(6, 4, 9), features=features)
    place = f"lerobot:{tmp_path}/pusht"
    given = [DataOptions(dataset=place, demonstrations=n) for n in ((), (2,), (4,))]
    every, two = map(pusht.task, given[:2])
    refuses(lambda: pusht.task(given[2]), DatasetError, 3, "demos=4")
    # The agent, then the block's corners; both within [-1, 1].
    assert (every.data["observation"].shape, two.data["observation"].shape) == ((19, 18), (10, 18))
    assert every.data["observation"].abs().max().item() == pytest.approx(1.0)
    assert every.play.success == "success" and every.play.measures == {"coverage": "max"}
    # Offsets from where the agent is.
    raw, moved = (t.normalizer.denormalize(t.data.clone()) for t in (every, pusht.relative(given[0])))
    torch.testing.assert_close(moved["action"] + raw["observation"][:, :2], raw["action"])
