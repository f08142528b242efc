import pytest
import torch
from tensordict.nn import TensorDictSequential
from torchrl.modules import ProbabilisticActor, TanhNormal

from tests.errors import raises
from tests.rl.dsrl_parts import D_A, D_O, TO, H, batch, build, make_decoder
from warmprior import DSRLNALoss, PastPrior, keys, make_prior_space_actor, make_prior_space_critic


def test_buffer_of_another_wiring():
    after = ("next", *keys.ANCHOR), ("next", "executed_steps")
    for missing in ("observation", keys.ANCHOR, keys.CHUNK, *after):
        with raises(KeyError, "set_keys(chunk", f"[{missing!r}]"):
            build()(batch().exclude(missing))


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_divergence_is_named(value):
    data = batch()
    data["next", "reward"][0] = value
    with raises(FloatingPointError, "NaN", "loss_qvalue"):
        build()(data)
    loss = build()
    with torch.no_grad():
        next(iter(loss.noise_qvalue_network_params.values(True, True))).fill_(float("nan"))
    with raises(FloatingPointError, "NaN", "loss_qvalue_noise"):
        loss.distillation_loss(batch())
    with raises(FloatingPointError, "NaN", "loss_actor"):
        loss(batch())


def test_networks_that_do_not_fit():
    decoder = make_decoder(PastPrior(H))
    sizes = (D_A, D_O, H, TO)
    actor = make_prior_space_actor(*sizes, delta=0.5)
    chunk = make_prior_space_critic(*sizes, in_keys=(keys.OBSERVATION, keys.CHUNK))
    noise = make_prior_space_critic(*sizes, delta=0.5)
    with raises(ValueError, "qvalue_network", "chunk"):
        DSRLNALoss(actor, noise, noise, decoder)
    with raises(ValueError, "noise_qvalue_network", "delta"):
        DSRLNALoss(actor, chunk, chunk, decoder)
    with raises(ValueError, 1.5, 0.5):
        DSRLNALoss(make_prior_space_actor(*sizes, delta=1.5), chunk, noise, decoder)
    with raises(ValueError, "shift", "delta"):
        parameters = {"loc": "delta_loc", "scale": "delta_scale"}
        renamed = ProbabilisticActor(
            actor.module[0], parameters, out_keys=["shift"], distribution_class=TanhNormal
        )
        DSRLNALoss(renamed, chunk, noise, decoder)
    with raises(TypeError, "TensorDictSequential"):
        DSRLNALoss(TensorDictSequential(actor, decoder), chunk, noise, decoder)


def test_bad_options():
    for name, value in {"noise_critic_steps": 0, "alpha_init": 0.0}.items():
        with raises(ValueError, name, value):
            build(**{name: value})
