"""The actor: composition, Algorithm 1 at inference, and its files."""

from __future__ import annotations

import json

import pytest
import torch
from safetensors.torch import load_file, save_file
from tensordict import TensorDict
from torch import nn

from warmprior import (
    ChiTransformer,
    GaussianPrior,
    Normalizer,
    PastPrior,
    PreviewPrior,
    Prior,
    VelocityMLP,
    WarmPriorActor,
)

PRIORS = [GaussianPrior, PastPrior, PreviewPrior]
H, D_A, D_O, TO = 3, 2, 5, 2


def network_for(prior, **options):
    torch.manual_seed(11)
    return VelocityMLP(D_A, D_O, prior.prediction_length, TO, hidden_dim=16, **options)


def batch(prior, *shape):
    length = prior.prediction_length
    return TensorDict(
        {
            "observation": torch.randn(*shape, TO, D_O),
            "prior": {
                "loc": torch.randn(*shape, length, D_A),
                "warm": torch.rand(*shape, length, 1) < 0.5,
            },
        },
        shape,
    )


@pytest.mark.parametrize("nfe", [1, 3, 9])
@pytest.mark.parametrize("prior_class", PRIORS)
def test_inference_of_algorithm_one(prior_class, nfe):
    """A whole episode of decisions against the right column of Algorithm 1, same random numbers."""
    prior = prior_class(H)
    network = network_for(prior)
    actor = WarmPriorActor(network, prior, nfe=nfe, generator=torch.Generator().manual_seed(5))
    generator = torch.Generator().manual_seed(5)
    length = prior.prediction_length
    data = batch(prior, 1)
    data["prior", "loc"] = torch.zeros(1, length, D_A)
    data["prior", "warm"] = torch.zeros(1, length, 1, dtype=torch.bool)
    previous = None
    for _ in range(4):
        o = torch.randn(1, TO, D_O)
        data["observation"] = o
        chunk = actor(data)["vla_action", "chunk"].clone()

        epsilon = torch.randn(1, length, D_A, generator=generator)
        a = epsilon.clone()
        if prior_class is PastPrior and previous is not None:
            a = previous + prior.sigma * epsilon
        if prior_class is PreviewPrior and previous is not None:
            a[:, :H] = previous[:, H:] + prior.sigma * epsilon[:, :H]
        torch.testing.assert_close(data["prior", "noise"], a)
        for i in range(nfe):
            a = a + network(torch.full((1,), i / nfe), a, o) / nfe
        torch.testing.assert_close(chunk, a)

        previous = chunk
        k = torch.full((1, 1), H)
        loc, warm = prior.next_mean(data["prior", "loc"], chunk, k, k)
        data["prior", "loc"], data["prior", "warm"] = loc, warm


@pytest.mark.parametrize("shape", [(), (4,), (2, 3)])
def test_keys_and_shapes(shape):
    prior = PreviewPrior(H)
    actor = WarmPriorActor(network_for(prior), prior, path_key="path", nfe=2)
    out = actor(batch(prior, *shape))
    assert set(actor.in_keys) == {"observation", ("prior", "loc"), ("prior", "warm")}
    assert set(actor.out_keys) == {("prior", "noise"), ("vla_action", "chunk"), "path"}
    assert out["vla_action", "chunk"].shape == (*shape, 2 * H, D_A)
    assert out["path"].shape == (*shape, 3, 2 * H, D_A)


def test_same_generator_same_chunks():
    prior = PastPrior(H)
    data = batch(prior, 4)
    network = network_for(prior)
    results = []
    for seed in (3, 3, 4):
        generator = torch.Generator().manual_seed(seed)
        actor = WarmPriorActor(network, prior, nfe=2, generator=generator)
        results.append(actor(data.clone())["vla_action", "chunk"])
    assert torch.equal(results[0], results[1]) and not torch.equal(results[0], results[2])


def test_nested_observation_key():
    prior = PastPrior(H)
    data = batch(prior, 4)
    data["state", "low"] = data.pop("observation")
    actor = WarmPriorActor(network_for(prior), prior, observation_key=("state", "low"))
    assert actor(data)["vla_action", "chunk"].shape == (4, H, D_A)


