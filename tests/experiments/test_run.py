"""Comparisons in worker processes: the same rows for any number of workers, whatever ends first."""

from __future__ import annotations

import json
import math
import os
import signal
import threading
import time
import warnings
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase, TransformedEnv

from tests.training.cloning_parts import same
from warmprior import (
    ForecastPrior,
    GaussianPrior,
    PastPrior,
    PreviewPrior,
    ReflowPrior,
    StepPrior,
)
from warmprior.diagnostics import (
    SharedObservations,
    branching_bound,
    curvature,
    source_leak,
)
from warmprior.envs.tasks import EVALUATION_SEED
from warmprior.io import workers
from warmprior.io.files import load_file
from warmprior.io.script import PartialFailure
from warmprior.modules import Normalizer
from warmprior.training import TrainingConfig, WorkerError, play_episode

pytest.importorskip("tyro")

from warmprior.experiments import (
    Comparison,
    EvaluationOptions,
    NetworkOptions,
    Problem,
    Recipe,
    RunOptions,
    Store,
    store,
    write_report,
)

H = 4
PRIORS = (GaussianPrior(H), PastPrior(H), PreviewPrior(H))
OBSERVATION_DIM, ACTION_DIM = 19, 7
TRAINING = TrainingConfig(
    iterations=20, batch_size=16, learning_rate=1e-2, checkpoints=2, log_every=5
)


class DriftEnv(EnvBase):
    """A state that drifts with the actions from a start by seed; the task is to go to one side.

    Episodes last 9 to 15 steps. ``log`` receives a file per episode and process.
    """

    def __init__(self, log: Path | None = None, sleep: float = 0.0) -> None:
        super().__init__(device="cpu", batch_size=[])
        self.log, self.sleep, self.seed_ = log, sleep, 0

        def flag():
            return Categorical(2, dtype=torch.bool, shape=(1,))

        self.observation_spec = Composite(observation=Unbounded((OBSERVATION_DIM,)), success=flag())
        self.action_spec = Bounded(-1, 1, (ACTION_DIM,))
        self.reward_spec = Unbounded((1,))
        self.done_spec = Composite({k: flag() for k in ("done", "terminated", "truncated")})

    def _set_seed(self, seed):
        self.seed_ = seed

    def _reset(self, tensordict=None, **kwargs):
        self.left = 9 + self.seed_ % 7
        generator = torch.Generator().manual_seed(self.seed_)
        self.state = torch.randn(OBSERVATION_DIM, generator=generator)
        if self.log is not None:
            (self.log / f"{self.seed_}-{os.getpid()}-{time.monotonic_ns()}").touch()
        no = torch.zeros(1, dtype=torch.bool)
        state = self.state.clone()
        return TensorDict(
            {"observation": state, "success": no, **dict.fromkeys(self.done_keys, no)}, []
        )

    def _step(self, tensordict):
        time.sleep(self.sleep)
        self.left -= 1
        self.state = self.state.clone()
        self.state[:ACTION_DIM] += 0.1 * tensordict["action"]
        done = torch.tensor([self.left == 0])
        return TensorDict(
            {
                "observation": self.state,
                "success": done & (self.state[:ACTION_DIM].sum() > 0),
                "reward": torch.zeros(1),
                "done": done,
                "terminated": done,
                "truncated": torch.zeros(1, dtype=torch.bool),
            },
            [],
        )


def drift_problem(env=None):
    """A user's own: demonstrations made here, in units of their own, and an environment of ours."""
    generator = torch.Generator().manual_seed(0)
    episodes = [
        TensorDict(
            {
                "observation": torch.randn(n, OBSERVATION_DIM, generator=generator).cumsum(0),
                "action": torch.randn(n, ACTION_DIM, generator=generator).tanh(),
                "episode": torch.full((n,), i),
            },
            [n],
        )
        for i, n in enumerate((30, 5, 40))
    ]
    data = torch.cat(episodes)
    normalizer = Normalizer.fit(data)
    make_env = DriftEnv if env is None else partial(lambda env: env, env)
    return Problem(
        "drift", "own", normalizer.normalize(data), make_env, "1", normalizer=normalizer, clip=1.0
    )


