"""Training states that were damaged or lost their policies, and networks of users' own."""

from __future__ import annotations

import shutil

import pytest
import torch
from torch import nn

from tests.training.cloning_parts import CONFIG, actor_for, run_until, same, training, weights
from warmprior import PastPrior, VelocityMLP
from warmprior.training import load_policy


def test_a_lost_policy_is_rebuilt_and_not_trained_again(tmp_path):
    training(tmp_path).run()
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
    with pytest.raises(ValueError, match=r"state\.safetensors is not a readable training state"):
        training(tmp_path)


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


def grown():
    """A network with a part that its constructor does not build."""
    network = VelocityMLP(2, 3, 4, hidden_dim=8)
    network.extra = nn.Linear(1, 1)
    return network


def _actor(network):
    return actor_for(PastPrior(4), network)


@pytest.mark.parametrize(
    ("network", "error", "said"),
    [
        (Plain, TypeError, "cannot save Plain: only subclasses of VelocityNetwork"),
        (grown, ValueError, "could not be loaded again"),
    ],
)
def test_what_cannot_be_saved_is_refused_before_training(tmp_path, network, error, said):
    with pytest.raises(error, match=said):
        training(tmp_path / "run", actor=_actor(network()))


def _compiled():
    return torch.compile(VelocityMLP(2, 3, 4, hidden_dim=8), backend="eager")


@pytest.mark.parametrize(
    "network", [lambda: Tied(2, 3, 4, hidden_dim=8), _compiled], ids=["tied", "compiled"]
)
def test_users_networks_are_saved_resumed_and_loaded(tmp_path, network):
    def build():
        torch.manual_seed(5)
        return _actor(network())

    whole = training(tmp_path / "whole", actor=build())
    whole.run()
    part = training(tmp_path / "part", actor=build())
    run_until(part, 25)
    again = training(tmp_path / "part", actor=build())
    assert again.iteration == 21
    again.run()
    assert same(weights(again), weights(whole))
    policy = load_policy(whole.policy_path(CONFIG.iterations))
    assert not any("_orig_mod" in name for name in policy.state_dict())
    expected = [value for value in whole.update.ema.module.state_dict().values()]
    for one, two in zip(policy.network.state_dict().values(), expected, strict=True):
        assert torch.equal(one, two)
