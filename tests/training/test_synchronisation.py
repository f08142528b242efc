"""A training step queues its work on the device and waits for nothing."""

import dataclasses

import pytest
import torch
from tensordict import TensorDict
from torch.utils._python_dispatch import TorchDispatchMode

from lab.methods.learned_sources import ForecastPrior
from tests.training.cloning_parts import CONFIG, actor_for, dataset, mlp, training
from warmprior import CVAEPrior, ImageEncoder, PastPrior, VelocityMLP, VisionNetwork, WarmPriorActor
from warmprior.training import precondition

READS = ("_local_scalar_dense", "nonzero", "is_nonzero", "equal", "masked_select", "lift_fresh")
"""Operators by which Python reads a tensor or makes one of its own numbers: a GPU is waited for."""


def reads(operator, args):
    """Indexing by a mask counts what is true in it."""
    name = operator.overloadpacket.__name__
    indices = args[1] if name in ("index", "index_put", "index_put_", "_index_put_impl_") else ()
    masks = [i for i in indices if i is not None and i.dtype == torch.bool]
    return name in READS or bool(masks)


class Reads(TorchDispatchMode):
    """Records the operators that would wait for a GPU; those on ``host`` would not."""

    def __init__(self, host: torch.Tensor) -> None:
        super().__init__()
        self.host, self.found = host, []

    def __torch_dispatch__(self, operator, types, args=(), kwargs=None):
        if reads(operator, args) and not (args and args[0] is self.host):
            self.found.append(operator.overloadpacket.__name__)
        return operator(*args, **(kwargs or {}))


def with_images():
    images = torch.randint(0, 256, (120, 3, 12, 12), dtype=torch.uint8)
    data = dataset()
    data["observation"] = TensorDict({"state": data["observation"], "camera": images}, [120])
    encoder = ImageEncoder(["camera"], 3, image_size=12, crop_size=10, backbone="small")
    network = VelocityMLP(2, encoder.observation_dim, 4, hidden_dim=8)
    return data, WarmPriorActor(VisionNetwork(encoder, network), PastPrior(4))


def preconditioned(prior):
    return actor_for(prior, precondition(mlp(), dataset(), prior))


PUBLIC = {"max_grad_norm": 1e-2, "count_padding": True}
CASES = {
    "paper": lambda: (CONFIG, dataset(), actor_for()),
    "options": lambda: (
        dataclasses.replace(CONFIG, weighting="standardised", times="u-shaped", **PUBLIC),
        dataset(),
        preconditioned(PastPrior(4, correlation=0.5)),
    ),
    "learned": lambda: (CONFIG, dataset(), actor_for(ForecastPrior(4, widths=[2, 3, 2]), mlp())),
    "decoded": lambda: (CONFIG, dataset(), actor_for(CVAEPrior(4, widths=[2, 3, 2]), mlp())),
    "images": lambda: (CONFIG, *with_images()),
}


@pytest.mark.parametrize("case", CASES)
def test_a_step_reads_no_tensor(tmp_path, case):
    config, data, actor = CASES[case]()
    cloning = training(tmp_path, config, data=data, actor=actor)
    cloning.actor.train()
    cloning.step()  # the optimiser makes its state
    assert cloning.update.ema.n_averaged.device.type == "cpu"
    with Reads(cloning.update.ema.n_averaged) as seen:
        cloning.step()
    assert not seen.found


def test_what_reads_is_found(tmp_path):
    """A coupling of a user's own, which looks at its sources in every way."""

    def reading(a0, a1, observation):
        assert a0.sum().item() and len((a0 > 0).nonzero()) and len(a0[a0 > 0])
        return a0, a1

    cloning = training(tmp_path, actor=actor_for(network=mlp()), coupling=reading)
    with Reads(cloning.update.ema.n_averaged) as seen:
        cloning.step()
    assert {"_local_scalar_dense", "nonzero", "index"} <= set(seen.found)