def comparison(
    folder,
    envs,
    *,
    priors=PRIORS,
    kind=Store,
    training=TRAINING,
    resume=False,
    episodes=5,
    seeds=2,
    problem=None,
    logger="none",
    precondition=True,
    play_on=False,
    grid="uniform",
):
    recipe = Recipe(
        network=NetworkOptions(hidden_dim=16, precondition=precondition),
        training=training,
        evaluation=EvaluationOptions(
            seeds=seeds, episodes=episodes, nfe=(3, 1), play_on=play_on, grid=grid
        ),
        run=RunOptions(out=folder / "out", resume=resume, envs=envs, logger=logger),
    )
    store = kind(
        problem or drift_problem(),
        recipe.network,
        folder / "policies",
        folder / "out" / "logs",
        recipe.run,
    )
    return Comparison(recipe, stores=[store], priors=priors)


def stored(folder):
    return json.loads((folder / "out" / "results.json").read_text())


def rows_of(folder):
    return [
        {**row["facts"], **row["measures"], "outcomes": row["outcomes"]}
        for row in stored(folder)["rows"]
    ]


def weights(folder):
    return {
        f"{path.parents[1].name}/{path.parent.name}/{name}": value
        for path in (folder / "policies").rglob("policy_*/model.safetensors")
        for name, value in load_file(path).items()
    }


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """By one worker."""
    folder = tmp_path_factory.mktemp("undisturbed")
    comparison(folder, 1).run()
    return folder


@pytest.mark.parametrize("envs", [2, 3])
def test_rows_and_weights_do_not_depend_on_the_number_of_workers(undisturbed, tmp_path, envs):
    threads = torch.get_num_threads()
    torch.set_num_threads(2)  # the parent's number is none of their business either
    try:
        comparison(tmp_path, envs).run()
    finally:
        torch.set_num_threads(threads)
    assert same(weights(tmp_path), weights(undisturbed))
    assert rows_of(tmp_path) == rows_of(undisturbed)
    rows = rows_of(undisturbed)
    assert all(row["boundary_jump"] > 0 and row["inner_jump"] > 0 for row in rows)
    # The comparison above says something: the policies and their noise decide.
    assert len({row["boundary_jump"] for row in rows}) == len(rows)
    assert 0 < sum(row["successes"] for row in rows) < sum(row["episodes"] for row in rows)


def test_spawned_workers_give_the_same_rows(undisturbed, tmp_path, monkeypatch):
    """As beside CUDA: everything that a worker needs is handed over instead of inherited."""
    monkeypatch.setattr(workers, "start_method", lambda: "spawn")
    comparison(tmp_path, 2, priors=PRIORS[1:2], seeds=1).run()
    expected = [r for r in rows_of(undisturbed) if (r["prior"], r["seed"]) == ("past", 0)]
    assert rows_of(tmp_path) == expected


class LastIsFirst(Store):
    """The trainings end in the opposite order, some of them later than others."""

    def train(self, prior, training, progress=None):
        losses = super().train(prior, training, progress)
        time.sleep(1.5 - 0.5 * [p.name for p in PRIORS].index(prior.name) - 0.2 * training.seed)
        return losses


def test_rows_have_their_order_whatever_ends_first(undisturbed, tmp_path, capsys):
    comparison(tmp_path, 6, kind=LastIsFirst).run()
    rows = rows_of(tmp_path)
    cells = [(row["prior"], row["seed"], row["checkpoint"], row["nfe"]) for row in rows]
    names = ("gaussian", "past", "preview")
    assert cells == [(p, s, c, n) for p in names for s in (0, 1) for c in (10, 20) for n in (3, 1)]
    assert rows == rows_of(undisturbed)
    told = capsys.readouterr().out
    assert told.count("trained ") == 6 and told.count("played ") == 24
    assert told.index("trained drift own, preview") < told.index("trained drift own, gaussian")


