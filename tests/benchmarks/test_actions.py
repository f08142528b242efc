"""Absolute actions through the benchmarks: policies, rows, tables, and all that reads them later."""

from __future__ import annotations

import pytest

from tests.benchmarks.script_parts import command_line, described, options, stored, written
from warmprior.__main__ import main
from warmprior.training import load_policy

pytest.importorskip("robosuite")
pytest.importorskip("tyro")

import curvature
import prior_space_rl
import robomimic

pytestmark = pytest.mark.filterwarnings("ignore:.*curvature is NaN", "ignore:.*do not move")


@pytest.fixture(scope="module")
def finished(inline, short_episodes, dataset, tmp_path_factory):
    """A run of robomimic.py with absolute actions, and then one with the recorded ones."""
    runs = tmp_path_factory.mktemp("runs")
    for actions in ("absolute", "delta"):
        argv = options(dataset, runs / actions, prior=["gaussian", "past"], actions=actions)
        assert robomimic.main(argv) == 0
    return runs


def test_absolute_actions_are_named_and_lie_beside_the_others(finished, capsys):
    absolute, delta = (finished / name for name in ("absolute", "delta"))
    assert [row["actions"] for row in stored(absolute)] == ["absolute"] * 2
    assert described(absolute, "tasks")[0]["actions"] == "absolute"
    assert not any("actions" in row for row in [*stored(delta), *described(delta, "tasks")])
    reports = [(run / "report.md").read_text() for run in (absolute, delta)]
    assert ["Lift-PH, absolute actions" in text for text in reports] == [True, False]
    rows = [*stored(absolute), *stored(delta)]
    folders = [finished / "policies" / row["policy"] / "policy_000030" for row in rows]
    assert [load_policy(path).network.action_dim for path in folders] == [10, 10, 7, 7]
    assert main(["evaluate", str(folders[0]), "--episodes", "1", "--nfe", "1"]) == 0
    assert "of 1 episodes solved" in capsys.readouterr().out


def test_held_out_observations_and_agents_follow(finished, validation, tmp_path):
    before, out = written(finished), tmp_path / "curvature"
    few = {"run": finished / "absolute", "observations": 20, "steps": 8, "coordinate": 9}
    assert curvature.main(command_line(out=out, validation=validation, **few)) == 0
    assert "Lift-PH, absolute actions" in (out / "report.md").read_text()
    short = {f"rl__{name}": n for name, n in (("environment_steps", 60), ("warmup_steps", 30))}
    argv = command_line(
        run=finished / "absolute",
        out=tmp_path / "agents",
        horizon=20,
        seeds=1,
        prior="past",
        episodes=1,
        num_envs=1,
        rl__evaluate_every=60,
        **short,
    )
    assert prior_space_rl.main(argv) == 0
    assert {row["actions"] for row in stored(tmp_path / "agents")} == {"absolute"}
    assert written(finished) == before
