"""What a prior of one's own gets without further work: identity, options, copies, training."""

from __future__ import annotations

import copy
import json
import pickle

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from warmprior import (
    FlowMatchingLoss,
    GaussianPrior,
    PastPrior,
    PreviewPrior,
    Prior,
    PriorDecoder,
    VelocityMLP,
    WarmPriorActor,
    window_replay_buffer,
)
from warmprior.experiments import prior_color, prior_label
from warmprior.training import BehaviourCloning, TrainingConfig

D_A, D_O, H, TO = 2, 3, 4, 2


class Anchor(PastPrior):
    """A source around a fixed multiple of the past, with arguments of its own."""

    name = "anchor-of-the-tests"

    def __init__(self, chunk_length, *, gain, offsets=(0.0,), **options):
        super().__init__(chunk_length, **options)
        self.scale = gain

    def sample(self, loc, warm, generator=None, observation=None):
        return super().sample(self.scale * loc, warm, generator)


class Learned(PastPrior, nn.Module):
    """A source whose shift is trained with the network."""

    name = "learned-of-the-tests"
    label = "Learned"
    color = "#123456"

    def __init__(self, chunk_length, *, action_dim=D_A):
        nn.Module.__init__(self)
        super().__init__(chunk_length)
        self.shift = nn.Parameter(torch.zeros(action_dim))
        self.register_buffer("offset", torch.zeros(()))

    def sample(self, loc, warm, generator=None, observation=None):
        return super().sample(loc + self.shift + self.offset, warm, generator)


class Reversed(GaussianPrior):
    """Pairs the sources of a batch the other way round."""

    name = "reversed-of-the-tests"

    def couple(self, a0, a1, generator=None, observation=None):
        return a0.flip(0), a1


def data(steps=60):
    generator = torch.Generator().manual_seed(0)
    return TensorDict(
        {
            "observation": torch.randn(steps, D_O, generator=generator),
            "action": torch.rand(steps, D_A, generator=generator),
            "episode": torch.arange(steps) // 20,
        },
        [steps],
    )


def actor_for(prior, **options):
    torch.manual_seed(1)
    network = VelocityMLP(D_A, D_O, prior.prediction_length, TO, hidden_dim=8)
    return WarmPriorActor(network, prior, **options)


def test_arguments_of_its_own_are_part_of_its_configuration():
    prior = Anchor(H, gain=0.5, offsets=(1.0, 2.0), sigma=0.3)
    config = json.loads(json.dumps(prior.config()))
    assert config == {
        "name": "anchor-of-the-tests",
        "chunk_length": H,
        "gain": 0.5,
        "offsets": [1.0, 2.0],
        "sigma": 0.3,
    }
    again = Prior.from_config(config)
    assert type(again) is Anchor and again.config() == config and again.scale == 0.5
    assert repr(again) == f"Anchor(chunk_length={H}, gain=0.5, offsets=[1.0, 2.0], sigma=0.3)"


def test_the_same_prior_has_one_configuration():
    assert PastPrior(H).config() == PastPrior(H, sigma=0.5, cold_probability=0).config()


@pytest.mark.parametrize(
    "twin", [copy.copy, copy.deepcopy, lambda p: pickle.loads(pickle.dumps(p))]
)
@pytest.mark.parametrize("prior", [Anchor(H, gain=2.0), Learned(H), PreviewPrior(H, sigma=0.1)])
def test_copies_keep_everything(twin, prior):
    other = twin(prior)
    assert type(other) is type(prior) and other.config() == prior.config()
    loc, warm = torch.ones(3, prior.prediction_length, D_A), torch.ones(3, 1, 1, dtype=torch.bool)
    draws = [p.sample(loc, warm, torch.Generator().manual_seed(2)) for p in (prior, other)]
    assert torch.equal(*draws)


def test_what_cannot_be_saved_is_told_before_anything_is_trained(tmp_path):
    prior = Anchor(H, gain=torch.ones(2))
    with pytest.raises(TypeError, match="Anchor has an argument that cannot be saved"):
        BehaviourCloning(actor_for(prior), data(), TrainingConfig(iterations=20), tmp_path)


def test_a_taken_name_is_refused():
    with pytest.raises(ValueError, match=r"a prior named 'past' exists already .*PastPrior"):

        class Mine(GaussianPrior):
            name = "past"

    assert Prior.find("past") is PastPrior


