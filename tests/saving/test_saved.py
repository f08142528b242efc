import multiprocessing
import os

import pytest
import torch
from safetensors.torch import save_file
from tensordict import TensorDict
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode

from tests.errors import raises, refuses
from tests.states import same
from tests.toy_env import Halfway, random_history
from warmprior import (
    ChiTransformer,
    GaussianPrior,
    Normalizer,
    PastPrior,
    PreconditionedNetwork,
    PreviewPrior,
    RealTimeChunking,
    VelocityMLP,
    WarmPriorActor,
    keys,
)
from warmprior.modules.recording import Recording
from warmprior.saving.policies import FORMAT, load_policy, policy_config, save_policy
from warmprior.saving.training_state import load_state, save_state

H, D_A, D_O, TO = 3, 2, 5, 2
ACTION = "normalizer.action_scale"
MOMENT, WEIGHT = "ode.network.moments.source_variance", "ode.network.network.head.1.weight"


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
    torch.manual_seed(7)
    data = TensorDict({"history": random_history(actor.prior, 4, action_dim=D_A)}, [4])
    data[actor.observation_key] = torch.randn(4, TO, actor.network.observation_dim)
    data[keys.DELAY] = torch.full((4, 1), 1)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        return actor.eval()(data, generator=generator, **options)[keys.CHUNK]


def rewrite(folder, change):
    """Change tensors and configuration of a policy, with the digest of what it is now."""
    tensors, config = load_state(folder / "model.safetensors")
    change(tensors, config)
    save_state(folder / "model.safetensors", tensors, config)
    (folder / "config.json").unlink()


TRANSFORMER = {"hidden_dim": 12, "num_layers": 2, "num_heads": 2}


@pytest.mark.parametrize(
    "make",
    [
        lambda: policy(GaussianPrior(H), solver="heun", grid="dense-jump", nfe=4),
        lambda: policy(PastPrior(H, sigma=0.3, correlation=0.5), clip=0.9),
        lambda: policy(PreviewPrior(H), ChiTransformer(D_A, D_O, 2 * H, TO, **TRANSFORMER)),
        lambda: policy(clip=(0.1, 0.2), normalizer=None, observation_key=("state", "low")),
        lambda: policy(max_nfe=1, nfe=1),  # regression
        lambda: policy(GaussianPrior(H), observation_key=keys.CONDITIONED, width=D_O + H * D_A + 1),
        lambda: policy(start=Halfway(0.25)),
        lambda: policy(guidance=RealTimeChunking(2, schedule="linear", jacobian=False, sigma=1.0)),
        lambda: policy(environment={"task": "square"}),
        lambda: policy(recording=Recording("arm", 2, 9, "[2]", {"joints": D_O}, {}, {}, {"": ["text"]}, 30)),
    ],
    ids=range(10),
)
def test_round_trip_is_bit_identical(tmp_path, make):
    actor = make()
    save_policy(actor, tmp_path / "new" / "policy")
    assert actor.training  # saving leaves the mode alone
    files = sorted(path.name for path in (tmp_path / "new" / "policy").iterdir())
    assert files == ["config.json", "model.safetensors"]  # no pickle, and nothing temporary
    again = load_policy(tmp_path / "new" / "policy")
    assert not again.training
    config = policy_config(actor)
    assert policy_config(again) == policy_config(actor.replace()) == config
    assert torch.equal(chunk(again), chunk(actor))
    assert same(actor.state_dict(), again.state_dict())


def test_a_compiled_policy_is_saved_as_the_policy_inside(tmp_path):
    actor = policy()
    save_policy(torch.compile(actor, backend="eager"), tmp_path)
    assert torch.equal(chunk(load_policy(tmp_path)), chunk(actor))


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
    wide = torch.promote_types(dtype, torch.float32)  # of the normaliser, which is never rounded
    expected = {"all": {dtype, wide}, "network": {dtype, torch.float32}, "normalizer": {torch.float32, wide}}
    assert {value.dtype for value in mine.values()} == expected[parts]
    assert same(mine, theirs) and all(theirs[name].dtype == value.dtype for name, value in mine.items())
    assert torch.equal(chunk(again), chunk(actor))


@pytest.mark.parametrize("where", ["os.replace", "warmprior.saving.training_state.save_file", "os.fsync"])
def test_a_full_disk_leaves_the_old_policy(tmp_path, monkeypatch, where):
    """Overwriting a policy must not leave new weights beside an old configuration."""
    saved(tmp_path)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(where, full)
    refuses(lambda: saved(tmp_path, PastPrior(H, sigma=0.7)), OSError, tmp_path, "No space left")
    monkeypatch.undo()
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before


@pytest.mark.parametrize("damage", [0, 4, 100, -1, "config", "weight", "plain"])
def test_damage_is_noticed(tmp_path, damage):
    saved(tmp_path)
    path = tmp_path / "model.safetensors"
    content = bytearray(path.read_bytes())
    if isinstance(damage, int):
        content = content[:damage]
    elif damage == "config":
        content = content.replace(b"0.125", b"0.126")
    else:
        content[-100] ^= 1
    path.write_bytes(content)
    if damage == "plain":  # of something else
        save_file({"weight": torch.ones(2)}, path)
    refuses(lambda: load_policy(tmp_path), ValueError, "model.safetensors")


