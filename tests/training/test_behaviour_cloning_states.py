import shutil

import pytest
import torch
from torch import nn

from tests.errors import raises, refuses
from tests.states import same
from tests.training.cloning_parts import CONFIG, actor_for, finished, run_until, training, weights
from warmprior import PastPrior, VelocityMLP, WarmPriorActor
from warmprior.saving import load_policy
from warmprior.saving.training_state import load_state, save_state


def test_a_lost_policy_is_rebuilt_and_not_trained_again(tmp_path):
    finished(tmp_path)
    policy = tmp_path / "policy_000040"
    before = {path.name: path.read_bytes() for path in policy.iterdir()}
    for lose in (shutil.rmtree, lambda policy: (policy / "model.safetensors").write_bytes(b"")):
        lose(policy)
        again = training(tmp_path)
        again.step = lambda: pytest.fail("trains again")
        again.run()
        assert {path.name: path.read_bytes() for path in policy.iterdir()} == before
    path = tmp_path / "state.safetensors"
    content = bytearray(path.read_bytes())
    content[-40_000] ^= 4
    path.write_bytes(content)
    refuses(lambda: training(tmp_path), ValueError, "state.safetensors")


def test_a_finished_policy_gets_the_sampling_that_is_asked_for(tmp_path):
    first = finished(tmp_path)
    kept = load_policy(first.policy_path())
    again = training(tmp_path, actor=actor_for().replace(nfe=8, temperature=0.5, solver="heun"))
    again.step = lambda: pytest.fail("trains again")
    again.run(None)
    policy = load_policy(again.policy_path())
    assert policy.sampling == again.actor.sampling != kept.sampling
    assert same(policy.state_dict(), kept.state_dict())


def test_a_state_of_another_kind_of_device_is_not_called_damaged(tmp_path):
    state = finished(tmp_path).state_path
    tensors, facts = load_state(state)
    facts["identity"]["device"] = "cuda"
    save_state(state, tensors, facts)
    refuses(lambda: training(tmp_path), ValueError, "device was cuda and is cpu")


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


def grown():
    """A network with a part that its constructor does not build."""
    network = VelocityMLP(2, 3, 4, hidden_dim=8)
    network.extra = nn.Linear(1, 1)
    return network


class Halved(WarmPriorActor):
    def forward(self, tensordict):
        return super().forward(tensordict).apply(lambda value: value / 2)


def test_what_cannot_be_saved_is_refused_before_training(tmp_path):
    halved = Halved(VelocityMLP(2, 3, 4, hidden_dim=8), PastPrior(4))
    refused = {"Plain": actor_for(network=Plain()), "extra": actor_for(network=grown()), "Halved": halved}
    for fact, actor in refused.items():
        with raises(ValueError if fact == "extra" else TypeError, fact):
            training(tmp_path / "run", actor=actor)


NETWORKS = {
    "tied": lambda: Tied(2, 3, 4, hidden_dim=8),
    "compiled": lambda: torch.compile(VelocityMLP(2, 3, 4, hidden_dim=8), backend="eager"),
}


@pytest.mark.parametrize("network", NETWORKS.values(), ids=NETWORKS)
def test_users_networks_are_saved_resumed_and_loaded(tmp_path, network):
    def build():
        torch.manual_seed(5)
        return actor_for(network=network())

    whole = finished(tmp_path / "whole", actor=build())
    run_until(training(tmp_path / "part", actor=build()), 25)
    again = training(tmp_path / "part", actor=build())
    assert again.iteration == 21
    again.run()
    assert same(weights(again), weights(whole))
    policy = load_policy(whole.policy_path(CONFIG.iterations))
    assert not any("_orig_mod" in name for name in policy.state_dict())
    averaged = whole.update.ema.module.state_dict().values()
    pairs = zip(policy.network.state_dict().values(), averaged, strict=True)
    assert all(torch.equal(*pair) for pair in pairs)
