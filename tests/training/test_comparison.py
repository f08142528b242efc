"""Comparisons in worker processes: the same rows for any number of workers, whatever ends first."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import threading
import time
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from tests.data.synthetic import write_robomimic_file
from tests.training.cloning_parts import same
from warmprior import GaussianPrior, PastPrior, PreviewPrior
from warmprior.diagnostics import SharedObservations, source_leak
from warmprior.envs.tasks import EVALUATION_SEED
from warmprior.io.files import load_file
from warmprior.training import PRESETS, TrainingConfig, WorkerError, workers
from warmprior.training.comparison import Comparison
from warmprior.training.demonstrations import Demonstrations
from warmprior.training.policies import Policies
from warmprior.training.schedule import PlayJob, Schedule, TrainJob

pytest.importorskip("h5py")

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


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "lift.hdf5"
    write_robomimic_file(path, lengths=(30, 5, 40), task="lift")
    return Demonstrations(path, "file", "ph")


class ToyPolicies(Policies):
    """Of the demonstrations of lift, in an environment of the same widths."""

    env: DriftEnv | None = None

    def make_env(self):
        return DriftEnv() if self.env is None else self.env


def comparison(
    demonstrations,
    folder,
    envs,
    *,
    priors=PRIORS,
    kind=ToyPolicies,
    training=TRAINING,
    resume=False,
    episodes=5,
    seeds=(0, 1),
    env=None,
    logger="none",
):
    network = {"network": "mlp", "network_options": {"hidden_dim": 16}}
    preset = dataclasses.replace(
        PRESETS["quick"], training=training, envs=envs, episodes=episodes, **network
    )
    policies = kind(
        demonstrations, preset, folder / "policies", folder / "out" / "logs", logger=logger
    )
    del policies.make_env  # the data's
    policies.env = env
    return Comparison(policies, priors, [3, 1], folder / "out", seeds, resume=resume)


def stored(folder):
    return json.loads((folder / "out" / "results.json").read_text())


def weights(folder):
    return {
        f"{path.parents[1].name}/{path.parent.name}/{name}": value
        for path in (folder / "policies").rglob("policy_*/model.safetensors")
        for name, value in load_file(path).items()
    }


@pytest.fixture(scope="module")
def undisturbed(demonstrations, tmp_path_factory):
    """By one worker."""
    folder = tmp_path_factory.mktemp("undisturbed")
    comparison(demonstrations, folder, 1).run()
    return folder


@pytest.mark.parametrize("envs", [2, 3])
def test_rows_and_weights_do_not_depend_on_the_number_of_workers(
    demonstrations, undisturbed, tmp_path, envs
):
    threads = torch.get_num_threads()
    torch.set_num_threads(2)  # the parent's number is none of their business either
    try:
        comparison(demonstrations, tmp_path, envs).run()
    finally:
        torch.set_num_threads(threads)
    assert same(weights(tmp_path), weights(undisturbed))
    assert stored(tmp_path)["rows"] == stored(undisturbed)["rows"]
    rows = stored(undisturbed)["rows"]
    assert all(row["boundary_jump"] > 0 and row["inner_jump"] > 0 for row in rows)
    # The comparison above says something: the policies and their noise decide.
    assert len({row["boundary_jump"] for row in rows}) == len(rows)
    assert 0 < sum(row["successes"] for row in rows) < sum(row["episodes"] for row in rows)


def test_spawned_workers_give_the_same_rows(demonstrations, undisturbed, tmp_path, monkeypatch):
    """As beside CUDA: everything that a worker needs is handed over instead of inherited."""
    monkeypatch.setattr(workers, "start_method", lambda: "spawn")
    comparison(demonstrations, tmp_path, 2, priors=PRIORS[1:2], seeds=[0]).run()
    expected = [r for r in stored(undisturbed)["rows"] if (r["prior"], r["seed"]) == ("past", 0)]
    assert stored(tmp_path)["rows"] == expected


class LastIsFirst(ToyPolicies):
    """The trainings end in the opposite order, some of them later than others."""

    def train(self, prior, seed, progress=None):
        losses = super().train(prior, seed, progress)
        time.sleep(1.5 - 0.5 * [p.name for p in PRIORS].index(prior.name) - 0.2 * seed)
        return losses


def test_rows_have_their_order_whatever_ends_first(demonstrations, undisturbed, tmp_path, capsys):
    comparison(demonstrations, tmp_path, 6, kind=LastIsFirst).run()
    rows = stored(tmp_path)["rows"]
    cells = [(row["prior"], row["seed"], row["checkpoint"], row["nfe"]) for row in rows]
    names = ("gaussian", "past", "preview")
    assert cells == [(p, s, c, n) for p in names for s in (0, 1) for c in (10, 20) for n in (3, 1)]
    assert rows == stored(undisturbed)["rows"]
    told = capsys.readouterr().out
    assert told.count("trained ") == 6 and told.count("played ") == 24
    assert told.index("trained preview") < told.index("trained gaussian")


def test_every_worker_plays_each_seed_once_per_cell(demonstrations, tmp_path):
    log = tmp_path / "log"
    log.mkdir()
    env = DriftEnv(log, sleep=0.01)
    comparison(demonstrations, tmp_path, 2, env=env, priors=PRIORS[:2]).run()
    names = [path.name.split("-") for path in log.iterdir()]
    seeds = [int(seed) for seed, _, _ in names]
    cells = 2 * 2 * 2 * 2
    assert sorted(seeds) == sorted([*range(EVALUATION_SEED, EVALUATION_SEED + 5)] * cells)
    processes = {pid for _, pid, _ in names}
    assert len(processes) == 2 and str(os.getpid()) not in processes


class WaitsForAnEpisode(ToyPolicies):
    """The last training does not end before an episode was played."""

    def train(self, prior, seed, progress=None):
        deadline = time.monotonic() + 30
        while prior.name == "preview" and not any(self.env.log.iterdir()):
            assert time.monotonic() < deadline, "nothing was played while this training ran"
            time.sleep(0.05)
        return super().train(prior, seed, progress)


def test_a_policy_is_played_before_the_last_training_ended(demonstrations, tmp_path):
    log = tmp_path / "log"
    log.mkdir()
    comparison(
        demonstrations, tmp_path, 2, kind=WaitsForAnEpisode, env=DriftEnv(log), seeds=[0]
    ).run()


def test_losses_are_those_of_the_workers_and_nothing_is_trained_again(
    demonstrations, undisturbed, tmp_path, monkeypatch
):
    finished = comparison(demonstrations, tmp_path, 2, logger="csv")
    finished.run()
    iterations = [5, 10, 15, 20]
    monkeypatch.setattr(Policies, "new_actor", lambda *args: pytest.fail("something was trained"))
    losses = finished.losses
    assert {name: len(curves) for name, curves in losses.items()} == {p.name: 2 for p in PRIORS}
    assert all([i for i, _ in curve] == iterations for c in losses.values() for curve in c)
    monkeypatch.undo()
    assert comparison(demonstrations, undisturbed, 1, resume=True).losses == losses
    logs = tmp_path / "out" / "logs"
    logged = {path.relative_to(logs).parts[0] for path in logs.rglob("*loss*.csv")}
    assert logged == {path.name for path in (tmp_path / "policies").iterdir()}


def test_meta_tells_what_computed(demonstrations, undisturbed):
    meta = stored(undisturbed)["meta"]
    assert meta["hardware"]["torch_threads"] == 1 and meta["hardware"]["workers"] == 1
    assert "envs" not in meta["evaluation"] and meta["wall_time_s"] > 0


def test_another_number_of_workers_continues(demonstrations, undisturbed, tmp_path):
    """Stored rows are kept, missing ones played."""
    whole = stored(undisturbed)["rows"]
    comparison(demonstrations, tmp_path, 1).run()
    path = tmp_path / "out" / "results.json"
    results = json.loads(path.read_text())
    results["rows"] = [row | {"mean_steps": 12_345.0} for row in whole[3:9]]
    path.write_text(json.dumps(results))
    comparison(demonstrations, tmp_path, 2, resume=True).run()
    assert stored(tmp_path)["rows"] == whole[:3] + results["rows"] + whole[9:]


def test_rows_tell_what_the_source_leaks(demonstrations, undisturbed):
    """The same as measured here, on the policy that the row is about, if it is a last checkpoint."""
    policies = comparison(demonstrations, undisturbed, 1, resume=True).policies
    for row in stored(undisturbed)["rows"]:
        if row["checkpoint"] != TRAINING.iterations:
            assert row["source_leak"] is None
            continue
        prior = next(prior for prior in PRIORS if prior.name == row["prior"])
        shared = SharedObservations(policies.data, prior.chunk_length, observation_steps=2)
        order = torch.randperm(len(shared), generator=torch.Generator().manual_seed(0))
        windows = shared.subset(order.sort()[0]).windows(prior)
        policy = policies.load(prior, row["seed"], row["checkpoint"])
        leak = source_leak(policy, windows, nfes=(1, 3), episodes=shared.episodes)[row["nfe"]]
        assert row["source_leak"] == pytest.approx(leak.leak)
        assert row["inner_step_ratio"] == pytest.approx(leak.inner_step_ratio)


class Diverging(ToyPolicies):
    def __post_init__(self):
        super().__post_init__()
        # Moments would refuse such actions before any training.
        self.preset = dataclasses.replace(self.preset, precondition=False)

    def train(self, prior, seed, progress=None):
        if prior.name == "past":
            self.data["action"].fill_(1e30)
        elif prior.name == "preview":
            time.sleep(300)
        return super().train(prior, seed, progress)


def test_a_training_that_diverges_names_its_file_and_stops_the_others(demonstrations, tmp_path):
    started = time.monotonic()
    compared = comparison(demonstrations, tmp_path, 3, kind=Diverging, seeds=[0])
    with pytest.raises(FloatingPointError) as raised:
        compared.run()
    state = compared.policies.folder(PRIORS[1], 0) / "state.safetensors"
    assert str(state) in str(raised.value)
    assert time.monotonic() - started < 60


class Mortal(DriftEnv):
    def _step(self, tensordict):
        if self.seed_ == EVALUATION_SEED + 2:
            os.kill(os.getpid(), signal.SIGKILL)
        return super()._step(tensordict)


def test_a_killed_worker_ends_the_run_which_continues(demonstrations, undisturbed, tmp_path):
    result = []

    def run():
        try:
            comparison(demonstrations, tmp_path, 2, env=Mortal()).run()
        except BaseException as error:
            result.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(60)
    assert not thread.is_alive(), "the comparison hangs after its worker was killed"
    assert isinstance(result[0], WorkerError) and "--envs" in str(result[0])
    comparison(demonstrations, tmp_path, 3, resume=True).run()
    assert stored(tmp_path)["rows"] == stored(undisturbed)["rows"]


def test_the_same_policy_is_trained_once(demonstrations, tmp_path, capsys):
    twice = [PastPrior(H), PastPrior(H)]
    compared = comparison(demonstrations, tmp_path, 2, priors=twice, seeds=[0])
    assert len(compared.run().rows) == 4  # two checkpoints, two NFEs
    assert capsys.readouterr().out.count("trained ") == 1


def train_job(number):
    return TrainJob(PRIORS[0], 0, number)


def play_job(episode):
    return PlayJob(PRIORS[0], None, episode)


def test_schedule_gives_trainings_first_and_then_what_can_be_played():
    first, second = train_job(0), train_job(1)
    episodes = {first: [play_job(0), play_job(1)], second: [play_job(2)]}
    schedule = Schedule(episodes)
    assert [schedule.next() for _ in range(3)] == [first, second, None]
    schedule.trained(second)
    assert schedule.next() is episodes[second][0] and schedule.next() is None
    schedule.trained(first)
    assert [schedule.next() for _ in range(3)] == [*episodes[first], None]


def test_schedule_of_one_training_at_a_time_plays_beside_it():
    first, second = train_job(0), train_job(1)
    episodes = {first: [play_job(0), play_job(1)], second: []}
    schedule = Schedule(episodes, trainings_at_once=1)
    assert schedule.next() is first and schedule.next() is None
    schedule.trained(first)
    assert [schedule.next() for _ in range(4)] == [second, *episodes[first], None]


def test_what_rows_could_not_tell_is_refused(demonstrations, tmp_path):
    twins = [PastPrior(3), PastPrior(3, cold_probability=0.5)]
    with pytest.raises(ValueError, match="rows tell priors apart by name, sigma and chunk length"):
        comparison(demonstrations, tmp_path, 1, priors=twins)