def test_every_worker_plays_each_seed_once_per_cell(tmp_path):
    log = tmp_path / "log"
    log.mkdir()
    env = DriftEnv(log, sleep=0.01)
    comparison(tmp_path, 2, problem=drift_problem(env), priors=PRIORS[:2]).run()
    names = [path.name.split("-") for path in log.iterdir()]
    seeds = [int(seed) for seed, _, _ in names]
    cells = 2 * 2 * 2 * 2
    assert sorted(seeds) == sorted([*range(EVALUATION_SEED, EVALUATION_SEED + 5)] * cells)
    processes = {pid for _, pid, _ in names}
    assert len(processes) == 2 and str(os.getpid()) not in processes


class WaitsForAnEpisode(Store):
    """The last training does not end before an episode was played."""

    def train(self, prior, training, progress=None):
        deadline = time.monotonic() + 30
        while prior.name == "preview" and not any(self.problem.make_env().log.iterdir()):
            assert time.monotonic() < deadline, "nothing was played while this training ran"
            time.sleep(0.05)
        return super().train(prior, training, progress)


def test_a_policy_is_played_before_the_last_training_ended(tmp_path):
    log = tmp_path / "log"
    log.mkdir()
    comparison(
        tmp_path, 2, kind=WaitsForAnEpisode, problem=drift_problem(DriftEnv(log)), seeds=1
    ).run()


def test_losses_are_those_of_the_workers_and_nothing_is_trained_again(
    undisturbed, tmp_path, monkeypatch
):
    finished = comparison(tmp_path, 2, logger="csv")
    finished.run()
    iterations = [5, 10, 15, 20]
    monkeypatch.setattr(Store, "new_actor", lambda *args: pytest.fail("something was trained"))
    losses = finished.losses(finished.stores[0])
    assert {name: len(curves) for name, curves in losses.items()} == {p.label: 2 for p in PRIORS}
    assert all([i for i, _ in curve] == iterations for c in losses.values() for curve in c)
    monkeypatch.undo()
    again = comparison(undisturbed, 1, resume=True)
    assert again.losses(again.stores[0]) == losses
    logs = tmp_path / "out" / "logs"
    logged = {path.relative_to(logs).parts[0] for path in logs.rglob("*loss*.csv")}
    assert logged == {path.name for path in (tmp_path / "policies").iterdir()}


def test_meta_tells_what_computed(undisturbed):
    meta = stored(undisturbed)["meta"]
    assert meta["hardware"]["torch_threads"] == 1 and meta["hardware"]["workers"] == 1
    assert "envs" not in meta["identity"]["recipe"]["run"] and meta["wall_time_s"] > 0
    assert [p["seed"] for p in meta["policies"]] == [0, 1] * 3


def test_another_number_of_workers_continues(undisturbed, tmp_path):
    """Stored rows are kept, missing ones played."""
    whole = stored(undisturbed)["rows"]
    comparison(tmp_path, 1).run()
    path = tmp_path / "out" / "results.json"
    results = json.loads(path.read_text())
    results["rows"] = [
        row | {"measures": row["measures"] | {"mean_steps": 12_345.0}} for row in whole[3:9]
    ]
    path.write_text(json.dumps(results))
    comparison(tmp_path, 2, resume=True).run()
    assert stored(tmp_path)["rows"] == whole[:3] + results["rows"] + whole[9:]


def test_rows_tell_what_was_measured_of_their_policy(undisturbed):
    """The same as measured here, on the policy that the row is about, if it is a last checkpoint."""
    (store,) = comparison(undisturbed, 1, resume=True).stores
    for row in rows_of(undisturbed):
        if row["checkpoint"] != TRAINING.iterations:
            assert row.get("source_leak") is None and row.get("kappa") is None
            continue
        prior = next(prior for prior in PRIORS if prior.name == row["prior"])
        shared = SharedObservations(store.problem.data, prior.chunk_length, observation_steps=2)
        order = torch.randperm(len(shared), generator=torch.Generator().manual_seed(0))
        shared = shared.subset(order.sort()[0])
        windows = shared.windows(prior)
        policy = store.load(prior, replace(TRAINING, seed=row["seed"]), row["checkpoint"])
        leak = source_leak(policy, windows, nfes=(1, 3), episodes=shared.episodes)[row["nfe"]]
        assert row["source_leak"] == pytest.approx(leak.leak)
        assert row["inner_step_ratio"] == pytest.approx(leak.inner_step_ratio)
        generator = torch.Generator().manual_seed(0)
        if prior.ever_warm:
            windows = shared.deployed(policy, generator=generator)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            flow = curvature(policy, windows, generator=generator)
        for name, key in (("kappa", "kappa_executed"), ("relative_curvature", "relative_executed")):
            value = float(flow[key].nanmean())
            told = math.nan if row[name] is None else row[name]  # it does not move
            assert told == pytest.approx(value, nan_ok=True)
        bound = branching_bound(windows, prior)["total_executed"].mean()
        assert row["bound"] == pytest.approx(float(bound))


