import json
import sys
from itertools import product

import pytest
import robomimic
import torch
from torchrl.envs import TransformedEnv

from lab.options.command_line import parse
from lab.options.presets import PRESETS
from lab.running import jobs
from lab.running import policies as common
from lab.running.measuring import measure, row
from lab.running.policies import Cell, play
from tests.benchmarks import drift
from tests.benchmarks.conftest import Inline
from tests.benchmarks.drift import DriftEnv, arguments
from tests.benchmarks.script_parts import refused, stored, written
from tests.errors import refuses
from tests.processes import apart
from tests.together import together
from warmprior import RealTimeChunking, VelocityNetwork, policy_transforms
from warmprior.diagnostics import smoothness
from warmprior.evaluation import play_episode
from warmprior.io.distributed import rank, world_size
from warmprior.options.defaults import EVALUATION_SEED


def untimed(out):
    """The rows of WP-Past without what two trainings of the same policy do not share."""
    return [row | {"training_seconds": None} for row in stored(out) if row["prior"] == "past"]


def policies_of(argv):
    return common.policies_of(parse(PRESETS, argv, "robomimic", None))


@pytest.fixture(scope="module")
def finished(inline, tmp_path_factory):
    out = tmp_path_factory.mktemp("finished") / "out"
    assert robomimic.main(arguments(out, prior=["gaussian", "past"])) == 0
    return out


def test_rows_have_an_order_and_do_not_depend_on_who_computes(
    finished, inline, tmp_path, monkeypatch, forked_workers
):
    cells = [(r["prior"], r["seed"], r["checkpoint"], r["nfe"]) for r in stored(finished)]
    assert cells == list(product(("gaussian", "past"), (0, 1), (10, 20), (3, 1)))
    # In two processes: there the episodes come in another order. Fresh ones are in test_tasks.py.
    monkeypatch.setattr(jobs, "Local", inline)
    assert apart(robomimic.main)(arguments(tmp_path / "out", prior="past", workers=2)) == 0
    assert untimed(tmp_path / "out") == untimed(finished)


@pytest.mark.slow  # a cluster, whose start takes minutes on a busy machine
@apart
def test_rows_of_a_ray_cluster_are_those_of_this_machine(finished, tmp_path, ray_address, monkeypatch):
    monkeypatch.chdir(tmp_path)  # that of the cluster is another
    argv = arguments("out", prior="past", engine="ray", ray_address=ray_address)
    assert robomimic.main(argv) == 0
    assert untimed(tmp_path / "out") == untimed(finished)


GUIDED = Cell(20, 3, 1, 3, RealTimeChunking(schedule="linear"))


@pytest.mark.parametrize("cell", [Cell(20, 3), GUIDED, Cell(20, 3, temperature=0.0)])
def test_a_row_is_what_episodes_played_by_hand_give(finished, cell):
    policies = policies_of(arguments(finished.parent / "new"))
    policy = next(p for p in policies if p.method.name == "past" and p.training.seed == 1)
    seeds = range(EVALUATION_SEED + 10_000, EVALUATION_SEED + 10_007)  # those of training seed 1
    found = row(policy, cell, play(policy, cell, PRESETS["quick"].evaluation, seeds)[::-1], {})
    assert (found["checkpoint"], found["nfe"]) == (20, 3) and found.get("execute") == cell.execute
    actor = policy.load(cell.checkpoint).replace(guidance=cell.guidance, temperature=cell.temperature)
    played = {"execute": cell.execute, "delay": cell.delay, "success": "solved"}
    transforms = policy_transforms(actor.prior, normalizer=drift.task().normalizer, **played)
    env, keys = TransformedEnv(DriftEnv(), transforms), {"success": "solved"}
    episodes = [play_episode(actor, env, seed, nfe=cell.nfe, policy_seed=1, **keys) for seed in seeds]
    assert found["outcomes"] == "".join(str(int(e.success)) for e in episodes)
    assert found["mean_steps"] == sum(e.steps for e in episodes) / 7
    jumps = [smoothness(e.decisions) for e in episodes]
    mean = sum(j.boundary_jump * j.boundaries for j in jumps) / sum(j.boundaries for j in jumps)
    assert found["boundary_jump"] == pytest.approx(mean, rel=1e-5)
    if cell == Cell(20, 3):
        facts = (policy.facts | cell.facts()).items()
        (mine,) = (row for row in stored(finished) if facts <= row.items())
        assert all(mine[name] == found[name] for name in found)
        assert 0 < mine["success_rate"] < 1 and "episode_side" in mine