def test_any_module_can_be_the_network():
    class Zero(nn.Module):
        def forward(self, t, a, observation):
            return torch.zeros_like(a)

    prior = PastPrior(H)
    out = WarmPriorActor(Zero(), prior)(batch(prior, 4))
    assert torch.equal(out["vla_action", "chunk"], out["prior", "noise"])


def test_network_of_another_length():
    with pytest.raises(ValueError, match=r"prediction_length=3, but PreviewPrior.* needs 6"):
        WarmPriorActor(network_for(PastPrior(H)), PreviewPrior(H))


@pytest.mark.parametrize("missing", ["observation", ("prior", "loc"), ("prior", "warm")])
def test_missing_key(missing):
    prior = PastPrior(H)
    data = batch(prior, 4)
    del data[missing]
    with pytest.raises(KeyError, match=missing[-1] if isinstance(missing, tuple) else missing):
        WarmPriorActor(network_for(prior), prior)(data)


# --- files -----------------------------------------------------------------------------------------


def normalizer():
    data = TensorDict({"observation": torch.randn(50, D_O), "action": torch.randn(50, D_A)}, [50])
    return Normalizer.fit(data)


def saved(directory, prior=None, **options):
    prior = PastPrior(H, sigma=0.125, cold_probability=0.25) if prior is None else prior
    actor = WarmPriorActor(network_for(prior), prior, normalizer=normalizer(), **options)
    actor.save_pretrained(directory)
    return actor


@pytest.mark.parametrize("prior_class", PRIORS)
@pytest.mark.parametrize("kind", ["mlp", "transformer"])
def test_round_trip_is_bit_identical(tmp_path, prior_class, kind):
    prior = prior_class(H, sigma=0.3)
    network = network_for(prior)
    if kind == "transformer":
        network = ChiTransformer(
            D_A, D_O, prior.prediction_length, TO, embedding_dim=12, num_layers=2, num_heads=2
        )
    actor = WarmPriorActor(
        network, prior, nfe=4, solver="heun", clip=0.9, normalizer=normalizer()
    ).eval()
    actor.save_pretrained(tmp_path / "new" / "policy")
    again = WarmPriorActor.from_pretrained(tmp_path / "new" / "policy")
    assert not again.training
    assert again.prior.config() == prior.config()
    assert (again.ode.nfe, again.ode.solver, again.ode.clip) == (4, "heun", 0.9)
    data = batch(prior, 6)
    actor.sampler.generator = torch.Generator().manual_seed(2)
    again.sampler.generator = torch.Generator().manual_seed(2)
    expected = actor(data.clone())["vla_action", "chunk"]
    assert torch.equal(again(data.clone())["vla_action", "chunk"], expected)
    for key in ("observation", "action"):
        assert torch.equal(again.normalizer.loc(key), actor.normalizer.loc(key))
        assert torch.equal(again.normalizer.scale(key), actor.normalizer.scale(key))


def test_a_bound_per_dimension_is_saved(tmp_path):
    prior, bounds = GaussianPrior(H), tuple(0.1 * (i + 1) for i in range(D_A))
    actor = WarmPriorActor(network_for(prior), prior, clip=bounds)
    actor.save_pretrained(tmp_path)
    again = WarmPriorActor.from_pretrained(tmp_path)
    assert again.ode.clip == actor.replace(nfe=1).ode.clip == list(bounds)


def test_no_normalizer_and_nested_key(tmp_path):
    prior = GaussianPrior(H)
    WarmPriorActor(network_for(prior), prior, observation_key=("state", "low")).save_pretrained(
        tmp_path
    )
    again = WarmPriorActor.from_pretrained(tmp_path)
    assert again.normalizer is None
    assert again.in_keys[0] == ("state", "low")


def test_a_user_s_prior_travels(tmp_path):
    class Still(PastPrior):
        name = "still-for-this-test"

    saved(tmp_path, Still(H))
    assert type(WarmPriorActor.from_pretrained(tmp_path).prior) is Still
    del Prior._registry["still-for-this-test"]
    with pytest.raises(ValueError, match=r"unknown prior 'still-for-this-test'.*Import the module"):
        WarmPriorActor.from_pretrained(tmp_path)