def test_rows_tell_every_episode_in_the_order_of_the_seeds(undisturbed):
    (store,) = comparison(undisturbed, 1, resume=True).stores
    row = rows_of(undisturbed)[-1]
    policy = store.load(PRIORS[2], replace(TRAINING, seed=row["seed"]), row["checkpoint"])
    env = TransformedEnv(DriftEnv(), store.transforms(PRIORS[2])())
    seeds = range(EVALUATION_SEED, EVALUATION_SEED + row["episodes"])
    options = {"nfe": row["nfe"], "policy_seed": row["seed"]}
    solved = [play_episode(policy, env, seed, **options).success for seed in seeds]
    assert row["outcomes"] == "".join(str(int(s)) for s in solved)
    assert 0 < sum(solved) < len(solved)


class Diverging(Store):
    def train(self, prior, training, progress=None):
        if prior.name != "past":
            return super().train(prior, training, progress)
        data = self.problem.data.clone()
        data["action"].fill_(1e30)
        problem = replace(self.problem, data=data)
        broken = Store(problem, self.network, self.directory, self.logs, self.run)
        return broken.train(prior, training, progress)


def test_a_policy_that_fails_is_named_and_does_not_stop_the_others(undisturbed, tmp_path, capsys):
    # Moments would refuse such actions before any training.
    compared = comparison(tmp_path, 3, kind=Diverging, seeds=1, precondition=False)
    file = str(compared.contestants[1].folder / "state.safetensors")
    rows = compared.run().rows
    assert [row["prior"] for row in rows] == ["gaussian"] * 4 + ["preview"] * 4
    assert [c.prior.name for c in compared.contestants] == ["gaussian", "preview"]
    (failure,) = compared.failures
    assert failure.startswith("drift") and "past" in failure and file in failure
    assert f"FAILED {failure}" in capsys.readouterr().out
    assert set(compared.policies()) == {prior.describe() for prior in (PRIORS[0], PRIORS[2])}
    # A second attempt, in which nothing fails, adds what is missing.
    again = comparison(tmp_path, 2, seeds=1, precondition=False, resume=True)
    assert [row["prior"] for row in again.run().rows][4:8] == ["past"] * 4
    assert again.failures == []


def test_rows_of_a_policy_that_failed_on_the_way_are_kept_but_not_shown(tmp_path):
    compared = comparison(tmp_path, 1, priors=PRIORS[:2], seeds=2)
    compared.run()
    everything = compared.results.rows
    failed = compared.contestants.pop()
    assert [row for row in everything if row["prior"] == "past" and row["seed"] == 1]
    assert len(compared.rows) == len(everything) - 4 and failed.prior.name == "past"
    assert {(row["prior"], row["seed"]) for row in compared.timed()} == {
        ("gaussian", 0),
        ("gaussian", 1),
        ("past", 0),
    }
    write_report(tmp_path, "| table |\n")
    with pytest.raises(PartialFailure, match="1 failed"):
        write_report(tmp_path, "| table |\n", [f"{failed}: it stumbled"])
    assert (tmp_path / "table.md").read_text() == f"| table |\n\n- Missing: {failed}: it stumbled\n"