def test_temperatures_are_played_with_one_training(tmp_path, capsys):
    out = tmp_path / "runs" / "out"
    few = {"nfe": 1, "seeds": 1, "checkpoints": 1, "episodes": 2}
    argv = arguments(out, **few, prior=["gaussian", "past"], temperature=[1, 0])
    assert robomimic.main(argv) == 0
    rows = stored(out)
    cells = [(row["prior"], row["temperature"]) for row in rows]
    assert cells == list(product(("gaussian", "past"), (1.0, 0.0)))
    assert len({row["policy"] for row in rows}) == 2
    assert len({row["boundary_jump"] for row in rows}) == 4  # each is played otherwise
    assert "noise x 0" in (out / "report.md").read_text()
    assert "temperature" in refused(robomimic.main, arguments(tmp_path / "two", temperature=-1), capsys)


def test_a_run_continues_with_what_is_missing(finished, tmp_path, capsys):
    argv = arguments(tmp_path / "out", prior="past", episodes=2)
    assert robomimic.main(argv) == 0
    path = tmp_path / "out" / "results.jsonl"
    whole, before = stored(path.parent), written(tmp_path)
    kept = [row | {"mean_steps": 12_345.0} for row in whole[2:5]]
    path.write_text("".join(json.dumps(row) + "\n" for row in kept))
    assert robomimic.main([*argv, "--resume", "--workers", "3"]) == 0
    assert stored(path.parent) == [*whole[:2], *kept, *whole[5:]]
    assert written(tmp_path) == before
    # Rows of other policies are named.
    path.write_text(json.dumps(whole[0] | {"policy": "drift-own-past-seed0-older"}))
    said = refused(robomimic.main, [*argv, "--resume"], capsys)
    assert "has rows of drift-own-past-seed0-older: it was begun with other versions" in said


def test_equal_policies_are_shared_and_others_are_not(tmp_path, capsys):
    names = ["past", "past,sigma=0.5,correlation=0.0"]
    argv = arguments(tmp_path / "a", prior=names, seeds=1, episodes=1)
    assert robomimic.main(argv) == 0
    assert len(stored(tmp_path / "a")) == 4  # two checkpoints, two NFEs
    assert robomimic.main(arguments(tmp_path / "b", prior="past", nfe=1, episodes=1)) == 0
    said = capsys.readouterr().out
    assert (said.count("trained drift own, past"), said.count("found drift own, past")) == (2, 1)

    def exists(**more):
        (policy,) = policies_of(arguments(tmp_path / "c", **{"prior": "past", "seeds": 1} | more))
        return policy.is_trained

    # What changes no weights makes no other policy.
    assert exists() and exists(episodes=3, nfe=1, grid="dense-jump", encoder="resnet18")
    others = {"sigma": 0.4, "batch_size": 8, "network": "mlp,hidden_dim=8", "prior": "past,correlation=0.5"}
    others["task"] = f"{drift.__name__}:other"
    assert not any(exists(**{name: value}) for name, value in others.items())


@pytest.mark.parametrize("work", [common.train, lambda policy: measure(policy, [1])])
def test_a_worker_that_reads_other_demonstrations_says_so(work, tmp_path):
    """Its policy would be named after those that the first process read."""
    (policy,) = policies_of(
        arguments(tmp_path / "out", task=f"{drift.__name__}:unseeded", prior="past", seeds=1)
    )
    if work is not common.train:
        common.train(policy)
    common.cached_task.cache_clear()  # as in a fresh process
    refuses(lambda: work(policy), ValueError, "drift own", "seed")
    assert work is not common.train or not policy.is_trained


LEARNT = ("forecast", "step", "cvae", "cvae-history", "a2a", "leap")


def test_every_method_is_trained_with_what_it_needs_before_it(tmp_path, capsys):
    """Teachers are policies of the comparison, and sources learn once."""
    names = ["reflow", "gaussian", "history", "regression", "ot", *LEARNT]
    own = f"{drift.__name__}:Widening"
    few = {"iterations": 10, "checkpoints": 1, "episodes": 1, "seeds": 1, "nfe": 1}
    argv = arguments(tmp_path / "out", prior=[*names, own], **few)
    assert robomimic.main(argv) == 0
    # What a file says is not imported: only what was typed.
    again = ["--resume", "--out", tmp_path / "out"]
    assert "name it again, with --prior" in refused(robomimic.main, again, capsys)
    rows = {row["prior"]: row for row in stored(tmp_path / "out")}
    assert set(rows) == {*names, "widening"}
    policies = {p.method.name: p for p in policies_of([*argv, "--resume"])}
    assert {p.folder for p in policies.values()} == set((tmp_path / "policies").iterdir())
    assert policies["reflow"].teacher().folder == policies["gaussian"].folder
    for name, policy in policies.items():
        actor, own_time = policy.load(), json.loads(policy.status.read_text())["seconds"]
        kept = [part for part in ("prior", "start") if (policy.folder / f"{part}.safetensors").exists()]
        assert kept == ([] if name not in LEARNT else ["start"] if name == "step" else ["prior"])
        assert actor.sampling.max_nfe == (1 if name == "regression" else None)
        assert all(bool(torch.isfinite(p).all()) for p in actor.parameters())
        # A training needs its teacher's.
        assert (rows[name]["training_seconds"] > own_time) == (name == "reflow")
    assert policies["widening"].load().prior.scale.item() != 1.0