def test_files_hold_no_pickle(tmp_path):
    saved(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["config.json", "model.safetensors"]
    json.loads((tmp_path / "config.json").read_text())
    load_file(tmp_path / "model.safetensors")


def test_loading_gives_evaluation_mode_and_saving_does_not_change_the_mode(tmp_path):
    actor = saved(tmp_path).train()
    actor.save_pretrained(tmp_path)
    assert actor.training


def test_plain_module_cannot_be_saved(tmp_path):
    with pytest.raises(TypeError, match="cannot save Linear: only VelocityNetwork"):
        WarmPriorActor(nn.Linear(1, 1), PastPrior(H)).save_pretrained(tmp_path)
    assert not list(tmp_path.iterdir())


def test_missing_folder(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no policy at .*nowhere: config.json is missing"):
        WarmPriorActor.from_pretrained(tmp_path / "nowhere")


def test_missing_weights(tmp_path):
    saved(tmp_path)
    (tmp_path / "model.safetensors").unlink()
    with pytest.raises(FileNotFoundError, match=r"no policy weights at .*model.safetensors"):
        WarmPriorActor.from_pretrained(tmp_path)


def edit(path, **changes):
    config = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({k: v for k, v in config.items() if v is not ...}))


@pytest.mark.parametrize("version", [2, 4, None, "3", ...])
def test_another_format(tmp_path, version):
    saved(tmp_path)
    edit(tmp_path / "config.json", format=version)
    with pytest.raises(ValueError, match=r"has format .*, this version of warmprior reads 3"):
        WarmPriorActor.from_pretrained(tmp_path)


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", "null"])
def test_damaged_config(tmp_path, text):
    saved(tmp_path)
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(ValueError, match=r"config.json"):
        WarmPriorActor.from_pretrained(tmp_path)


@pytest.mark.parametrize("part", ["prior", "network", "actor", "normalizer"])
def test_config_without_a_part(tmp_path, part):
    saved(tmp_path)
    edit(tmp_path / "config.json", **{part: ...})
    with pytest.raises(ValueError, match=rf"config.json.*{part}"):
        WarmPriorActor.from_pretrained(tmp_path)


@pytest.mark.parametrize("keep", [0, 4, 100, -1])
def test_truncated_weights(tmp_path, keep):
    saved(tmp_path)
    path = tmp_path / "model.safetensors"
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(ValueError, match=r"model.safetensors does not fit .*damaged"):
        WarmPriorActor.from_pretrained(tmp_path)


def test_weights_of_another_network(tmp_path):
    saved(tmp_path / "a")
    other = WarmPriorActor(network_for(PastPrior(H), num_blocks=1), PastPrior(H))
    other.save_pretrained(tmp_path / "b")
    weights = (tmp_path / "b" / "model.safetensors").read_bytes()
    (tmp_path / "a" / "model.safetensors").write_bytes(weights)
    with pytest.raises(ValueError, match="belongs to another network"):
        WarmPriorActor.from_pretrained(tmp_path / "a")


def test_weights_of_another_width(tmp_path):
    saved(tmp_path)
    path = tmp_path / "model.safetensors"
    tensors = load_file(path)
    name = next(n for n in tensors if n.endswith("embed_chunk.weight"))
    tensors[name] = tensors[name][:, :-1].contiguous()
    save_file(tensors, path)
    with pytest.raises(ValueError, match=r"(?s)does not fit.*embed_chunk.weight"):
        WarmPriorActor.from_pretrained(tmp_path)


def test_an_interrupted_save_leaves_the_old_policy(tmp_path, monkeypatch):
    """Overwriting a policy must not leave new weights beside an old configuration."""
    saved(tmp_path)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("warmprior.modules.actor.save_file", full)
    with pytest.raises(OSError, match=str(tmp_path)):
        saved(tmp_path, PastPrior(H, sigma=0.7))
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before


def test_loading_for_another_prior_is_refused(tmp_path):
    WarmPriorActor(network_for(PastPrior(H)), PastPrior(H)).save_pretrained(tmp_path)
    WarmPriorActor.from_pretrained(tmp_path, prior=PastPrior(H))
    with pytest.raises(ValueError, match=r"trained with PastPrior.*not with GaussianPrior"):
        WarmPriorActor.from_pretrained(tmp_path, prior=GaussianPrior(H))
