"""Comparisons as users see them: what is trained, played, continued and refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

pytest.importorskip("tyro")
pytest.importorskip("pandas")

import common
import jobs
import robomimic
from common import Cell, play
from options import PRESETS, parse
from torchrl.envs import TransformedEnv

from tests.benchmarks import drift
from tests.benchmarks.conftest import Inline
from tests.benchmarks.drift import DriftEnv, arguments
from tests.benchmarks.script_parts import refused, stored, written
from tests.processes import apart
from tests.together import together
from warmprior import RealTimeChunking, policy_transforms
from warmprior.diagnostics import smoothness
from warmprior.envs.tasks import EVALUATION_SEED
from warmprior.io.distributed import rank, world_size
from warmprior.training import play_episode

ROOT = Path(__file__).parents[2]


def untimed(rows):
    """What two trainings of the same policy have in common."""
    return [{k: v for k, v in row.items() if k != "training_seconds"} for row in rows]


def policies_of(argv):
    """The policies that a command line compares."""
    found = parse(PRESETS, argv, "robomimic", None)
    return common.policies_of(found, found.sources.methods())


@pytest.fixture(scope="module")
def finished(inline, tmp_path_factory):
    out = tmp_path_factory.mktemp("finished") / "out"
    assert robomimic.main(arguments(out)) == 0
    return out


def test_rows_have_an_order_and_do_not_depend_on_who_computes(finished, tmp_path, processes):
    cells = [(r["prior"], r["seed"], r["checkpoint"], r["nfe"]) for r in stored(finished)]
    assert cells == [
        (prior, seed, checkpoint, nfe)
        for prior in ("gaussian", "past", "preview")
        for seed in (0, 1)
        for checkpoint in (10, 20)
        for nfe in (3, 1)
    ]
    # In fresh processes, whose episodes come in another order.
    assert robomimic.main(arguments(tmp_path / "out", prior="past", envs=2)) == 0
    past = [row for row in stored(finished) if row["prior"] == "past"]
    assert untimed(stored(tmp_path / "out")) == untimed(past)


@apart
def test_rows_of_a_ray_cluster_are_those_of_this_machine(finished, tmp_path, ray_address, monkeypatch):
    monkeypatch.chdir(tmp_path)  # that of the cluster is another
    argv = arguments("out", prior="past", engine="ray", ray_address=ray_address)
    assert robomimic.main(argv) == 0
    past = [row for row in stored(finished) if row["prior"] == "past"]
    assert untimed(stored(tmp_path / "out")) == untimed(past)


@pytest.mark.parametrize(
    ("cell", "row"),
    [
        (Cell(20, 3), {"checkpoint": 20, "nfe": 3}),
        (Cell(10, 1, delay=1, execute=3), {"execute": 3, "delay": 1, "guidance": "none"}),
        (Cell(20, 3, 1, 3, RealTimeChunking(schedule="linear")), {"guidance": "rtc"}),
    ],
)
def test_a_row_is_what_episodes_played_by_hand_give(finished, cell, row):
    policies = policies_of(arguments(finished.parent / "new"))
    policy = next(p for p in policies if p.method.name == "past" and p.training.seed == 1)
    seeds = range(EVALUATION_SEED, EVALUATION_SEED + 7)
    found = common.row(policy, cell, play(policy, cell, PRESETS["quick"].evaluation, seeds)[::-1], {})
    assert row.items() <= found.items()

    actor = policy.load(cell.checkpoint).replace(guidance=cell.guidance)
    transforms = policy_transforms(
        actor.prior,
        normalizer=drift.task().normalizer,
        execute=cell.execute,
        delay=cell.delay,
        success="solved",
    )
    env, keys = TransformedEnv(DriftEnv(), transforms), {"success": "solved"}
    episodes = [play_episode(actor, env, seed, nfe=cell.nfe, policy_seed=1, **keys) for seed in seeds]
    assert found["outcomes"] == "".join(str(int(e.success)) for e in episodes)
    assert found["mean_steps"] == sum(e.steps for e in episodes) / 7
    jumps = [smoothness(e.decisions) for e in episodes]
    mean = sum(j.boundary_jump * j.boundaries for j in jumps) / sum(j.boundaries for j in jumps)
    assert found["boundary_jump"] == pytest.approx(mean, rel=1e-5)
    if cell == Cell(20, 3):
        (mine,) = (r for r in stored(finished) if policy.facts.items() | row.items() <= r.items())
        assert all(mine[name] == found[name] for name in found)
        assert 0 < mine["success_rate"] < 1 and "episode_side" in mine


def test_a_run_continues_with_what_is_missing(finished, tmp_path, capsys):
    argv = arguments(tmp_path / "out", prior="past")
    assert robomimic.main(argv) == 0
    path = tmp_path / "out" / "results.jsonl"
    whole, before = stored(path.parent), written(tmp_path)
    kept = [row | {"mean_steps": 12_345.0} for row in whole[2:5]]
    path.write_text("".join(json.dumps(row) + "\n" for row in kept))
    assert robomimic.main([*argv, "--resume", "--envs", "3"]) == 0
    assert stored(path.parent) == [*whole[:2], *kept, *whole[5:]]
    assert written(tmp_path) == before
    # What is damaged, or of other policies, is named.
    path.write_text("{broken")
    assert str(path) in refused(robomimic.main, [*argv, "--resume"], capsys)
    path.write_text(json.dumps(whole[0] | {"policy": "drift-own-past-seed0-older"}))
    said = refused(robomimic.main, [*argv, "--resume"], capsys)
    assert "has rows of drift-own-past-seed0-older: it was begun with other versions" in said


def test_equal_policies_are_shared_and_others_are_not(tmp_path, capsys):
    argv = arguments(tmp_path / "a", prior=["past", "past,sigma=0.5,correlation=0.0"], seeds=1)
    assert robomimic.main(argv) == 0
    assert len(stored(tmp_path / "a")) == 4  # two checkpoints, two NFEs
    assert capsys.readouterr().out.count("trained drift own, past") == 1
    assert robomimic.main(arguments(tmp_path / "b", prior="past")) == 0
    said = capsys.readouterr().out
    assert said.count("found drift own, past") == said.count("trained drift own, past") == 1

    def exists(**more):
        argv = arguments(tmp_path / "c", **{"prior": "past", "seeds": 1} | more)
        (policy,) = policies_of(argv)
        return policy.is_trained

    # What changes no weights makes no other policy.
    assert exists() and exists(episodes=3, nfe=1, grid="dense-jump", encoder="resnet18")
    others = {"sigma": 0.4, "batch_size": 8, "hidden_dim": 8, "prior": "past,correlation=0.5"}
    others["task"] = f"{drift.__name__}:other"
    assert not any(exists(**{name: value}) for name, value in others.items())


LEARNT = ("forecast", "step", "cvae", "a2a", "leap")


def test_every_method_is_trained_with_what_it_needs_before_it(tmp_path, monkeypatch):
    """Teachers are policies of the comparison, and sources learn once."""
    names = ["reflow", "gaussian", "history", "regression", "ot", *LEARNT]
    own = f"{drift.__name__}:Widening"
    argv = arguments(tmp_path / "out", prior=[*names, own], seeds=1, nfe=1)
    assert robomimic.main(argv) == 0
    rows = {row["prior"]: row for row in stored(tmp_path / "out") if row["checkpoint"] == 20}
    assert set(rows) == {*names, "widening"}
    policies = {p.method.name: p for p in policies_of([*argv, "--resume"])}
    assert {p.folder for p in policies.values()} == set((tmp_path / "policies").iterdir())
    assert policies["reflow"].teacher().folder == policies["gaussian"].folder
    for name, policy in policies.items():
        actor, own_time = policy.load(), json.loads(policy.status.read_text())["seconds"]
        assert (policy.folder / "learner.safetensors").exists() == (name in LEARNT)
        assert actor.ode.max_nfe == (1 if name == "regression" else None)
        assert all(bool(torch.isfinite(p).all()) for p in actor.parameters())
        # A training needs its teacher's.
        assert (rows[name]["training_seconds"] > own_time) == (name == "reflow")
    assert policies["widening"].load().prior.scale.item() != 1.0

    # A training that begins again takes what its source has learnt.
    forecast = policies["forecast"]
    learnt = forecast.load().prior.state_dict()
    for path in sorted(forecast.folder.rglob("*"), reverse=True):
        if path.name != "learner.safetensors":
            path.rmdir() if path.is_dir() else path.unlink()
    monkeypatch.setattr(common, "learn", lambda *args, **options: pytest.fail("learnt again"))
    common.train(forecast)
    again = forecast.load().prior.state_dict()
    assert learnt and all(torch.equal(learnt[name], again[name]) for name in learnt)


def test_a_training_that_fails_costs_its_own_rows_alone(tmp_path, capsys, monkeypatch):
    train = common.train_policy

    def failing(task, prior, *args, **options):
        if prior.name == "past":
            raise FloatingPointError("the loss became nan")
        return train(task, prior, *args, **options)

    argv = arguments(tmp_path / "out", seeds=1)
    with monkeypatch.context() as patch:
        patch.setattr(common, "train_policy", failing)
        assert robomimic.main(argv) == 2
    said = capsys.readouterr()
    assert "FAILED drift own, past" in said.out and "the loss became nan" in said.err
    assert {row["prior"] for row in stored(tmp_path / "out")} == {"gaussian", "preview"}
    report = (tmp_path / "out" / "report.md").read_text()
    assert "Missing:" in report and "the loss became nan" in report
    assert robomimic.main([*argv, "--resume"]) == 0
    assert [row["prior"] for row in stored(tmp_path / "out")][4:8] == ["past"] * 4
    assert "Missing" not in (tmp_path / "out" / "report.md").read_text()


def test_policies_are_played_and_measured_on_the_grid(finished, tmp_path):
    """One step is the same on each; more are not, on the same policies."""
    out, before = finished.parent / "jump", written(finished.parent)
    assert robomimic.main(arguments(out, prior="past", grid="dense-jump:0.9")) == 0
    assert written(finished.parent) == before
    mine = [row for row in stored(finished) if row["prior"] == "past"]
    for row, other in zip(mine, stored(out), strict=True):
        same = [row[n] == other[n] for n in ("boundary_jump", "inner_jump", "outcomes", "episode_side")]
        assert all(same) if row["nfe"] == 1 else not all(same)
    assert "--grid dense-jump:0.9" in (out / "report.md").read_text()


def run(folder):
    """A run that several processes start, of which one method fails in all of them."""
    jobs.Local = Inline
    train = common.train_policy

    def watched(task, prior, *args, **options):
        with (folder / f"trained by {world_size()}").open("a") as file:
            file.write(f"{prior.name} {rank()}\n")
        if prior.name == "preview":
            raise FloatingPointError("the loss became nan")
        return train(task, prior, *args, **options)

    common.train_policy = watched
    robomimic.run(arguments(folder / "out", seeds=1, episodes=2), PRESETS, "robomimic", "")


def test_several_processes_train_together_and_one_plays(tmp_path, monkeypatch):
    """The rows have the facts and order of one process; each draws its own part of a batch."""
    one, two = tmp_path / "one", tmp_path / "two"
    for folder in (one, two):
        folder.mkdir()
    monkeypatch.setattr(jobs, "Local", Inline)
    monkeypatch.setattr(common, "train_policy", common.train_policy)
    for start in (lambda: run(one), lambda: together(run, two)):
        with pytest.raises(Exception, match=r"1 failed|preview.*the loss became nan"):
            start()
    facts = ("prior", "sigma", "seed", "checkpoint", "nfe", "episodes")
    mine, theirs = ([[r[f] for f in facts] for r in stored(f / "out")] for f in (one, two))
    assert mine == theirs and {fact[0] for fact in mine} == {"gaussian", "past"}
    trained = (two / "trained by 2").read_text().splitlines()
    priors = ("gaussian", "past", "preview")
    assert sorted(trained) == sorted(f"{p} {r}" for p in priors for r in range(2))