def test_found_by_name_or_place():
    place = f"{__name__}:Anchor"
    assert Prior.find("anchor-of-the-tests") is Anchor
    assert Prior.find(place) is Anchor
    for wrong in ("nothing", "no.such.module:Anchor", f"{__name__}:Missing", f"{__name__}:data"):
        with pytest.raises(ValueError, match="prior"):
            Prior.find(wrong)
    # A file may name a prior, but never a place to import.
    with pytest.raises(ValueError, match="unknown prior"):
        Prior.from_config({"name": place, "chunk_length": H})


def test_how_it_looks_in_figures():
    assert (prior_label(Learned.name), prior_color(Learned.name)) == ("Learned", "#123456")
    assert prior_label(Anchor.name) == Anchor.name
    assert prior_color(Anchor.name).startswith("#")
    assert (prior_label("of a file"), prior_color("of a file")) == ("of a file", None)


def test_the_coupling_reaches_the_loss():
    prior, generator = Reversed(H), torch.Generator().manual_seed(3)
    actor, batch = actor_for(prior), window_replay_buffer(data(), prior, batch_size=16).sample()
    loss = FlowMatchingLoss(actor, generator=torch.Generator().manual_seed(3))(batch)
    target = batch["vla_action", "chunk"]
    a0 = torch.randn(target.shape, generator=generator).flip(0)
    t = torch.rand(16, generator=generator)
    a_t = a0 + t[:, None, None] * (target - a0)
    error = actor.network(t, a_t, batch["observation"]) - (target - a0)
    expected = error.square()[~batch["action_is_pad"]].mean()
    torch.testing.assert_close(loss["loss_flow_matching"], expected)
    assert GaussianPrior(H).is_gaussian and not prior.is_gaussian


def test_a_learned_prior_trains_saves_resumes_and_freezes(tmp_path):
    def training(folder, iterations=6):
        config = TrainingConfig(iterations=iterations, batch_size=8, checkpoints=1, save_every=3)
        return BehaviourCloning(actor_for(Learned(H)), data(), config, folder, observation_steps=TO)

    whole = training(tmp_path / "whole")
    whole.run(None)
    shift = whole.actor.prior.shift
    assert (shift != 0).all()
    halves = training(tmp_path / "halves")

    def interrupt(iteration):
        if iteration == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        halves.run(None, interrupt)
    resumed = training(tmp_path / "halves")
    resumed.run(None)
    assert torch.equal(resumed.actor.prior.shift, shift)
    path = whole.policy_path(6)
    loaded = WarmPriorActor.from_pretrained(path)
    averaged = loaded.prior.shift
    assert (averaged != 0).all() and not torch.equal(averaged, shift)  # the average of the steps
    decoder = PriorDecoder(loaded, delta=0.5)
    assert not list(decoder.parameters())
    with torch.no_grad():
        averaged.add_(1.0)
    assert not torch.equal(decoder.prior.shift, averaged)


@pytest.mark.parametrize("name", ["two words", "a/b", ""])
def test_a_name_that_no_file_can_have_is_refused(name):
    with pytest.raises(ValueError, match="becomes that of files"):
        type("Unnamed", (PastPrior,), {"name": name})


def test_a_subclass_without_a_name_is_not_taken_for_its_parent(tmp_path):
    class Unnamed(PastPrior):
        pass

    with pytest.raises(TypeError, match="Unnamed has no name of its own: set the class attribute"):
        actor_for(Unnamed(H)).save_pretrained(tmp_path)
    assert not list(tmp_path.iterdir())


def test_arguments_are_recorded_as_given():
    class Halved(PastPrior):
        name = "halved-of-the-tests"

        def __init__(self, chunk_length, *, sigma=1.0):
            super().__init__(chunk_length, sigma=sigma / 2)

    prior = Halved(H, sigma=0.8)
    again = Prior.from_config(prior.config())
    assert prior.sigma == again.sigma == 0.4
    del Prior._registry["halved-of-the-tests"]


