"""LeRobotDatasets through the benchmarks: the same results as those of the file they were made of."""

from __future__ import annotations

import importlib
import re
import shutil

import pytest

pytest.importorskip("robosuite")
pytest.importorskip("tyro")
pytest.importorskip("lerobot")

from tests.benchmarks.script_parts import command_line, options, refused, stored, written
from warmprior.data import convert_robomimic
from warmprior.experiments import HeldOutOptions, observe, robosuite_problem, success_study
from warmprior.experiments.recipe import DataOptions

pytestmark = pytest.mark.filterwarnings("ignore:.*curvature is NaN", "ignore:.*do not move")


@pytest.fixture(scope="module", autouse=True)
def offline():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
        patch.setattr(success_study, "rendering_backend", lambda: None)
        yield


@pytest.fixture(scope="module")
def folder(dataset, tmp_path_factory):
    return convert_robomimic(dataset, tmp_path_factory.mktemp("data") / "lift", progress=False)


@pytest.fixture
def bare(folder, tmp_path):
    """As from another converter: it does not say which environment it is of."""
    copy = shutil.copytree(folder, tmp_path / "bare")
    (copy / "meta" / "warmprior.json").unlink()
    return copy


def same(mine, theirs):
    """Rows but for what clocks and draws of figures tell."""
    assert len(mine["rows"]) == len(theirs["rows"]) > 0
    for row, other in zip(mine["rows"], theirs["rows"], strict=True):
        assert row.keys() == other.keys()
        if "success" in row:
            names = ("prior", "success", "iterations", "chunk")
            assert [row[n] for n in names] == [other[n] for n in names]


def test_results_are_those_of_the_file(dataset, folder, tmp_path, monkeypatch):
    robomimic = importlib.import_module("robomimic")
    few = {"prior": ["past"], "iterations": 10, "task": None}
    place = f"lerobot:{folder}"
    assert robomimic.main(options(dataset, tmp_path / "file", **few)) == 0
    assert robomimic.main(options(place, tmp_path / "lerobot", **few)) == 0
    mine, theirs = (stored(tmp_path / name) for name in ("lerobot", "file"))
    same(mine, theirs)
    facts, others = (result["meta"]["problems"][0] for result in (mine, theirs))
    assert facts["file"] == "lerobot:lift" and facts["sha256"] != others["sha256"]
    assert {n: facts[n] for n in ("task", "steps", "demonstrations", "source")} == {
        n: others[n] for n in ("task", "steps", "demonstrations", "source")
    }
    # Found again from another working directory.
    before = written(tmp_path / "policies")
    monkeypatch.chdir(tmp_path)
    assert robomimic.main(["--resume", "--out", "lerobot"]) == 0
    assert written(tmp_path / "policies") == before
    # Held out: the other benchmarks take datasets as well.
    curvature = importlib.import_module("curvature")
    measured = {"run": "lerobot", "out": "curvature", "observations": 20, "steps": 4}
    assert curvature.main(command_line(**measured, validation=place)) == 0
    assert "TRAINING demonstrations" in (tmp_path / "curvature" / "table.md").read_text()


def test_problems_agree(dataset, folder, bare):
    wanted = DataOptions(task=("lift",))
    problems = [
        robosuite_problem(place, options=wanted)
        for place in (dataset, f"lerobot:{folder}", f"lerobot:{bare}")
    ]
    file, described, named = problems
    for problem in (described, named):
        assert (problem.data == file.data).all()
        assert problem.task == "lift" and problem.images == {}
    assert described.environment == file.environment
    assert named.environment["robosuite"]["env_args"]["env_name"] == "Lift"
    assert len({problem.identity for problem in problems}) == 3
    for actions in ("delta", "absolute"):
        problem = robosuite_problem(
            f"lerobot:{bare}", options=DataOptions(("lift",), actions=actions)
        )
        assert problem.data["action"].shape[-1] == {"delta": 7, "absolute": 10}[actions]
    held_out, told = observe(
        HeldOutOptions(validation=f"lerobot:{bare}", observations=5),
        described.facts | {"task": "lift", "style": "ph"},
        described.normalizer,
        chunk_length=8,
        observation_steps=2,
    )
    assert len(held_out) == 5 and told == "lerobot:bare"


def test_part_of_a_dataset_is_its_first_demonstrations(folder):
    whole, part = (
        robosuite_problem(f"lerobot:{folder}", options=DataOptions(demonstrations=n))
        for n in ((), (1,))
    )
    assert part.identity == f"{whole.identity} the first 1" and len(part.data) == 30


def test_what_does_not_fit_is_refused(folder, bare, tmp_path, capsys):
    main = importlib.import_module("robomimic").main
    described, undescribed = f"lerobot:{folder}", f"lerobot:{bare}"
    for place, extra, said in (
        (described, {"task": "can"}, "was recorded in Lift, not in PickPlaceCan"),
        (undescribed, {"task": None}, "does not say which environment .* name it with --task"),
        (
            undescribed,
            {"task": "can"},
            r"info\.json: the observations are .* those of PickPlaceCan",
        ),
        (
            undescribed,
            {"task": "transport"},
            "'action' has 7 columns, but TwoArmTransport takes 14",
        ),
        (described, {"obs": "image"}, "no images"),
        (f"lerobot:{tmp_path}/absent", {}, "no such folder"),
        (str(folder), {}, f"no such file; for a LeRobotDataset write lerobot:{folder}"),
    ):
        line = refused(main, options(place, tmp_path / "out", **extra), capsys)
        assert re.search(said, line), line
    assert not (tmp_path / "out" / "results.json").exists()