def test_a_problem_that_cannot_be_built_leaves_the_others_alone(tmp_path):
    """In one worker, which plays the sound problem before and after."""
    sound, broken = drift_problem(), replace(drift_problem(), task="broken", make_env=unbuildable)
    options = {"priors": PRIORS[:2], "seeds": 1}
    alone = comparison(tmp_path / "alone", 1, **options)
    alone.run()
    both = comparison(tmp_path / "both", 1, **options)
    store = both.stores[0]
    recipe = both.recipe
    stores = [
        Store(p, store.network, store.directory, store.logs, store.run) for p in (sound, broken)
    ]
    both = Comparison(recipe, "two", stores=stores, directory=tmp_path / "two", priors=PRIORS[:2])
    both.run()
    assert len(both.failures) == 2 and all("cannot be built" in f for f in both.failures)
    assert both.rows == alone.rows


def unbuildable(**options):
    raise RuntimeError("this simulator cannot be built")


def test_rows_from_before_priors_had_options_are_continued(undisturbed, tmp_path):
    (tmp_path / "out").mkdir()
    results = stored(undisturbed)
    for row in results["rows"]:
        assert row["facts"].pop("options") == ""
    (tmp_path / "out" / "results.json").write_text(json.dumps(results))
    again = comparison(tmp_path, 1, resume=True)
    assert not any(again._evaluations(n) for n in range(len(again.contestants)))


class Stumbling(DriftEnv):
    def _step(self, tensordict):
        if self.seed_ == EVALUATION_SEED + 2:
            raise AssertionError("the simulator stumbled")
        return super()._step(tensordict)


def test_where_everything_fails_the_run_does(tmp_path):
    compared = comparison(tmp_path, 2, problem=drift_problem(Stumbling()), seeds=1)
    with pytest.raises(PartialFailure, match=r"(?s)gaussian.*stumbled.*preview.*stumbled"):
        compared.run()


def test_a_training_that_fails_is_told_when_all_others_are_done(tmp_path):
    compared = comparison(tmp_path, 3, kind=Diverging, seeds=1, precondition=False)
    with pytest.raises(PartialFailure, match="past"):
        compared.train()
    assert [c.path.is_dir() for c in compared.contestants] == [True, True]


class Mortal(DriftEnv):
    def _step(self, tensordict):
        if self.seed_ == EVALUATION_SEED + 2:
            os.kill(os.getpid(), signal.SIGKILL)
        return super()._step(tensordict)


def test_a_killed_worker_ends_the_run_which_continues(undisturbed, tmp_path):
    result = []

    def run():
        try:
            comparison(tmp_path, 2, problem=drift_problem(Mortal())).run()
        except BaseException as error:
            result.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(60)
    assert not thread.is_alive(), "the comparison hangs after its worker was killed"
    assert isinstance(result[0], WorkerError) and "--envs" in str(result[0])
    comparison(tmp_path, 3, resume=True).run()
    assert rows_of(tmp_path) == rows_of(undisturbed)


def test_the_same_policy_is_trained_once(tmp_path, capsys):
    twice = [PastPrior(H), PastPrior(H)]
    compared = comparison(tmp_path, 2, priors=twice, seeds=1)
    assert len(compared.run().rows) == 4  # two checkpoints, two NFEs
    assert capsys.readouterr().out.count("trained ") == 1


class Timed(Store):
    """Notes when its trainings ran."""

    def train(self, prior, training, progress=None):
        started = time.monotonic()
        losses = super().train(prior, training, progress)
        time.sleep(0.2)
        note = {"from": started, "to": time.monotonic()}
        (self.directory / f"{prior.name}-{training.seed}.json").write_text(json.dumps(note))
        return losses


@pytest.mark.parametrize("at_once", [None, 1])
def test_trainings_share_a_device_only_where_they_may(tmp_path, monkeypatch, at_once):
    """One at a time, as beside CUDA, and the others' episodes meanwhile."""
    monkeypatch.setattr(Comparison, "trainings_at_once", at_once)
    comparison(tmp_path, 3, kind=Timed).run()
    notes = [json.loads(path.read_text()) for path in (tmp_path / "policies").glob("*.json")]
    notes.sort(key=lambda note: note["from"])
    apart = [a["to"] <= b["from"] for a, b in pairwise(notes)]
    assert len(notes) == 6 and (all(apart) if at_once else not all(apart))


class Unhashable(PastPrior):
    """As a dataclass is that compares its fields."""

    name = "unhashable"
    __hash__ = None

    def __eq__(self, other):
        return self is other


