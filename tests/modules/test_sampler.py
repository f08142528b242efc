"""PriorSampler: keys, generator and errors."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from warmprior import GaussianPrior, PastPrior, PriorSampler


def batch(*shape, length=4):
    return TensorDict(
        {
            "prior": {
                "loc": torch.randn(*shape, length, 2),
                "warm": torch.rand(*shape, length, 1) < 0.5,
            }
        },
        shape,
    )


@pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
def test_writes_the_source(shape):
    data = batch(*shape)
    sampler = PriorSampler(PastPrior(4), generator=torch.Generator().manual_seed(1))
    out = sampler(data.clone())["prior", "noise"]
    eps = torch.randn(*shape, 4, 2, generator=torch.Generator().manual_seed(1))
    loc, warm = data["prior", "loc"], data["prior", "warm"]
    torch.testing.assert_close(out, warm * (loc + 0.5 * eps) + (~warm) * eps)


def test_keys_can_be_renamed():
    data = TensorDict({"a": torch.ones(2, 4, 1), "b": {"w": torch.ones(2, 4, 1).bool()}}, [2])
    sampler = PriorSampler(
        PastPrior(4, sigma=0.0), loc_key="a", warm_key=("b", "w"), noise_key=("c", "d")
    )
    assert sampler.in_keys == ["a", ("b", "w")] and sampler.out_keys == [("c", "d")]
    assert torch.equal(sampler(data)["c", "d"], torch.ones(2, 4, 1))


def test_the_global_generator_is_the_default():
    data = batch(3)
    data["prior", "warm"] = torch.zeros(3, 4, 1, dtype=torch.bool)
    sampler = PriorSampler(GaussianPrior(4))
    torch.manual_seed(7)
    first = sampler(data.clone())["prior", "noise"]
    torch.manual_seed(7)
    assert torch.equal(first, torch.randn(3, 4, 2))


@pytest.mark.parametrize("missing", ["loc", "warm"])
def test_missing_key_is_named(missing):
    data = batch(3)
    del data["prior", missing]
    with pytest.raises(KeyError, match=missing):
        PriorSampler(PastPrior(4))(data)