@pytest.mark.parametrize(
    ("change", "facts"),
    [
        (lambda t, c: t.pop(ACTION), [ACTION]),
        (lambda t, c: t.update({ACTION: torch.ones(9)}), [ACTION, "(9,)"]),
        (lambda t, c: c["network"].update(name="evil:Net"), ["evil:Net"]),
        (lambda t, c: c["actor"].update(nfe=0), ["nfe", 0]),
        (lambda t, c: c.pop("prior"), ["prior"]),
        (lambda t, c: c["prior"].update(sigma=1e30), ["sigma", "1e+30"]),
        (lambda t, c: c["actor"].update(temperature=1e30), ["temperature", "1e+30"]),
        *(
            (lambda t, c, clip=clip: c["actor"].update(clip=clip), ["clip", 10**30])
            for clip in (10**30, [10**30] * D_A)
        ),
        *(
            (lambda t, c, name=name: c["actor"].update({name: 1}), [f"actor.{name}"])
            for name in ("generator", "spec")
        ),
    ],
)
def test_parts_that_do_not_fit_each_other(tmp_path, change, facts):
    saved(tmp_path)
    rewrite(tmp_path, change)
    refuses(lambda: load_policy(tmp_path), ValueError, tmp_path / "model.safetensors", *facts)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 0.0, -1.0, 1e30, -1e30])
@pytest.mark.parametrize("name", [ACTION, MOMENT, WEIGHT])
def test_a_policy_that_is_loaded_is_finite(tmp_path, name, value):
    saved(tmp_path, network=PreconditionedNetwork(VelocityMLP(D_A, D_O, H, TO, hidden_dim=16)))
    rewrite(tmp_path, lambda tensors, config: tensors[name].view(-1)[-1:].fill_(value))
    if name == WEIGHT and abs(value) <= 1:
        load_policy(tmp_path)
        return
    refuses(lambda: load_policy(tmp_path), ValueError, tmp_path, name)


@pytest.mark.parametrize(
    ("part", "option", "value"),
    [
        ("network", "hidden_dim", 20_000),
        ("network", "hidden_dim", 10**9),
        ("network", "num_blocks", 100_000),
        ("network", "prediction_length", 10**7),
        ("network", "observation_dim", 10**8),
        ("normalizer", "shapes", [["observation", [10**10]], ["action", [2]]]),
    ],
)
def test_nothing_large_is_built_from_options_of_a_file(tmp_path, part, option, value):
    saved(tmp_path)
    rewrite(tmp_path, lambda tensors, config: config[part].update({option: value}))
    with raises(ValueError, tmp_path), Sizes() as sizes:
        load_policy(tmp_path)
    # As many numbers and tensors as an actor of this size takes, with room; 20,000 squared are 4e8.
    assert sizes.most < 2e7 and sizes.count < 10_000


class Sizes(TorchDispatchMode):
    """What is made while it is active."""

    most, count = 0, 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        made = func(*args, **(kwargs or {}))
        if isinstance(made, torch.Tensor):
            self.most, self.count = max(self.most, made.numel()), self.count + 1
        return made


def test_a_copy_of_the_configuration_that_differs_is_reported(tmp_path):
    actor = saved(tmp_path)
    copy = tmp_path / "config.json"
    copy.write_text(copy.read_text().replace("0.125", "0.5"))
    with pytest.warns(UserWarning, match=r"config\.json.* prior .*model\.safetensors"):
        again = load_policy(tmp_path)
    assert again.prior.sigma == actor.prior.sigma == 0.125
    copy.unlink()
    load_policy(tmp_path)


def test_files_that_are_none(tmp_path):
    refuses(lambda: load_policy(tmp_path / "nowhere"), FileNotFoundError, "nowhere", "model.safetensors")
    for version in (FORMAT - 1, None, str(FORMAT)):
        saved(tmp_path)
        rewrite(tmp_path, lambda tensors, config, version=version: config.update(format=version))
        refuses(lambda: load_policy(tmp_path), ValueError, "format", FORMAT)
    (tmp_path / "model.safetensors").unlink()
    os.mkfifo(tmp_path / "model.safetensors")
    refuses(lambda: load_policy(tmp_path), ValueError, "regular file")


def _save_in_a_loop(folder, started):
    policies = [policy(PastPrior(H, sigma=sigma)) for sigma in (0.25, 0.5)]
    for actor in policies:
        nn.init.constant_(actor.network.head[1].weight, actor.prior.sigma)
    while True:
        for actor in policies:
            save_policy(actor, folder)
        started.set()


@pytest.mark.filterwarnings("ignore:.*config.json differs")  # a save writes it last
def test_a_policy_that_is_saved_over_is_the_old_one_or_the_new_one(tmp_path):
    context = multiprocessing.get_context("fork")
    started = context.Event()
    writer = context.Process(target=_save_in_a_loop, args=(tmp_path, started), daemon=True)
    writer.start()
    assert started.wait(60)
    seen = set()
    try:
        for _ in range(100):
            actor = load_policy(tmp_path)
            seen.add(actor.prior.sigma)
            assert (actor.network.head[1].weight == actor.prior.sigma).all()
    finally:
        writer.kill()
        writer.join()
    assert seen == {0.25, 0.5}


@pytest.mark.parametrize(
    ("entry", "value"),
    [("rate", "fast"), ("rate", -1), ("observations", {"joints": 0.5}), ("names", {"a": 3}), ("left_out", 7)],
)
def test_what_it_was_trained_on_has_the_form_that_is_printed(tmp_path, entry, value):
    saved(tmp_path, recording=Recording("arm", 2, 9, "[2]", {"joints": D_O}))
    rewrite(tmp_path, lambda tensors, config: config["recording"].update({entry: value}))
    refuses(lambda: load_policy(tmp_path), ValueError, tmp_path)
