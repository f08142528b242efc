"""LeRobotDatasets through the benchmarks: the same results as those of the file they were made of."""

from __future__ import annotations

import pytest

pytest.importorskip("robosuite")
pytest.importorskip("tyro")
pytest.importorskip("lerobot")

import curvature
import robomimic

from tests.benchmarks.script_parts import command_line, described, options, stored, written
from warmprior.data import convert_robomimic

pytestmark = pytest.mark.filterwarnings("ignore:.*curvature is NaN", "ignore:.*do not move")


@pytest.fixture(scope="module", autouse=True)
def offline():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
        yield


@pytest.fixture(scope="module")
def folder(dataset, tmp_path_factory):
    return convert_robomimic(dataset, tmp_path_factory.mktemp("data") / "lift", progress=False)


def test_results_are_those_of_the_file(dataset, folder, tmp_path, monkeypatch):
    few = {"prior": ["past"], "iterations": 10, "task": None}
    place = f"lerobot:{folder}"
    assert robomimic.main(options(dataset, tmp_path / "file", **few)) == 0
    assert robomimic.main(options(place, tmp_path / "lerobot", **few)) == 0
    mine, theirs = (
        [{k: v for k, v in row.items() if k not in ("policy", "training_seconds")} for row in rows]
        for rows in (stored(tmp_path / name) for name in ("lerobot", "file"))
    )
    assert mine == theirs
    facts, others = (described(tmp_path / name, "tasks")[0] for name in ("lerobot", "file"))
    assert facts["file"] == "lerobot:lift" and facts["sha256"] != others["sha256"]
    assert {k for k in facts if facts[k] != others[k]} == {"file", "sha256"}
    # Found again from another working directory.
    before = written(tmp_path / "policies")
    monkeypatch.chdir(tmp_path)
    assert robomimic.main(["--resume", "--out", "lerobot"]) == 0
    assert written(tmp_path / "policies") == before
    # Held out: the other benchmarks take datasets as well.
    few = {"run": "lerobot", "out": "curvature", "observations": 20, "steps": 4}
    assert curvature.main(command_line(**few, validation=place)) == 0
    assert "TRAINING demonstrations" in (tmp_path / "curvature" / "report.md").read_text()
