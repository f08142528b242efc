"""Training states that were damaged, lost their policies, or are in use."""

from __future__ import annotations

import fcntl
import multiprocessing
import os
import shutil

import pytest
import torch
from torch import nn

from tests.training.cloning_parts import CONFIG, actor_for, mlp, same, training, weights
from warmprior import Normalizer, PastPrior, VelocityMLP
from warmprior.training import load_policy
from warmprior.training.checkpoint import load_state, save_state
from warmprior.training.threads import torch_threads


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished")
    training(folder).run()
    return folder


@pytest.fixture
def folder(finished, tmp_path):
    shutil.copytree(finished, tmp_path / "run")
    return tmp_path / "run"


def rewrite(folder, change):
    """Change a state as whoever writes one could: its digest is right."""
    path = folder / "state.safetensors"
    tensors, facts = load_state(path)
    change(tensors, facts)
    save_state(path, tensors, facts)


def _short_generator(tensors, facts):
    tensors["rng/generator"] = tensors["rng/generator"][:10]


def _no_global_generator(tensors, facts):
    del tensors["rng/global"]


def _facts_of_another_kind(tensors, facts):
    facts["losses"] = 3


def _no_running(tensors, facts):
    del tensors["running"]


@pytest.mark.parametrize(
    "change",
    [
        _short_generator,
        _no_global_generator,
        _facts_of_another_kind,
        _no_running,
    ],
    ids=lambda change: change.__name__.strip("_"),
)
def test_a_damaged_state_is_refused_by_name(folder, change):
    rewrite(folder, change)
    with pytest.raises(ValueError, match=r"state\.safetensors .*(again|resume)"):
        training(folder)


@pytest.mark.parametrize("place", [-1, -5000, -40_000])
def test_a_flipped_bit_is_noticed(folder, place):
    path = folder / "state.safetensors"
    content = bytearray(path.read_bytes())
    content[place] ^= 4
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"state\.safetensors is not a readable training state"):
        training(folder)


def test_a_state_that_is_a_pipe(folder):
    (folder / "state.safetensors").unlink()
    os.mkfifo(folder / "state.safetensors")
    with pytest.raises(ValueError, match=r"state\.safetensors is not a regular file"):
        training(folder)


@pytest.mark.parametrize("damage", ["deleted", "cut"])
def test_a_lost_policy_is_rebuilt_and_not_trained_again(folder, damage):
    policy = folder / "policy_000040"
    before = {path.name: path.read_bytes() for path in policy.iterdir()}
    if damage == "deleted":
        shutil.rmtree(policy)
    else:
        (policy / "model.safetensors").write_bytes(b"")
    again = training(folder)
    again.step = lambda: pytest.fail("trains again")
    again.run()
    assert {path.name: path.read_bytes() for path in policy.iterdir()} == before


def test_a_folder_in_use_is_left_alone(folder, tmp_path):
    cloning = training(tmp_path / "new")
    (tmp_path / "new").mkdir()
    other = os.open(tmp_path / "new", os.O_RDONLY)
    fcntl.flock(other, fcntl.LOCK_EX)
    with pytest.raises(BlockingIOError, match=rf"{tmp_path}/new is in use by another process"):
        cloning.run()
    assert not list((tmp_path / "new").iterdir())
    os.close(other)  # as at the death of its process
    cloning.run()
    # Whoever only wants the finished policies needs nobody's leave.
    other = os.open(folder, os.O_RDONLY)
    fcntl.flock(other, fcntl.LOCK_EX)
    training(folder).run()
    os.close(other)


def _train(folder, pipe):
    torch.set_num_threads(1)
    cloning = training(folder)
    pipe.send("built")
    pipe.recv()
    try:
        cloning.run()
    except BlockingIOError as error:
        pipe.send(str(error))
    else:
        pipe.send("done")


def test_two_trainings_of_one_folder(tmp_path):
    """Built at the same time: one waits for nobody, the other is told, or finds the work done."""
    context = multiprocessing.get_context("fork")
    pipes, processes = [], []
    for _ in range(2):
        ours, theirs = context.Pipe()
        process = context.Process(target=_train, args=(tmp_path / "run", theirs))
        process.start()
        pipes.append(ours)
        processes.append(process)
    assert all(pipe.poll(60) and pipe.recv() == "built" for pipe in pipes)
    for pipe in pipes:
        pipe.send("go")
    outcomes = [pipe.recv() for pipe in pipes if pipe.poll(60)]
    for process in processes:
        process.join(30)
    assert "done" in outcomes
    assert all(o == "done" or "is in use by another process" in o for o in outcomes)
    with torch_threads(1):  # as many as theirs, or sums may be rounded otherwise
        whole = training(tmp_path / "whole")
        whole.run()
    assert same(weights(training(tmp_path / "run")), weights(whole))


