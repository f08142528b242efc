import json
from functools import partial

import pytest
import torch

from tests.errors import raises, refuses
from tests.toy_env import Learned, demonstrations, mlp_actor, random_history
from warmprior import GaussianPrior, PastPrior, Prior, PriorDecoder
from warmprior.modules.registry import from_config
from warmprior.saving.policies import load_policy
from warmprior.training import BehaviourCloning, TrainingConfig
from warmprior.training.option_text import find, make, options_of

D_A, H, TO = 2, 4, 2
actor_for = partial(mlp_actor, observation_dim=3)


class Anchor(PastPrior):
    """A source around a fixed multiple of the past, with arguments of its own."""

    name = "anchor-of-the-tests"

    def __init__(self, chunk_length, *, gain, offsets=(0.0,), **options):
        super().__init__(chunk_length, **options)
        self.gain, self.offsets = gain, list(offsets)

    def mean(self, history):
        loc, warm = super().mean(history)
        return self.gain * loc, warm


def test_arguments_of_its_own_are_part_of_its_configuration():
    prior = Anchor(H, gain=0.5, offsets=(1.0, 2.0), sigma=0.3)
    config = json.loads(json.dumps(prior.config()))
    options = {"chunk_length": H, "gain": 0.5, "offsets": [1.0, 2.0], "sigma": 0.3, "correlation": 0.0}
    assert config == {"name": "anchor-of-the-tests", **options}
    again = from_config(Prior, config)
    assert type(again) is Anchor and again.config() == config and again.gain == 0.5
    assert repr(again) == f"Anchor({', '.join(f'{name}={value}' for name, value in options.items())})"


def test_the_same_prior_has_one_configuration():
    assert PastPrior(H).config() == PastPrior(H, sigma=0.5, correlation=0).config()
    assert json.dumps(PastPrior(H, sigma=1).config()) == json.dumps(PastPrior(H, sigma=1.0).config())


def test_what_cannot_be_saved_is_told_before_anything_is_trained(tmp_path):
    """Or what another object would be built from."""

    class Half(PastPrior):
        name = "half-of-the-tests"

        def __init__(self, chunk_length, sigma=0.5):
            super().__init__(chunk_length, sigma=0.5 * sigma)

    class Default(PastPrior):
        name = "default-of-the-tests"
        horizon = 4  # of the class, and not of the object

        def __init__(self, chunk_length, horizon=8):
            super().__init__(chunk_length)

    recipe = TrainingConfig(iterations=2)
    try:
        for prior, error, fact in (
            *((Half(H), ValueError, "sigma"), (Default(H), TypeError, "horizon")),
            (Anchor(H, gain=torch.ones(2)), TypeError, "Anchor"),
        ):
            with raises(error, fact):
                BehaviourCloning(actor_for(prior), demonstrations(), recipe, tmp_path)
        assert not list(tmp_path.iterdir())
        assert repr(Default(H)) == "Default(...)"
    finally:
        del Prior.classes["half-of-the-tests"], Prior.classes["default-of-the-tests"]


def test_names_that_cannot_be():
    for name, facts in (("past", ("'past'", "PastPrior")), *((n, ()) for n in ("two words", "a/b", ""))):
        with raises(ValueError, *(facts or ["file names"])):
            type("Unnamed", (GaussianPrior,), {"name": name})
    assert find(Prior, "past") is PastPrior


def test_found_by_name_or_place():
    place = f"{__name__}:Anchor"
    assert find(Prior, "anchor-of-the-tests") is find(Prior, place) is Anchor
    nowhere = ("nothing", "no.such.module:Anchor", f"{__name__}:Missing", f"{__name__}:actor_for")
    for wrong in (*nowhere, "Prior", "warmprior.modules.prior:Prior"):
        with raises(ValueError, "prior"):
            find(Prior, wrong)
    # A file may name a prior, but never a place to import.
    refuses(lambda: from_config(Prior, {"name": place, "chunk_length": H}), ValueError, "unknown prior")


def test_a_learned_prior_trains_saves_resumes_and_freezes(tmp_path):
    def training(folder, iterations=6):
        config = TrainingConfig(iterations=iterations, batch_size=8, checkpoints=1, save_every=3)
        return BehaviourCloning(actor_for(Learned(H)), demonstrations(), config, folder)

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
    loaded = load_policy(whole.policy_path(6))
    averaged = loaded.prior.shift
    assert (averaged != 0).all() and not torch.equal(averaged, shift)  # the average of the steps
    decoder = PriorDecoder(loaded, delta=0.5)
    assert not any(p.requires_grad for p in decoder.parameters())
    with torch.no_grad():
        averaged.add_(1.0)
    assert not torch.equal(decoder.prior.shift, averaged)


class Forgetful(PastPrior):
    name = "forgetful-of-the-tests"

    def __init__(self, chunk_length, *, gain=1.0):
        super().__init__(chunk_length)
        self.g = gain


def test_options_that_do_not_fit():
    for text, *facts in (
        *(("past,correlation", "'correlation'"), ("past,correlation=2", "correlation", 2)),
        ("past,age=3", "PastPrior", "age=3", "chunk_length, sigma, correlation"),
        ("past,correlation=abc", "PastPrior", "correlation='abc'"),
        ("past,correlation=0.5,correlation=0.2", "correlation", "twice"),
        *(("nope,age=3", "'nope'"), (f"{__name__}:Anchor", "Anchor", "gain")),
        (f"{__name__}:Forgetful,gain=0.5", "Forgetful", "'gain'"),  # it could not be saved
    ):
        with raises(ValueError, *facts):
            make(Prior, text, H)


def test_options_behind_a_name():
    prior = make(Prior, "past,sigma=0.3,correlation=0.2", H)
    assert (prior.sigma, prior.correlation) == (0.3, 0.2)
    assert make(Prior, "past", H).sigma == 0.5
    # Commas inside a value stay there.
    text = f"{__name__}:Anchor,gain=0.5,offsets=[1.0, 2.0],correlation=0.25"
    assert options_of(text) == {"gain": 0.5, "offsets": [1.0, 2.0], "correlation": 0.25}
    prior = make(Prior, text, H)
    assert prior.config()["offsets"] == [1.0, 2.0] and prior.correlation == 0.25


class Careless(PastPrior):
    """A source whose mean is written into the history that it reads."""

    name = "careless-of-the-tests"

    def mean(self, history):
        history["actions"] += 1.0
        history["steps"] = torch.full_like(history["steps"], self.chunk_length)
        return super().mean(history)


def test_a_mean_that_writes_into_what_it_reads_changes_no_history():
    history = random_history(PastPrior(H), 5)
    before = history.clone()
    loc = Careless(H).distribution(history).loc
    assert (history == before).all()
    assert torch.equal(loc, before["actions"] + 1.0)