def test_what_make_cannot_build_is_told():
    place = f"{__name__}:Anchor"
    with pytest.raises(ValueError, match=r"Anchor cannot be built from chunk_length.*\(.*gain"):
        Prior.make(place, H)
    assert Prior.make(f"{place},gain=0.5,offsets=[1.0]", H).options == "gain=0.5,offsets=[1.0]"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("past,correlation", "name,option=value, got 'correlation'"),
        ("past,=1", "name,option=value"),
        (
            "past,age=3",
            r"PastPrior cannot be built.*age.*it takes chunk_length, sigma",
        ),
        ("past,correlation=2", r"correlation must be in \[0, 1\], got 2"),
        ("regression,correlation=0.5", "RegressionPrior cannot be built"),
        ("nope,age=3", "unknown prior 'nope'"),
        ("cvae,foo=1", r"CVAEPrior cannot be built.*foo=1.*it takes .*latent_dim"),
        ("cvae,correlation=0.5", "CVAEPrior cannot be built.*correlation=0.5"),
        ("past,correlation=abc", "PastPrior cannot be built.*correlation='abc'.*it takes"),
        ("past,correlation=null", "PastPrior cannot be built.*correlation must be"),
        ("past,correlation=true", "PastPrior cannot be built.*correlation must be"),
        ("step,start_time=abc", "StepPrior cannot be built.*start_time='abc'.*it takes"),
        ("ot,observation_weight=abc", "OTPrior cannot be built.*observation_weight='abc'"),
        ("ot,observation_weight=Infinity", "OTPrior cannot be built.*observation_weight must be"),
        ("cvae,beta=abc", "CVAEPrior cannot be built.*beta='abc'.*it takes"),
        ("cvae,latent_dim=2.5", "latent_dim must be a whole number"),
        ("forecast,hidden_dim=0", "hidden_dim must be a whole number"),
        ("reflow,teacher_nfe=2.5", "teacher_nfe must be a whole number"),
        ("past,correlation=0.5,correlation=0.2", "correlation is given twice"),
        ("past,chunk_length=3", "PastPrior cannot be built.*chunk_length"),
        (
            "gaussian,sigma=0.3",
            r"sigma is unknown to it, or without effect\): it takes chunk_length$",
        ),
        ("gaussian,correlation=0.5", r"correlation is unknown to it, or without effect"),
        ("leap,cold_probability=0.3", "cold_probability is unknown to it, or without effect"),
        ("cvae,cold_probability=0.3", "cold_probability is unknown to it, or without effect"),
        ("step,sigma=0.3", "sigma is unknown to it, or without effect"),
        ("step,cold_probability=0.3", "cold_probability is unknown to it, or without effect"),
    ],
)
def test_options_that_do_not_fit(name, message):
    with pytest.raises(ValueError, match=message):
        Prior.make(name, H)


def test_what_is_given_beside_the_name_is_not_given_behind_it():
    with pytest.raises(ValueError, match=r"sigma is given twice: also as 0\.5"):
        Prior.make("past,sigma=0.3", H, sigma=0.5)
    with pytest.raises(ValueError, match="cold_probability is given twice"):
        Prior.make("past,cold_probability=0.3", H, cold_probability=0.5)
    prior = Prior.make("past,sigma=0.3,cold_probability=0.2", H)
    assert (prior.sigma, prior.cold_probability) == (0.3, 0.2)


def test_commas_inside_a_value_stay_there():
    name = f"{Anchor.name},gain=0.5,offsets=[1.0, 2.0],correlation=0.25"
    prior = Prior.make(name, H)
    assert prior.config()["offsets"] == [1.0, 2.0] and prior.correlation == 0.25
    assert Prior.make(f"{prior.name},{prior.options}", H).config() == prior.config()
    # What has no effect is not taken, and so not told.
    assert GaussianPrior(H, correlation=0.5).options == ""


def test_options_are_told_as_they_are_given():
    for text in (
        "past",
        "preview,correlation=0.25",
        "reflow,teacher_nfe=3",
        "step,start_time=0.75",
    ):
        prior = Prior.make(text, H, sigma=0.4)
        name, _, options = text.partition(",")
        assert (prior.name, prior.options) == (name, options)
        assert Prior.make(f"{prior.name},{prior.options}".strip(","), H).options == options
        assert prior.options in prior.describe()
        assert Prior.from_config(prior.config()).options == options


def test_a_training_with_other_buffers_is_another(tmp_path):
    def training(value):
        prior = Learned(H)
        prior.offset.fill_(value)
        config = TrainingConfig(iterations=4, batch_size=8, checkpoints=1, save_every=2)
        return BehaviourCloning(actor_for(prior), data(), config, tmp_path, observation_steps=TO)

    training(1.0).run(None)
    training(1.0).run(None)
    with pytest.raises(ValueError, match="another prior"):
        training(9.0).run(None)


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
def test_a_decoder_has_the_actor_s_precision(dtype):
    actor = actor_for(PastPrior(H), nfe=1)
    decoder = PriorDecoder(actor, delta=0.5)
    batch = TensorDict(
        {
            "observation": torch.randn(2, TO, D_O, dtype=dtype),
            "prior": {
                "anchor": torch.zeros(2, H, D_A, dtype=dtype),
                "delta": torch.zeros(2, H, D_A, dtype=dtype),
            },
        },
        [2],
    )
    assert decoder(batch)["vla_action", "chunk"].dtype == dtype
