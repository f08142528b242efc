"""Absolute actions through the benchmarks: policies, rows, tables, and all that reads them later."""

from __future__ import annotations

import importlib

import pytest

from tests.benchmarks.script_parts import command_line, options, stored, written
from warmprior.__main__ import main
from warmprior.training.saved import load_policy

pytest.importorskip("robosuite")
pytest.importorskip("tyro")

from warmprior.experiments import success_study

pytestmark = pytest.mark.filterwarnings("ignore:.*curvature is NaN", "ignore:.*do not move")


@pytest.fixture(scope="module")
def finished(dataset, tmp_path_factory):
    """A run of robomimic.py with absolute actions, and then one with the recorded ones."""
    robomimic = importlib.import_module("robomimic")
    runs = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:  # filmstrips take long, and are not tested here
        patch.setattr(success_study, "rendering_backend", lambda: None)
        for actions in ("absolute", "delta"):
            argv = options(dataset, runs / actions, prior=["gaussian", "past"], actions=actions)
            assert robomimic.main(argv) == 0
    return runs


def test_rows_and_tables_tell_absolute_actions_alone(finished):
    absolute, delta = (stored(finished / name) for name in ("absolute", "delta"))
    assert [row["actions"] for row in absolute["rows"]] == ["absolute"] * 2
    assert not any("actions" in row for row in delta["rows"])
    assert absolute["meta"]["problems"][0]["actions"] == "absolute"
    assert "actions" not in delta["meta"]["problems"][0]
    assert absolute["meta"]["identity"]["recipe"]["data"]["actions"] == "absolute"
    assert delta["meta"]["identity"]["recipe"]["data"]["actions"] == "delta"
    told = [(finished / name / "table.md").read_text() for name in ("absolute", "delta")]
    assert ["Lift-PH, absolute actions, measured" in text for text in told] == [True, False]


def test_policies_of_both_spaces_lie_side_by_side(finished, capsys):
    widths = {}
    for run in ("absolute", "delta"):
        for entry in stored(finished / run)["meta"]["policies"]:
            folder = finished / "policies" / entry["folder"] / "policy_000030"
            widths[folder] = load_policy(folder).network.action_dim
    assert list(widths.values()) == [10, 10, 7, 7]
    assert main(["evaluate", str(next(iter(widths))), "--episodes", "1", "--nfe", "1"]) == 0
    assert "of 1 episodes solved" in capsys.readouterr().out


def test_held_out_observations_follow(finished, validation):
    before = written(finished)
    out = finished / "curvature"
    argv = command_line(
        run=finished / "absolute", out=out, validation=validation, observations=20, steps=8
    )
    assert importlib.import_module("curvature").main([*argv, "--coordinate", "9"]) == 0
    assert written(finished) == before
    assert "Lift-PH, absolute actions" in (out / "table.md").read_text()


def test_agents_act_in_the_source_space_of_absolute_actions(finished, tmp_path):
    out = tmp_path / "agents"
    argv = command_line(
        run=finished / "absolute",
        out=out,
        horizon=20,
        seeds=1,
        prior="past",
        rl__environment_steps=60,
        rl__warmup_steps=30,
        rl__evaluate_every=60,
        episodes=1,
        num_envs=1,
    )
    assert importlib.import_module("prior_space_rl").main(argv) == 0
    assert {row["actions"] for row in stored(out)["rows"]} == {"absolute"}
