"""Saved policies that were damaged, swapped or made to take what they do not hold."""

from __future__ import annotations

import hashlib
import json
import os
import resource
import threading
import time

import pytest
import torch
from safetensors.torch import load_file, save_file
from tensordict import TensorDict

from warmprior import (
    ChiTransformer,
    Normalizer,
    PastPrior,
    PreconditionedNetwork,
    VelocityMLP,
    WarmPriorActor,
)

ACTION = "normalizer.action_scale"


def saved(folder, network=None):
    prior = PastPrior(3)
    torch.manual_seed(0)
    network = VelocityMLP(2, 5, 3, 2, hidden_dim=16) if network is None else network
    data = TensorDict({"observation": torch.randn(50, 5), "action": torch.randn(50, 2)}, [50])
    actor = WarmPriorActor(network, prior, nfe=2, normalizer=Normalizer.fit(data))
    actor.save_pretrained(folder)
    return actor


class Masked(VelocityMLP):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.register_buffer("mask", torch.tensor([0.0, float("-inf")]))


def resign(folder):
    """Give a changed policy the digest of what it is now, as whoever made it could."""
    config = json.loads((folder / "config.json").read_text())
    config.pop("sha256", None)
    text = json.dumps(config, sort_keys=True)
    weights = hashlib.sha256((folder / "model.safetensors").read_bytes()).hexdigest()
    config["sha256"] = hashlib.sha256((text + weights).encode()).hexdigest()
    (folder / "config.json").write_text(json.dumps(config))


def change_weights(folder, change):
    tensors = load_file(folder / "model.safetensors")
    save_file(change(tensors), folder / "model.safetensors")
    resign(folder)


def change_config(folder, part, **options):
    config = json.loads((folder / "config.json").read_text())
    config[part] |= options
    (folder / "config.json").write_text(json.dumps(config))
    resign(folder)


def test_a_signed_policy_loads(tmp_path):
    actor = saved(tmp_path)
    resign(tmp_path)
    again = WarmPriorActor.from_pretrained(tmp_path).state_dict()
    assert all(torch.equal(again[name], value) for name, value in actor.state_dict().items())


@pytest.mark.parametrize("dtype", [torch.int8, torch.float64, torch.bfloat16])
def test_weights_of_another_type_are_not_cast(tmp_path, dtype):
    saved(tmp_path)
    change_weights(tmp_path, lambda t: {name: value.to(dtype) for name, value in t.items()})
    with pytest.raises(ValueError, match=rf"model\.safetensors.*{dtype}.*torch\.float32"):
        WarmPriorActor.from_pretrained(tmp_path)


@pytest.mark.parametrize("parts", ["all", "network", "normalizer"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16, torch.float16])
def test_weights_of_any_precision_come_back_bit_by_bit(tmp_path, dtype, parts):
    actor = saved(tmp_path).eval()
    (actor if parts == "all" else getattr(actor, parts)).to(dtype)
    with torch.no_grad():  # what no other precision than float64 holds, and bfloat16 rounds
        actor.network.head[1].weight.add_(1 / 3)
    actor.save_pretrained(tmp_path)
    again = WarmPriorActor.from_pretrained(tmp_path)
    mine, theirs = actor.state_dict(), again.state_dict()
    assert {value.dtype for value in mine.values()} == {dtype} | (
        set() if parts == "all" else {torch.float32}
    )
    assert all(theirs[name].dtype == value.dtype for name, value in mine.items())
    assert all(torch.equal(theirs[name], value) for name, value in mine.items())
    data = TensorDict(
        {
            "observation": torch.randn(4, 2, 5),
            "prior": {"loc": torch.randn(4, 3, 2), "warm": torch.rand(4, 3, 1) < 0.5},
        },
        [4],
    )
    chunks = [
        a(data.clone(), generator=torch.Generator().manual_seed(1))["vla_action", "chunk"]
        for a in (actor, again)
    ]
    assert torch.equal(*chunks)


@pytest.mark.parametrize(
    "precision",
    [{"network": "bfloat16"}, {"network": "int8"}, {"head": "float64"}, "float64", {"network": []}],
    ids=str,
)
def test_a_precision_that_the_weights_do_not_have(tmp_path, precision):
    saved(tmp_path)
    config = json.loads((tmp_path / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps(config | {"precision": precision}))
    resign(tmp_path)
    with pytest.raises(
        ValueError, match=r"config\.json is damaged|safetensors.*torch\.float32, not"
    ):
        WarmPriorActor.from_pretrained(tmp_path)


def test_a_policy_saved_before_its_precision_was_told_loads(tmp_path):
    actor = saved(tmp_path)
    config = json.loads((tmp_path / "config.json").read_text())
    del config["precision"]
    (tmp_path / "config.json").write_text(json.dumps(config))
    resign(tmp_path)
    again = WarmPriorActor.from_pretrained(tmp_path).state_dict()
    assert all(torch.equal(again[name], value) for name, value in actor.state_dict().items())


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
        WarmPriorActor.from_pretrained(tmp_path)


def test_infinite_moments_are_refused_and_an_infinite_mask_is_not(tmp_path):
    saved(tmp_path / "masked", Masked(2, 5, 3, 2, hidden_dim=16))
    WarmPriorActor.from_pretrained(tmp_path / "masked")
    saved(tmp_path, PreconditionedNetwork(VelocityMLP(2, 5, 3, 2, hidden_dim=16)))
    name = "ode.network.moments.covariance"
    change_weights(tmp_path, lambda t: t | {name: torch.full_like(t[name], float("inf"))})
    with pytest.raises(ValueError, match=rf"model\.safetensors: {name} holds NaN or infinity"):
        WarmPriorActor.from_pretrained(tmp_path)


def test_a_flipped_bit_of_the_weights_is_noticed(tmp_path):
    saved(tmp_path)
    path = tmp_path / "model.safetensors"
    content = bytearray(path.read_bytes())
    content[-100] ^= 1
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"model\.safetensors .*changed since"):
        WarmPriorActor.from_pretrained(tmp_path)