class Widening(PastPrior, torch.nn.Module):
    """Its noise is learnt."""

    name = "widening"

    def __init__(self, chunk_length, *, sigma=0.5, cold_probability=0.0):
        torch.nn.Module.__init__(self)
        super().__init__(chunk_length, sigma=sigma, cold_probability=cold_probability)
        self.scale = torch.nn.Parameter(torch.ones(()))

    def sample(self, loc, warm, generator=None, observation=None):
        return loc + self.scale * (super().sample(loc, warm, generator) - loc)


def test_priors_that_learn_or_cannot_be_hashed(tmp_path):
    compared = comparison(tmp_path, 2, priors=[Unhashable(H), Widening(H)], seeds=1)
    rows = compared.run().rows
    assert [row["prior"] for row in rows] == ["unhashable"] * 4 + ["widening"] * 4
    assert float(compared.contestants[1].policy().prior.scale) != 1.0


def test_priors_that_learn_before_the_flow_learn_once(tmp_path, monkeypatch):
    priors = [ForecastPrior(H), StepPrior(H)]
    compared = comparison(tmp_path, 2, priors=priors, seeds=1)
    compared.run()
    forecast = compared.contestants[0]
    assert forecast.prior.is_sized and (forecast.folder / "prior.safetensors").exists()
    learnt = forecast.policy().prior
    loaded = forecast.store.load(priors[0], forecast.training).prior
    assert all(
        torch.equal(a, b) for a, b in zip(*(p.buffers() for p in (learnt, loaded)), strict=True)
    )
    fresh = ForecastPrior(H).sized(ACTION_DIM, OBSERVATION_DIM, 2).state_dict()
    assert any(not torch.equal(learnt.state_dict()[name], fresh[name]) for name in fresh)
    rows = rows_of(tmp_path)
    monkeypatch.setattr(store, "learn_prior", lambda *args, **kwargs: pytest.fail("learnt again"))
    again = comparison(tmp_path, 1, priors=priors, seeds=1, resume=True)
    again.run()
    assert rows_of(tmp_path) == rows


def test_times_of_trainings_are_told_beside_the_rows(tmp_path):
    compared = comparison(tmp_path, 2, priors=PRIORS[:2], seeds=1)
    assert compared.timed() == []
    compared.run()
    first = compared.timed()
    assert [replace(row, measures={}) for row in first] == [
        replace(row, measures={}) for row in compared.results.rows
    ]
    assert all(row["training_seconds"] > 0 for row in first)
    assert len({row["training_seconds"] for row in first}) == 2
    again = comparison(tmp_path, 1, priors=PRIORS[:2], seeds=1, resume=True)
    again.run()
    assert again.timed() == first  # nothing was trained
    (compared.contestants[0].folder / "training_time.json").unlink()
    assert compared.timed()[0]["training_seconds"] is None


def test_a_student_waits_for_its_teacher(tmp_path, capsys):
    """Whatever the order; and without the teacher in the comparison, it is trained on the way."""
    priors = [ReflowPrior(H, teacher_nfe=2), GaussianPrior(H)]
    compared = comparison(tmp_path / "both", 3, priors=priors, seeds=1)
    compared.run()
    told = capsys.readouterr().out
    assert told.index("trained drift own, gaussian") < told.index("trained drift own, reflow")
    comparison(tmp_path / "one", 2, priors=priors[:1], seeds=1).run()
    both, one = rows_of(tmp_path / "both"), rows_of(tmp_path / "one")
    assert [row["prior"] for row in both] == ["reflow"] * 4 + ["gaussian"] * 4 and both[:4] == one
    reflow, gaussian = (c.policy().network.state_dict() for c in compared.contestants)
    assert any(not torch.equal(reflow[name], gaussian[name]) for name in reflow)


def test_students_of_one_teacher_share_it(tmp_path, capsys):
    """It is trained once, by one worker, though it is not compared itself."""
    priors = [ReflowPrior(H, teacher_nfe=n) for n in (2, 3)]
    for envs in (1, 3):
        compared = comparison(tmp_path / str(envs), envs, priors=priors, seeds=1)
        compared.run()
        told = capsys.readouterr().out
        assert not compared.failures and told.count("trained drift own, gaussian") == 1
        teacher = compared.contestants[0].teacher()
        whole = teacher.store.training_seconds(teacher.prior, teacher.training)
        assert all(row["training_seconds"] > whole for row in compared.timed())
    assert rows_of(tmp_path / "1") == rows_of(tmp_path / "3")


