"""What a source, a start point and a coupling must not hide: each was accepted without a word once."""

import pytest
import torch
from torch import nn

from lab.methods.methods import Method
from tests.errors import raises, refuses
from tests.toy_env import Halfway, demonstrations
from warmprior import (
    FlowMatchingLoss,
    GaussianPrior,
    PastPrior,
    ReflowCoupling,
    Source,
    VelocityMLP,
    WarmPriorActor,
    WithheldHistory,
    window_replay_buffer,
)
from warmprior.modules.prior import Prior
from warmprior.modules.registry import Registered
from warmprior.rl import has_anchor
from warmprior.training import BehaviourCloning, TrainingConfig

H, D_A, D_O = 4, 2, 3


class OwnSource(Prior, nn.Module):
    name = "tests.own-source"

    def __init__(self, chunk_length: int) -> None:
        nn.Module.__init__(self)
        super().__init__(chunk_length)

    def distribution(self, history, observation=None):
        loc = torch.ones_like(history["forecast"])
        return Source(loc, 0.1 * loc, torch.ones_like(loc[..., :1], dtype=torch.bool))


def network():
    return VelocityMLP(D_A, D_O, H, observation_steps=1, hidden_dim=8)


def frozen(shift=0.0):
    start = Halfway().requires_grad_(False)
    start.shift.fill_(shift)
    return start


@pytest.fixture
def data():
    return demonstrations(40)


def cloning(folder, data, start=None, **options):
    actor = WarmPriorActor(network(), GaussianPrior(H), start=start)
    config = TrainingConfig(iterations=4, batch_size=8, checkpoints=1, save_every=2)
    return BehaviourCloning(actor, data, config, folder, **options)


def test_agents_search_around_a_source_that_has_no_mean_of_the_history():
    actor = WarmPriorActor(network(), OwnSource(H))
    assert has_anchor(actor) and Method(f"{__name__}:OwnSource", H).remembers


def test_a_start_point_is_fixed_and_belongs_to_the_training(tmp_path, data):
    refuses(lambda: cloning(tmp_path / "free", data, start=Halfway()), ValueError, "Halfway")
    training = cloning(tmp_path / "one", data, start=frozen())
    training.step()
    training._save()
    refuses(lambda: cloning(tmp_path / "one", data, start=frozen(1.0)), ValueError, "start")
    assert cloning(tmp_path / "one", data, start=frozen()).iteration == 1


def test_a_resumed_reflow_has_the_teacher_that_it_began_with(tmp_path, data):
    teachers = [WarmPriorActor(network(), GaussianPrior(H)) for _ in range(2)]
    training = cloning(tmp_path, data, coupling=ReflowCoupling(teachers[0], nfe=1))
    training.step()
    training._save()
    with raises(ValueError, "coupling"):
        cloning(tmp_path, data, coupling=ReflowCoupling(teachers[1], nfe=1))


def test_regression_and_a_start_on_the_way_do_not_go_together():
    actor = WarmPriorActor(network(), GaussianPrior(H), start=frozen(), max_nfe=1)
    refuses(lambda: FlowMatchingLoss(actor, times="start"), ValueError, "t = 0", "Halfway")


def test_nothing_is_withheld_behind_the_back_of_a_network_that_has_seen_it(data):
    buffer = window_replay_buffer(data, PastPrior(H), batch_size=8, observation_steps=1, see_history=True)
    buffer.append_transform(WithheldHistory(1.0))
    refuses(lambda: buffer.sample(), ValueError, "WithheldHistory", "HistoryObservation")


def test_an_argument_called_name_is_refused():
    class Thing(Registered): ...

    class Named(Thing):
        def __init__(self, name): ...

    class Forgetful(Thing):
        def __init__(self, radius): ...

    for thing, argument in ((Named("x"), "name"), (Forgetful(1.0), "radius")):
        with raises(TypeError, argument):
            thing.config()
