"""PriorSampler: keys, generator and errors."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from tests.toy_env import random_history
from warmprior import GaussianPrior, PastPrior, PriorSampler, keys
from warmprior.history import ENTRIES


@pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
def test_writes_the_source(shape):
    prior = PastPrior(4)
    data = TensorDict({"history": random_history(prior, *shape)}, shape)
    sampler = PriorSampler(prior, generator=torch.Generator().manual_seed(1))
    out = sampler(data.clone())
    eps = torch.randn(*shape, 4, 2, generator=torch.Generator().manual_seed(1))
    warm = (data["history", "steps"] >= 4).unsqueeze(-1)
    loc = warm * data["history", "actions"]
    assert torch.equal(out["prior", "loc"], loc)
    assert torch.equal(out["prior", "warm"], warm.expand(*shape, 4, 1))
    torch.testing.assert_close(out["prior", "noise"], warm * (loc + 0.5 * eps) + ~warm * eps)


def test_keys():
    data = TensorDict({"history": random_history(PastPrior(4), 2)}, [2])
    sampler = PriorSampler(PastPrior(4, sigma=0.0), noise_key=("c", "d"))
    assert sampler.in_keys == [(keys.HISTORY, name) for name in ENTRIES]
    assert sampler.out_keys == [keys.LOC, keys.WARM, ("c", "d")]
    assert sampler(data)["c", "d"].shape == (2, 4, 2)


def test_the_global_generator_is_the_default():
    prior = GaussianPrior(4)
    data = TensorDict({"history": random_history(prior, 3)}, [3])
    torch.manual_seed(7)
    first = PriorSampler(prior)(data)["prior", "noise"]
    torch.manual_seed(7)
    assert torch.equal(first, torch.randn(3, 4, 2))


@pytest.mark.parametrize("missing", [*ENTRIES, "history"])
def test_missing_key_is_named(missing):
    data = TensorDict({"history": random_history(PastPrior(4), 3)}, [3])
    del data["history" if missing == "history" else ("history", missing)]
    with pytest.raises(KeyError, match=rf"PastPrior.*missing: .*{missing}.*ActionHistory writes"):
        PriorSampler(PastPrior(4))(data)