NETWORK = """
import torch
from warmprior import VelocityNetwork

class Resting(VelocityNetwork):
    def __init__(self, action_dim, observation_dim, prediction_length, observation_steps):
        super().__init__(action_dim, observation_dim, prediction_length, observation_steps)
        self.velocity = torch.nn.Parameter(torch.zeros(prediction_length, action_dim))

    def forward(self, t, a, observation):
        return self.velocity.expand_as(a)
"""


def test_a_network_of_ones_own_is_found_in_a_fresh_process_and_trained_again_if_edited(
    tmp_path, capsys, monkeypatch
):
    file, name = tmp_path / "networks_of_mine.py", "networks_of_mine:Resting"
    file.write_text(NETWORK)
    monkeypatch.syspath_prepend(tmp_path)
    few = {"iterations": 1, "checkpoints": 1, "episodes": 1, "seeds": 1, "nfe": 1, "prior": "past"}
    argv = arguments(tmp_path / "out", network=name, **few)
    try:
        assert robomimic.main(argv) == 0
        again = ["--resume", "--out", tmp_path / "out"]
        assert "--network" in refused(robomimic.main, again, capsys)  # what a file says is not imported
        (policy,) = policies_of([*argv, "--resume"])
        del VelocityNetwork.classes["Resting"], sys.modules["networks_of_mine"]
        assert policy.is_trained and type(policy.load().network.network).__name__ == "Resting"
        file.write_text(NETWORK + "# edited\n")
        (edited,) = policies_of([*argv, "--resume"])
        assert edited.name != policy.name and not edited.is_trained
        wrong = arguments(tmp_path / "wrong", network="networks_of_mine:Missing", **few)
        assert "--network networks_of_mine:Missing" in refused(robomimic.main, wrong, capsys)
    finally:
        VelocityNetwork.classes.pop("Resting", None)
        sys.modules.pop("networks_of_mine", None)


def test_a_training_that_fails_costs_its_own_rows_alone(tmp_path, capsys, monkeypatch):
    train = common.train_policy

    def failing(task, prior, *args, **options):
        if prior.name == "past":
            raise FloatingPointError("the loss became nan")
        return train(task, prior, *args, **options)

    priors = ["gaussian", "past"]
    few = {"prior": priors, "seeds": 1, "episodes": 1, "nfe": 1, "checkpoints": 1, "iterations": 4}
    argv = arguments(tmp_path / "out", **few)
    with monkeypatch.context() as patch:
        patch.setattr(common, "train_policy", failing)
        assert robomimic.main(argv) == 2
    assert "FAILED drift own, past" in capsys.readouterr().out
    assert {row["prior"] for row in stored(tmp_path / "out")} == {"gaussian"}
    assert "the loss became nan" in (tmp_path / "out" / "report.md").read_text()
    assert robomimic.main([*argv, "--resume"]) == 0
    assert [row["prior"] for row in stored(tmp_path / "out")] == priors
    # So does a trained policy of which the file with its time is damaged.
    (status,) = tmp_path.glob("policies/*-past-*/status.json")
    status.write_text(status.read_text()[:-9])
    assert robomimic.main(arguments(tmp_path / "again", **few)) == 2
    assert f"{status} is damaged: remove it" in (tmp_path / "again" / "report.md").read_text()
    assert {row["prior"] for row in stored(tmp_path / "again")} == {"gaussian"}


def run(folder):
    """A run that several processes start, of which one method fails in all of them."""
    jobs.Local = Inline
    train = common.train_policy

    def watched(task, prior, *args, **options):
        with (folder / "trained").open("a") as file:
            file.write(f"{prior.name} {rank()} of {world_size()}\n")
        if prior.name == "preview":
            raise FloatingPointError("the loss became nan")
        return train(task, prior, *args, **options)

    common.train_policy = watched
    robomimic.run(arguments(folder / "out", seeds=1, episodes=2), PRESETS, "robomimic", "")


def test_several_processes_train_together_and_one_plays(finished, tmp_path):
    """The rows have the facts and order of one process; each draws its own part of a batch."""
    refuses(lambda: together(run, tmp_path), Exception, "failed")
    facts = ("prior", "sigma", "seed", "checkpoint", "nfe")
    alone, both = ([[r[f] for f in facts] for r in stored(f)] for f in (finished, tmp_path / "out"))
    assert both == [fact for fact in alone if fact[2] == 0]
    trained = sorted((tmp_path / "trained").read_text().splitlines())
    assert trained == [f"{p} {r} of 2" for p in ("gaussian", "past", "preview") for r in range(2)]