def test_a_changed_configuration_is_noticed(tmp_path):
    saved(tmp_path)
    path = tmp_path / "config.json"
    path.write_text(path.read_text().replace('"sigma": 0.5', '"sigma": 0.1'))
    with pytest.raises(ValueError, match=r"config\.json .*changed since"):
        WarmPriorActor.from_pretrained(tmp_path)


def test_a_policy_saved_before_there_was_a_digest_loads(tmp_path):
    saved(tmp_path)
    config = json.loads((tmp_path / "config.json").read_text())
    del config["sha256"]
    (tmp_path / "config.json").write_text(json.dumps(config))
    WarmPriorActor.from_pretrained(tmp_path)


@pytest.mark.parametrize(
    "options",
    [
        {"hidden_dim": 20_000},
        {"hidden_dim": 10**10},
        {"num_blocks": 100_000},
        {"prediction_length": 10**6},
        {"timestep_embedding_dim": 2 * 10**9},
    ],
    ids=str,
)
def test_a_network_that_the_weights_do_not_fill_is_never_built(tmp_path, options):
    saved(tmp_path)
    change_config(tmp_path, "network", **options)
    started, before = time.monotonic(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match=r"model\.safetensors does not fit .*config\.json"):
        WarmPriorActor.from_pretrained(tmp_path)
    assert time.monotonic() - started < 10
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # KiB


def test_a_transformer_of_too_many_layers_is_never_built(tmp_path):
    small = {"embedding_dim": 8, "num_layers": 1, "num_heads": 2}
    saved(tmp_path, ChiTransformer(2, 5, 3, **small))
    change_config(tmp_path, "network", num_layers=100_000)
    started = time.monotonic()
    with pytest.raises(ValueError, match=r"model\.safetensors does not fit .*config\.json"):
        WarmPriorActor.from_pretrained(tmp_path)
    assert time.monotonic() - started < 10


@pytest.mark.parametrize("nfe", [10**9, 2.0, "2", 0])
def test_evaluations_that_nobody_can_wait_for(tmp_path, nfe):
    saved(tmp_path)
    change_config(tmp_path, "actor", nfe=nfe)
    with pytest.raises(ValueError, match=r"config\.json.*nfe"):
        WarmPriorActor.from_pretrained(tmp_path)
    with pytest.raises(ValueError, match="nfe"):
        WarmPriorActor(VelocityMLP(2, 5, 3, 2, hidden_dim=16), PastPrior(3), nfe=10**9)


@pytest.mark.parametrize("clip", [float("nan"), 0.0, [1.0, float("nan")], []])
def test_a_bound_that_is_none(tmp_path, clip):
    saved(tmp_path)
    change_config(tmp_path, "actor", clip=clip)
    with pytest.raises(ValueError, match=r"config\.json.*clip"):
        WarmPriorActor.from_pretrained(tmp_path)


@pytest.mark.parametrize("name", ["config.json", "model.safetensors"])
def test_only_regular_files_are_opened(tmp_path, name):
    saved(tmp_path)
    (tmp_path / name).unlink()
    os.mkfifo(tmp_path / name)
    errors = []

    def load():
        try:
            WarmPriorActor.from_pretrained(tmp_path)
        except Exception as error:
            errors.append(error)

    thread = threading.Thread(target=load, daemon=True)
    thread.start()
    thread.join(10)
    assert errors and isinstance(errors[0], ValueError)
    assert f"{name} is not a regular file" in str(errors[0])


@pytest.mark.parametrize(
    "content", [b"[" * 100_000, b'{"format": "\xff"}', b"\x00" * 100], ids=range(3)
)
def test_a_configuration_that_is_no_text(tmp_path, content):
    saved(tmp_path)
    (tmp_path / "config.json").write_bytes(content)
    with pytest.raises(ValueError, match=r"config\.json is not valid JSON"):
        WarmPriorActor.from_pretrained(tmp_path)


@pytest.mark.parametrize("key", [3, [1e308, "warm"], ["warm"], ["prior", {}], [], "", None])
def test_a_key_that_is_none(tmp_path, key):
    saved(tmp_path)
    change_config(tmp_path, "actor", warm_key=key)
    with pytest.raises(ValueError, match=r"config\.json .*warm_key must be a key"):
        WarmPriorActor.from_pretrained(tmp_path)


def test_a_network_compiled_in_place_acts_and_is_saved_as_before(tmp_path):
    torch.manual_seed(0)
    actor = WarmPriorActor(VelocityMLP(2, 3, 4, hidden_dim=8), PastPrior(4)).eval()
    mean = {"loc": torch.randn(1, 4, 2), "warm": torch.ones(1, 4, 1, dtype=torch.bool)}
    data = TensorDict({"observation": torch.randn(1, 2, 3), "prior": mean}, [1])

    def chunk(policy):
        generator = torch.Generator().manual_seed(1)
        return policy(data.clone(), nfe=3, generator=generator)["vla_action", "chunk"]

    with torch.no_grad():
        before = chunk(actor)
        calls = []
        actor.network.compile(backend=lambda graph, inputs: calls.append(1) or graph.forward)
        torch.testing.assert_close(chunk(actor), before)
    assert calls
    actor.save_pretrained(tmp_path)
    assert torch.equal(chunk(WarmPriorActor.from_pretrained(tmp_path)).detach(), before)
