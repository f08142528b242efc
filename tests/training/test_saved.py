"""Saved policies: bit-identical again, or refused where they were damaged, swapped or never could be."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import resource
import threading
import time

import pytest
import torch
from safetensors.torch import load_file, save_file
from tensordict import TensorDict
from torch import nn

from tests.toy_env import random_history
from warmprior import (
    ChiTransformer,
    GaussianPrior,
    Normalizer,
    PastPrior,
    PreconditionedNetwork,
    PreviewPrior,
    Prior,
    RealTimeChunking,
    VelocityMLP,
    WarmPriorActor,
    keys,
)
from warmprior.modules import StartPoint
from warmprior.training.saved import (
    check_saveable,
    load_policy,
    policy_config,
    save_policy,
)

H, D_A, D_O, TO = 3, 2, 5, 2
ACTION = "normalizer.action_scale"


class Halfway(StartPoint):
    """A start that is no source: half of the noise at the time 0.5, around a weight."""

    name = "halfway-of-the-files"
    time = noise_share = 0.5

    def __init__(self, level=0.0):
        nn.Module.__init__(self)
        self.shift = nn.Parameter(torch.full((), level))

    def centre(self, history, observation):
        return torch.zeros_like(history["forecast"]) + self.shift

    def forward(self, noise, history, observation):
        return self.centre(history, observation) + self.noise_share * noise


class Masked(VelocityMLP):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.register_buffer("mask", torch.tensor([0.0, float("-inf")]))


def policy(prior=None, network=None, width=D_O, **options):
    prior = PastPrior(H, sigma=0.125) if prior is None else prior
    torch.manual_seed(0)
    if network is None:
        network = VelocityMLP(D_A, width, prior.prediction_length, TO, hidden_dim=16)
        nn.init.normal_(network.head[1].weight)  # it starts at zero
    data = TensorDict({"observation": torch.randn(50, D_O), "action": torch.randn(50, D_A)}, [50])
    options = {"nfe": 2, "normalizer": Normalizer.fit(data)} | options
    return WarmPriorActor(network, prior, **options)


def saved(folder, *parts, **options):
    actor = policy(*parts, **options)
    save_policy(actor, folder)
    return actor


def chunk(actor, **options):
    """The chunk of one decision that is the same for all."""
    torch.manual_seed(7)
    data = TensorDict({"history": random_history(actor.prior, 4, action_dim=D_A)}, [4])
    width = actor.network.observation_dim
    data[actor.in_keys[0]] = torch.randn(4, TO, width)
    data[keys.DELAY] = torch.full((4, 1), 1)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        return actor.eval()(data, generator=generator, **options)[actor.chunk_key]


def resign(folder, **changes):
    """Give a changed policy the digest of what it is now, as whoever made it could."""
    config = json.loads((folder / "config.json").read_text()) | changes
    config = {k: v for k, v in config.items() if k != "sha256" and v is not ...}
    weights = hashlib.sha256((folder / "model.safetensors").read_bytes()).hexdigest()
    text = json.dumps(config, sort_keys=True)
    config["sha256"] = hashlib.sha256((text + weights).encode()).hexdigest()
    (folder / "config.json").write_text(json.dumps(config))


def change_part(folder, part, **options):
    config = json.loads((folder / "config.json").read_text())
    resign(folder, **{part: config[part] | options})


def change_weights(folder, change):
    tensors = load_file(folder / "model.safetensors")
    save_file(change(tensors), folder / "model.safetensors")
    resign(folder)


TRANSFORMER = {"embedding_dim": 12, "num_layers": 2, "num_heads": 2}
SMALL = VelocityMLP(D_A, D_O, H, TO, hidden_dim=16)


@pytest.mark.parametrize(
    "make",
    [
        lambda: policy(GaussianPrior(H), solver="heun", grid="dense-jump", nfe=4),
        lambda: policy(PastPrior(H, sigma=0.3, correlation=0.5), clip=0.9),
        lambda: policy(PreviewPrior(H), ChiTransformer(D_A, D_O, 2 * H, TO, **TRANSFORMER)),
        lambda: policy(clip=(0.1, 0.2), normalizer=None, observation_key=("state", "low")),
        lambda: policy(max_nfe=1, nfe=1),  # regression
        lambda: policy(GaussianPrior(H), observation_key=keys.CONDITIONED, width=D_O + H * D_A + 1),
        lambda: policy(start=Halfway(0.25), chunk_key="plan"),
        lambda: policy(guidance=RealTimeChunking(2, schedule="ones", jacobian=False, sigma=1.0)),
        lambda: policy(environment={"task": "square"}),
    ],
    ids=range(9),
)
def test_round_trip_is_bit_identical(tmp_path, make):
    actor = make()
    save_policy(actor, tmp_path / "new" / "policy")
    assert actor.training  # saving leaves the mode alone
    again = load_policy(tmp_path / "new" / "policy")
    assert not again.training
    config = policy_config(actor)
    assert policy_config(again) == policy_config(actor.replace()) == config
    assert torch.equal(chunk(again), chunk(actor))
    mine, theirs = actor.state_dict(), again.state_dict()
    assert mine.keys() == theirs.keys()
    assert all(torch.equal(theirs[name], value) for name, value in mine.items())


def test_at_most_as_many_evaluations_as_it_was_trained_for(tmp_path):
    saved(tmp_path, max_nfe=1, nfe=None)
    again = load_policy(tmp_path)
    assert (again.ode.max_nfe, again.ode.nfe) == (1, 1)
    with pytest.raises(ValueError, match=r"at most 1 network evaluation\(s\).*nfe=9"):
        chunk(again, nfe=9)


def test_files_hold_no_pickle(tmp_path):
    saved(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["config.json", "model.safetensors"]
    json.loads((tmp_path / "config.json").read_text())
    load_file(tmp_path / "model.safetensors")


def test_a_user_s_prior_travels(tmp_path):
    class Still(PastPrior):
        name = "still-for-this-test"

    saved(tmp_path, Still(H))
    assert type(load_policy(tmp_path).prior) is Still
    del Prior._classes["still-for-this-test"]
    with pytest.raises(ValueError, match=r"unknown prior 'still-for-this-test'.*import the module"):
        load_policy(tmp_path)


def test_loading_for_another_prior_is_refused(tmp_path):
    saved(tmp_path, PastPrior(H))
    load_policy(tmp_path, prior=PastPrior(H))
    with pytest.raises(ValueError, match=r"trained with PastPrior.*not with GaussianPrior"):
        load_policy(tmp_path, prior=GaussianPrior(H))


@pytest.mark.parametrize("parts", ["all", "network", "normalizer"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16, torch.float16])
def test_weights_of_any_precision_come_back_bit_by_bit(tmp_path, dtype, parts):
    actor = policy()
    (actor if parts == "all" else getattr(actor, parts)).to(dtype)
    with torch.no_grad():  # what no other precision than float64 holds, and bfloat16 rounds
        actor.network.head[1].weight.add_(1 / 3)
    save_policy(actor, tmp_path)
    again = load_policy(tmp_path)
    mine, theirs = actor.state_dict(), again.state_dict()
    others = set() if parts == "all" else {torch.float32}
    assert {value.dtype for value in mine.values()} == {dtype} | others
    assert all(theirs[name].dtype == value.dtype for name, value in mine.items())
    assert all(torch.equal(theirs[name], value) for name, value in mine.items())
    assert torch.equal(chunk(again), chunk(actor))


def test_a_network_compiled_in_place_acts_and_is_saved_as_before(tmp_path):
    actor = policy()
    before, calls = chunk(actor), []
    actor.network.compile(backend=lambda graph, inputs: calls.append(1) or graph.forward)
    torch.testing.assert_close(chunk(actor), before)
    assert calls
    save_policy(actor, tmp_path)
    assert torch.equal(chunk(load_policy(tmp_path)), before)


# ------------------------------------------------------------------------------- what cannot be saved


def test_a_plain_module_cannot_be_saved(tmp_path):
    with pytest.raises(TypeError, match="cannot save Linear: only VelocityNetwork"):
        save_policy(WarmPriorActor(nn.Linear(1, 1), PastPrior(H)), tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_network_that_its_configuration_does_not_build():
    class Forgetful(VelocityMLP):
        def __init__(self, *args, extra=0, **kwargs):
            super().__init__(*args, **kwargs)
            self.extra = nn.Parameter(torch.zeros(extra))

    check_saveable(policy())
    with pytest.raises(ValueError, match=r"saved Forgetful could not be loaded again.*extra"):
        check_saveable(policy(network=Forgetful(D_A, D_O, H, TO, hidden_dim=16, extra=3)))


def test_an_interrupted_save_leaves_the_old_policy(tmp_path, monkeypatch):
    """Overwriting a policy must not leave new weights beside an old configuration."""
    saved(tmp_path)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("warmprior.training.saved.save_file", full)
    with pytest.raises(OSError, match=str(tmp_path)):
        saved(tmp_path, PastPrior(H, sigma=0.7))
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before


# ---------------------------------------------------------------------------- what cannot be loaded


def test_missing_files(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no policy at .*nowhere: config.json is missing"):
        load_policy(tmp_path / "nowhere")
    saved(tmp_path)
    (tmp_path / "model.safetensors").unlink()
    with pytest.raises(FileNotFoundError, match=r"no policy weights at .*model.safetensors"):
        load_policy(tmp_path)


@pytest.mark.parametrize("version", [3, 5, None, "4", ...])
def test_another_format(tmp_path, version):
    saved(tmp_path)
    resign(tmp_path, format=version)
    with pytest.raises(ValueError, match=r"has format .*, this version of warmprior reads 4"):
        load_policy(tmp_path)


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"[1, 2]", b"null", b"[" * 100_000, b'{"format": "\xff"}', b"\x00" * 100],
    ids=range(7),
)
def test_damaged_config(tmp_path, content):
    saved(tmp_path)
    (tmp_path / "config.json").write_bytes(content)
    with pytest.raises(ValueError, match=r"config\.json"):
        load_policy(tmp_path)


@pytest.mark.parametrize(
    "part", ["prior", "start", "network", "actor", "normalizer", "environment", "precision"]
)
def test_config_without_a_part(tmp_path, part):
    saved(tmp_path)
    resign(tmp_path, **{part: ...})
    with pytest.raises(ValueError, match=rf"config\.json is incomplete: it lacks {part}"):
        load_policy(tmp_path)


@pytest.mark.parametrize("keep", [0, 4, 100, -1])
def test_truncated_weights(tmp_path, keep):
    saved(tmp_path)
    path = tmp_path / "model.safetensors"
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(ValueError, match=r"model.safetensors does not fit .*damaged"):
        load_policy(tmp_path)


def test_weights_of_another_network(tmp_path):
    saved(tmp_path / "a")
    saved(tmp_path / "b", network=VelocityMLP(D_A, D_O, H, TO, hidden_dim=16, num_blocks=1))
    weights = (tmp_path / "b" / "model.safetensors").read_bytes()
    (tmp_path / "a" / "model.safetensors").write_bytes(weights)
    with pytest.raises(ValueError, match="belongs to another network"):
        load_policy(tmp_path / "a")
    name = "ode.network.embed_chunk.weight"
    change_weights(tmp_path / "b", lambda t: t | {name: t[name][:, :-1].contiguous()})
    with pytest.raises(ValueError, match=r"(?s)does not fit.*embed_chunk.weight"):
        load_policy(tmp_path / "b")


@pytest.mark.parametrize("dtype", [torch.int8, torch.float64, torch.bfloat16])
def test_weights_of_another_type_are_not_cast(tmp_path, dtype):
    saved(tmp_path)
    change_weights(tmp_path, lambda t: {name: value.to(dtype) for name, value in t.items()})
    with pytest.raises(ValueError, match=rf"model\.safetensors.*{dtype}.*torch\.float32"):
        load_policy(tmp_path)


@pytest.mark.parametrize(
    "precision",
    [{"network": "bfloat16"}, {"network": "int8"}, {"head": "float64"}, "float64", {"network": []}],
    ids=str,
)
def test_a_precision_that_the_weights_do_not_have(tmp_path, precision):
    saved(tmp_path)
    resign(tmp_path, precision=precision)
    with pytest.raises(
        ValueError, match=r"config\.json is damaged|safetensors.*torch\.float32, not"
    ):
        load_policy(tmp_path)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("ode.network.head.1.weight", float("nan")),
        ("ode.network.head.1.weight", float("inf")),
        ("normalizer.observation_loc", float("nan")),
        (ACTION, float("inf")),
        (ACTION, 0.0),
        (ACTION, -1.0),
    ],
)
def test_weights_that_no_training_saves(tmp_path, name, value):
    saved(tmp_path)

    def change(tensors):
        tensors[name].view(-1)[0] = value
        return tensors

    change_weights(tmp_path, change)
    with pytest.raises(ValueError, match=rf"model\.safetensors: {name}"):
        load_policy(tmp_path)


def test_infinite_moments_are_refused_and_an_infinite_mask_is_not(tmp_path):
    saved(tmp_path / "masked", network=Masked(D_A, D_O, H, TO, hidden_dim=16))
    load_policy(tmp_path / "masked")
    saved(tmp_path, network=PreconditionedNetwork(SMALL))
    name = "ode.network.moments.covariance"
    change_weights(tmp_path, lambda t: t | {name: torch.full_like(t[name], float("inf"))})
    with pytest.raises(ValueError, match=rf"model\.safetensors: {name} holds NaN or infinity"):
        load_policy(tmp_path)


@pytest.mark.parametrize("name", ["config.json", "model.safetensors"])
def test_what_was_changed_since_is_noticed(tmp_path, name):
    saved(tmp_path)
    path = tmp_path / name
    if name == "config.json":
        path.write_text(path.read_text().replace('"sigma": 0.125', '"sigma": 0.1'))
    else:
        content = bytearray(path.read_bytes())
        content[-100] ^= 1
        path.write_bytes(content)
    with pytest.raises(ValueError, match=rf"{name} .*changed since"):
        load_policy(tmp_path)
    if name == "config.json":
        resign(tmp_path)
        assert load_policy(tmp_path).prior.sigma == 0.1


@pytest.mark.parametrize(
    "options",
    [
        {"hidden_dim": 20_000},
        {"hidden_dim": 10**10},
        {"num_blocks": 100_000},
        {"prediction_length": 10**6},
        {"timestep_embedding_dim": 2 * 10**9},
        {"num_layers": 100_000},
    ],
    ids=str,
)
def test_a_network_that_the_weights_do_not_fill_is_never_built(tmp_path, options):
    network = ChiTransformer(D_A, D_O, H, **TRANSFORMER) if "num_layers" in options else None
    saved(tmp_path, network=network)
    change_part(tmp_path, "network", **options)
    started, before = time.monotonic(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match=r"model\.safetensors does not fit .*config\.json"):
        load_policy(tmp_path)
    assert time.monotonic() - started < 10
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # KiB


@pytest.mark.parametrize(
    "options",
    [{"nfe": value} for value in (10**9, 2.0, "2", 0)]
    + [{"clip": value} for value in (float("nan"), 0.0, [1.0, float("nan")], [])]
    + [{"chunk_key": value} for value in (3, [1e308, "x"], ["x"], ["prior", {}], [], "", None)],
    ids=str,
)
def test_options_that_no_policy_has(tmp_path, options):
    saved(tmp_path)
    change_part(tmp_path, "actor", **options)
    (name,) = options
    with pytest.raises(ValueError, match=rf"config\.json.*{name}"):
        load_policy(tmp_path)


@pytest.mark.parametrize("name", ["config.json", "model.safetensors"])
def test_only_regular_files_are_opened(tmp_path, name):
    saved(tmp_path)
    (tmp_path / name).unlink()
    os.mkfifo(tmp_path / name)
    errors = []

    def load():
        try:
            load_policy(tmp_path)
        except Exception as error:
            errors.append(error)

    thread = threading.Thread(target=load, daemon=True)
    thread.start()
    thread.join(10)
    assert errors and isinstance(errors[0], ValueError)
    assert f"{name} is not a regular file" in str(errors[0])


def save_in_turn(folder, seconds):
    """Save two policies in turn over each other, in a process of its own."""
    network = VelocityMLP(D_A, D_O, H, hidden_dim=64)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        for sigma in (0.25, 0.75):
            with torch.no_grad():
                for parameter in network.parameters():
                    parameter.fill_(sigma)
            save_policy(WarmPriorActor(network, PastPrior(H, sigma=sigma)), folder)


def test_a_policy_that_is_saved_over_is_the_old_one_or_the_new_one(tmp_path):
    saver = multiprocessing.get_context("fork").Process(target=save_in_turn, args=(tmp_path, 4.0))
    saver.start()
    seen, refused = [], 0
    while saver.is_alive():
        try:
            actor = load_policy(tmp_path)
        except FileNotFoundError:  # of the first save
            continue
        except ValueError:  # between two writes, again and again
            refused += 1
            continue
        values = {float(v) for p in actor.parameters() for v in p.detach().flatten()[:2]}
        assert values == {
            actor.prior.sigma
        }  # never the weights of one and the configuration of the other
        seen.append(actor.prior.sigma)
    saver.join()
    assert set(seen) == {0.25, 0.75} and refused <= len(seen) // 10
