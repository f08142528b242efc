"""Policies at the hub, which a server on the loopback interface plays for the hub's own client."""

import pytest
import torch
from tensordict import TensorDict

from tests.errors import raises, refuses
from tests.io.hub_server import TOKEN, Repository, model_hub
from tests.toy_env import mlp_actor, random_history
from warmprior import Normalizer, PastPrior
from warmprior.saving.policies import load_policy, policy_config, push_policy, save_policy

pytest.importorskip("huggingface_hub")

NAME = "someone/square-past"
FILES = {"config.json", "model.safetensors"}


@pytest.fixture
def hub(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    with model_hub(monkeypatch, tmp_path / "cache") as server:
        monkeypatch.setenv("HF_TOKEN", TOKEN)
        yield server


@pytest.fixture
def actor():
    data = TensorDict({"observation": torch.randn(50, 5), "action": torch.randn(50, 2)}, [50])
    return mlp_actor(PastPrior(3), observation_dim=5, nfe=2, normalizer=Normalizer.fit(data)).eval()


def chunk(actor):
    generator = torch.Generator().manual_seed(1)
    seen = torch.randn(4, 2, 5, generator=generator)
    data = TensorDict({"observation": seen, "history": random_history(actor.prior, 4)}, [4])
    return actor(data, generator=generator)["vla_action", "chunk"]


def put(hub, actor, folder, **change):
    """Lay the files of a policy into a repository, without an upload."""
    save_policy(actor, folder)
    files = {name: (folder / name).read_bytes() for name in FILES} | change
    hub.repositories.setdefault(NAME, Repository(False)).commit("main", files)


def test_a_policy_goes_to_the_hub_and_back(hub, actor):
    commit = push_policy(actor, NAME, card="# Mine\n")
    assert hub.files(NAME)["README.md"] == b"# Mine\n"
    assert set(hub.files(NAME)) == FILES | {"README.md"}
    assert commit == hub.repositories[NAME].branches["main"]
    again = load_policy(NAME)
    assert torch.equal(chunk(again), chunk(actor))
    assert policy_config(again) == policy_config(actor) and not again.training

    # The card is not needed here; what is here is not fetched again, nor the hub needed.
    def fetched():
        return [r for r in hub.requests if r.startswith("GET") and "/resolve/" in r]

    assert {r.rsplit("/", 1)[-1] for r in fetched()} == FILES and len(fetched()) == 2
    load_policy(NAME)
    assert len(fetched()) == 2
    hub.close()
    assert torch.equal(chunk(load_policy(NAME)), chunk(actor))


def test_revisions(hub, actor):
    first = push_policy(actor, NAME, card="first")
    other = mlp_actor(PastPrior(3), observation_dim=5, nfe=2, seed=1).eval()
    push_policy(other, NAME)
    assert hub.files(NAME)["README.md"] == b"first"  # without a card the old one stays
    push_policy(actor, NAME, revision="steady")
    for revision, mine in ((None, other), (first, actor), ("steady", actor)):
        again = load_policy(NAME, revision=revision)
        assert torch.equal(chunk(again), chunk(mine))
    refuses(lambda: load_policy(NAME, revision="v9"), OSError, "v9")


def test_a_folder_is_a_folder(hub, actor, tmp_path):
    put(hub, actor, tmp_path / "kept")
    mine = mlp_actor(PastPrior(3), observation_dim=5, nfe=2, seed=1).eval()
    save_policy(mine, tmp_path / NAME)
    assert torch.equal(chunk(load_policy(NAME)), chunk(mine))
    for name in ("missing", "a/b/c", "../someone", f"{tmp_path}/missing", tmp_path / "missing"):
        with raises(FileNotFoundError, "no policy"):
            load_policy(name)
    refuses(lambda: load_policy(NAME, revision="main"), ValueError, "revision='main'")
    assert not hub.requests


def test_what_is_to_be_private_is_not_published(hub, actor):
    hub.repositories[NAME] = Repository(private=False)
    refuses(lambda: push_policy(actor, NAME, private=True), ValueError, NAME, "public")
    assert not hub.files(NAME) and not hub.objects


def test_something_else_is_refused_before_its_weights_are_fetched(hub, actor, tmp_path):
    put(hub, actor, tmp_path / "kept", **{"config.json": b'{"model_type": "bert"}'})
    refuses(lambda: load_policy(NAME), ValueError, "config.json")
    assert not [r for r in hub.requests if r.endswith("model.safetensors")]
