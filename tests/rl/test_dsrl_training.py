"""DSRL-NA in a training: what must not change, what must agree, and what must not go unnoticed."""

from __future__ import annotations

import pytest
import torch
from tensordict.nn import TensorDictSequential
from torchrl.modules import ProbabilisticActor, TanhNormal

from tests.rl.dsrl_parts import D_A, D_O, TO, H, batch, build, make_decoder
from warmprior import DSRLNALoss, PastPrior, keys, make_prior_space_actor, make_prior_space_critic


@pytest.mark.parametrize(
    "missing",
    [
        "observation",
        ("prior", "anchor"),
        ("vla_action", "chunk"),
        ("next", "prior", "anchor"),
        ("next", "executed_steps"),
    ],
)
def test_buffer_of_another_wiring(missing):
    data = batch()
    del data[missing]
    with pytest.raises(KeyError, match=r"missing: .*set_keys\(chunk") as error:
        build()(data)
    assert f"missing: [{missing!r}]" in error.value.args[0]


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_divergence_is_named(value):
    data = batch()
    data["next", "reward"][0] = value
    diverged = r"^NaN or infinity in %s: the training has diverged"
    with pytest.raises(FloatingPointError, match=diverged % "loss_qvalue"):
        build()(data)
    loss = build()
    with torch.no_grad():
        next(iter(loss.noise_qvalue_network_params.values(True, True))).fill_(float("nan"))
    with pytest.raises(FloatingPointError, match=diverged % "loss_qvalue_noise"):
        loss.distillation_loss(batch())
    with pytest.raises(FloatingPointError, match=diverged % "loss_actor"):
        loss(batch())


def test_networks_that_do_not_fit():
    decoder = make_decoder(PastPrior(H))
    sizes = (D_A, D_O, H, TO)
    actor = make_prior_space_actor(*sizes, delta=0.5)
    chunk = make_prior_space_critic(*sizes, in_keys=(keys.OBSERVATION, keys.CHUNK))
    noise = make_prior_space_critic(*sizes, delta=0.5)
    with pytest.raises(ValueError, match=r"qvalue_network must read .*chunk"):
        DSRLNALoss(actor, noise, noise, decoder)
    with pytest.raises(ValueError, match=r"noise_qvalue_network must read .*delta"):
        DSRLNALoss(actor, chunk, chunk, decoder)
    with pytest.raises(ValueError, match=r"half side 1.5.*decoder's 0.5"):
        DSRLNALoss(make_prior_space_actor(*sizes, delta=1.5), chunk, noise, decoder)
    with pytest.raises(ValueError, match=r"the actor writes .*shift.*, but the decoder reads .*delta"):
        parameters = {"loc": "delta_loc", "scale": "delta_scale"}
        renamed = ProbabilisticActor(
            actor.module[0], parameters, out_keys=["shift"], distribution_class=TanhNormal
        )
        DSRLNALoss(renamed, chunk, noise, decoder)
    with pytest.raises(TypeError, match=r"without a decoder behind it, got TensorDictSequential"):
        DSRLNALoss(TensorDictSequential(actor, decoder), chunk, noise, decoder)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"noise_critic_steps": 0}, "noise_critic_steps must be a whole number of at least 1"),
        ({"alpha_init": 0.0}, "alpha_init must be a finite number > 0"),
        ({"distillation": "laplace"}, "distribution must be"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        build(**options)