def test_work_done_since_it_was_built_is_not_done_again(tmp_path):
    first, second = training(tmp_path), training(tmp_path)
    first.run()
    second.step = lambda: pytest.fail("trains again")
    second.run()
    assert second.iteration == 40 and same(weights(first), weights(second))


# --------------------------------------------------------------------------- users' own parts
class Plain(nn.Module):
    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(1, 1)

    def forward(self, t, a, observation):
        return self.layer(a[..., :1]).expand_as(a)


class Tied(VelocityMLP):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.blocks[1] = self.blocks[0]


class WithTuple(VelocityMLP):
    def __init__(self, action_dim, observation_dim, prediction_length, *, widths=(8, 8)):
        super().__init__(action_dim, observation_dim, prediction_length, hidden_dim=widths[0])
        self._config = {
            "action_dim": action_dim,
            "observation_dim": observation_dim,
            "prediction_length": prediction_length,
            "widths": widths,
        }


class Forgetful(VelocityMLP):
    """Does not tell its base class all its options."""

    def __init__(self, *args, width=8, **kwargs):
        super().__init__(*args, hidden_dim=width, **kwargs)
        del self._config["hidden_dim"]


class Incomplete(VelocityMLP):
    """Cannot be built from what it tells of itself."""

    def __init__(self, *args, needed, **kwargs):
        super().__init__(*args, hidden_dim=needed, **kwargs)


def _half_double():
    network = VelocityMLP(2, 3, 4, hidden_dim=8)
    network.head.double()
    return network


def _actor(network):
    return actor_for(PastPrior(4), network)


@pytest.mark.parametrize(
    ("network", "error", "said"),
    [
        (Plain, TypeError, "cannot save Plain: only VelocityNetwork"),
        (lambda: Forgetful(2, 3, 4, width=16), ValueError, "Forgetful could not be loaded again"),
        (lambda: Incomplete(2, 3, 4, needed=8), ValueError, "Incomplete could not .*needed"),
        (_half_double, ValueError, "head.*of torch.float64"),
    ],
)
def test_what_cannot_be_saved_is_refused_before_training(tmp_path, network, error, said):
    with pytest.raises(error, match=said):
        training(tmp_path / "run", actor=_actor(network()))


@pytest.mark.parametrize("key", [("state", "low"), "reading"])
def test_a_normaliser_of_other_keys_is_kept_with_the_policy(tmp_path, key):
    actor = actor_for()
    limits = {key: torch.ones(3), "action": torch.ones(2)}
    actor.normalizer = Normalizer({k: -v for k, v in limits.items()}, limits)
    cloning = training(tmp_path / "run", actor=actor)
    cloning.run(None)
    loaded = load_policy(cloning.policy_path())
    assert loaded.normalizer.config() == actor.normalizer.config()


def _compiled():
    return torch.compile(VelocityMLP(2, 3, 4, hidden_dim=8), backend="eager")


@pytest.mark.parametrize(
    "network",
    [
        lambda: Tied(2, 3, 4, hidden_dim=8),
        lambda: WithTuple(2, 3, 4, widths=(16, 8)),
        _compiled,
    ],
    ids=["tied", "tuple", "compiled"],
)
def test_users_networks_are_saved_resumed_and_loaded(tmp_path, network):
    def build():
        torch.manual_seed(5)
        return _actor(network())

    whole = training(tmp_path / "whole", actor=build())
    whole.run()
    part = training(tmp_path / "part", actor=build())
    step = part.step

    def stop():
        if part.iteration == 25:
            raise KeyboardInterrupt
        return step()

    part.step = stop
    with pytest.raises(KeyboardInterrupt):
        part.run()
    again = training(tmp_path / "part", actor=build())
    assert again.iteration == 21
    again.run()
    assert same(weights(again), weights(whole))
    policy = load_policy(whole.policy_path(CONFIG.iterations))
    assert not any("_orig_mod" in name for name in policy.state_dict())
    expected = [value for value in whole.ema.module.state_dict().values()]
    for one, two in zip(policy.network.state_dict().values(), expected, strict=True):
        assert torch.equal(one, two)


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
def test_other_precisions_are_saved_resumed_and_loaded(tmp_path, dtype):
    def cloning(folder):
        return training(folder, actor=actor_for(PastPrior(4), mlp()).to(dtype))

    whole = cloning(tmp_path / "whole")
    whole.run(None)
    half = cloning(tmp_path / "half")

    def interrupt(iteration):
        if iteration == 25:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        half.run(None, interrupt)
    resumed = cloning(tmp_path / "half")
    assert resumed.iteration == 21
    resumed.run(None)
    assert same(weights(whole), weights(resumed))
    assert all(p.dtype == dtype for p in whole.trained.parameters())
    loaded = load_policy(whole.policy_path(40)).network.state_dict()
    averaged = whole.ema.module["network"].state_dict()
    assert all(torch.equal(loaded[name], value) for name, value in averaged.items())
    assert all(value.dtype == dtype for value in loaded.values())