class Unteachable(Store):
    def train(self, prior, training, progress=None):
        if prior.name == "gaussian":
            raise FloatingPointError("the teacher diverged")
        return super().train(prior, training, progress)


def test_without_its_teacher_a_student_fails_at_once(tmp_path):
    priors = [ReflowPrior(H), PastPrior(H)]
    compared = comparison(tmp_path, 2, kind=Unteachable, priors=priors, seeds=1)
    compared.run()
    assert [c.prior.name for c in compared.contestants] == ["past"]
    assert len(compared.failures) == 2
    assert all("the teacher diverged" in failure for failure in compared.failures)


def test_a_chunk_longer_than_every_demonstration_is_refused(tmp_path):
    with pytest.raises(ValueError, match="longest demonstration of drift own has, 40"):
        comparison(tmp_path, 1, priors=[PastPrior(41)])


def test_results_of_another_recipe_are_not_continued(undisturbed):
    with pytest.raises(ValueError, match=r"results\.json belongs to another"):
        comparison(undisturbed, 1, resume=True, episodes=6)


def test_what_rows_could_not_tell_is_refused(tmp_path):
    twins = [PastPrior(3), PastPrior(3, cold_probability=0.5)]
    with pytest.raises(ValueError, match="rows tell policies apart by their task"):
        comparison(tmp_path, 1, priors=twins)


def test_several_problems_in_one_run_are_what_each_is_alone(tmp_path):
    """Other demonstrations, and an environment of its own for each; in one table and one store."""
    other = replace(drift_problem(), task="early", identity="2", make_env=SolvedEarly)
    recipe = Recipe(
        network=NetworkOptions(hidden_dim=16),
        training=TRAINING,
        evaluation=EvaluationOptions(episodes=3, nfe=(1,)),
        run=RunOptions(out=tmp_path / "both" / "out", envs=1, logger="none"),
    )

    def run(*problems, folder, resume=False):
        options = replace(recipe.run, out=tmp_path / folder / "out", resume=resume)
        stores = [
            Store(p, recipe.network, tmp_path / folder / "policies", tmp_path / "logs", options)
            for p in problems
        ]
        compared = Comparison(replace(recipe, run=options), stores=stores, priors=PRIORS[:2])
        return compared.run().rows

    rows = run(drift_problem(), other, folder="both")
    alone = [
        *run(drift_problem(), folder="first"),
        *run(other, folder="second"),
    ]
    assert rows == alone
    assert [row["task"] for row in rows] == ["drift"] * 4 + ["early"] * 4
    assert run(drift_problem(), other, folder="both", resume=True) == rows


class SolvedEarly(DriftEnv):
    """Solved at its third step, and at no other."""

    def __init__(self, terminate_on_success=True):
        super().__init__()
        self.ends = terminate_on_success

    def _reset(self, tensordict=None, **kwargs):
        self.steps = 0
        return super()._reset(tensordict, **kwargs)

    def _step(self, tensordict):
        out = super()._step(tensordict)
        self.steps += 1
        solved = torch.tensor([self.steps == 3])
        out["success"] = solved
        out["done"] = out["terminated"] = out["done"] | (solved & self.ends)
        return out


def test_play_on_goes_to_the_end_and_remembers_success(tmp_path):
    found = {}
    for play_on in (False, True):
        folder = tmp_path / str(play_on)
        problem = replace(drift_problem(), make_env=SolvedEarly)
        compared = comparison(
            folder, 1, priors=PRIORS[:1], seeds=1, problem=problem, play_on=play_on
        )
        (found[play_on], *_) = compared.run().rows
    assert [row["success_rate"] for row in found.values()] == [1.0, 1.0]
    lengths = [9 + (EVALUATION_SEED + i) % 7 for i in range(5)]
    assert found[False]["mean_steps"] == 3
    assert found[True]["mean_steps"] == sum(lengths) / 5
