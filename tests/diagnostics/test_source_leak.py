"""Source leak against closed forms, and the data's spread against loops over the windows."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.diagnostics.fields import D_A, H, batch, policy, remember
from tests.errors import refuses
from warmprior import GaussianPrior, PastPrior, PreviewPrior
from warmprior.diagnostics import source_leak


def windows(n=400, length=H, d_a=D_A, seed=2):
    generator = torch.Generator().manual_seed(seed)
    target = torch.randn(n, length, d_a, generator=generator)
    return batch(n, length, d_a, vla_action={"chunk": target})


def goal(o):
    """A target that depends on the observation, ``[n, 1, 1]``."""
    return o.sum((1, 2))[:, None, None]


def passing(share):
    """At NFE 1 the chunk is ``goal(o) + share * a0``."""
    return lambda t, a, o: goal(o) + (share - 1) * a


@pytest.mark.parametrize("share", [0.05, 0.5, 1.2])
@pytest.mark.parametrize("sigma", [None, 0.3])
def test_spread_is_the_share_of_the_source_that_passes(share, sigma):
    data = windows()
    prior = GaussianPrior(H)
    if sigma is not None:
        prior = PastPrior(H, sigma=sigma)
        remember(data, torch.randn(len(data), H, D_A))  # no spread of its own
    result = source_leak(policy(passing(share), prior), data, nfes=(9, 1), draws=16)
    assert list(result) == [1, 9]
    assert result[1].spread == pytest.approx(share * (sigma or 1.0), rel=0.02)
    # Nine Euler steps multiply the same draws of the source by another factor.
    ratio = share / (1 + (share - 1) / 9) ** 9
    assert result[1].spread / result[9].spread == pytest.approx(ratio, rel=1e-3)
    assert result[1].leak == pytest.approx(result[1].spread / result[1].data_spread)


@pytest.mark.parametrize("s", [0.1, 0.7])
def test_exact_sampler_of_a_gaussian(s):
    """a1 | o ~ N(m(o), s^2): the field is linear, one step finds the mean and many the distribution."""

    def exact(t, a, o):
        variance = (1 - t) ** 2 + t**2 * s**2
        return goal(o) + (t * s**2 - (1 - t)) / variance * (a - t * goal(o))

    data = windows(200)
    # Every observation occurs twice: the nearest other window has the same one.
    data["observation"] = data["observation"][:100].repeat(2, 1, 1)
    noise = torch.randn(200, H, D_A, generator=torch.Generator().manual_seed(8))
    data["vla_action", "chunk"] = goal(data["observation"]) + s * noise
    result = source_leak(policy(exact), data, nfes=(1, 100), draws=16)
    assert result[1].spread < 1e-5
    assert result[100].spread == pytest.approx(s, rel=0.05)
    assert result[1].data_spread == pytest.approx(s, rel=0.1)
    assert result[100].leak == pytest.approx(1.0, rel=0.12)


def test_one_exact_step_from_a_telling_source_spreads_less_than_the_data():
    """WP-Preview: a1 ~ N(0, s^2), a0 = a1 + sigma eps and E[a1 | a0] = s^2 / (s^2 + sigma^2) a0."""
    s, sigma = 0.5, 0.8
    gain = s**2 / (s**2 + sigma**2)
    data = windows(500, 2 * H)
    data["vla_action", "chunk"] *= s
    warm = torch.arange(2 * H).view(1, -1, 1) < H
    remember(data, data["vla_action", "chunk"])
    # The forecast beyond H is wild, and not executed.
    actor = policy(lambda t, a, o: torch.where(warm, gain - 1, 99.0) * a, PreviewPrior(H, sigma=sigma))
    result = source_leak(actor, data, nfes=(1,))[1]
    assert result.spread == pytest.approx(gain * sigma, rel=0.03)
    assert result.data_spread == pytest.approx(s, rel=0.06)
    assert result.leak < 0.6
    assert result.inner_step < 3


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_data_spread_against_loops(data):
    n = data.draw(st.integers(2, 12))
    episodes = data.draw(st.lists(st.integers(0, 4), min_size=n, max_size=n))
    if len(set(episodes)) == 1:
        episodes[0] = 9
    generator = torch.Generator().manual_seed(data.draw(st.integers(0, 10**6)))
    rows = windows(n).update({"observation": torch.randn(n, 2, 3, generator=generator)})
    target = torch.randn(n, H, D_A, generator=generator)
    length = torch.randint(1, H + 1, (n,), generator=generator)
    rows["vla_action", "chunk"] = target
    rows["action_is_pad"] = torch.arange(H) >= length[:, None]
    squares = []
    for i in range(n):
        distance = [math.dist(rows["observation"][i].flatten(), o.flatten()) for o in rows["observation"]]
        j = min((j for j in range(n) if episodes[j] != episodes[i]), key=distance.__getitem__)
        for p in range(min(int(length[i]), int(length[j]))):
            squares += ((target[i, p] - target[j, p]) ** 2 / 2).tolist()
    result = source_leak(policy(passing(0.5)), rows, episodes=torch.tensor(episodes), nfes=(1,))
    expected = math.sqrt(sum(squares) / len(squares))
    assert result[1].data_spread == pytest.approx(expected, rel=1e-4)


def test_episodes_may_be_part_of_the_data():
    data, episodes = windows(80), torch.arange(4).repeat_interleave(20)
    actor = policy(passing(0.5))
    given = source_leak(actor, data, episodes=episodes, nfes=(1,))[1]
    assert source_leak(actor, data.clone().set("episode", episodes), nfes=(1,))[1] == given
    # Without episodes the other windows of one's own are neighbours, too: these have the same actions.
    alone = data[:20].clone()
    assert source_leak(actor, alone, nfes=(1,))[1].data_spread > 0
    alone["vla_action", "chunk"][:] = 1.0
    assert source_leak(actor, alone, nfes=(1,))[1].data_spread == 0.0
    refuses(lambda: source_leak(actor, alone, episodes=episodes[:20]), ValueError, "episode")


def test_noise_on_demonstrations_that_never_move_is_named():
    data = windows(40)
    data["vla_action", "chunk"].zero_()
    noisy, still = (source_leak(policy(passing(share)), data, nfes=(1,))[1] for share in (0.5, 0.0))
    assert noisy.data_spread == noisy.data_inner_step == 0 and noisy.spread > 0
    assert noisy.leak == noisy.inner_step_ratio == math.inf and "spread" in noisy.warning
    assert still.spread < 1e-6 and math.isnan(still.leak) and still.warning is None


def test_padded_positions_do_not_count():
    data = windows(40)
    data["action_is_pad"] = (torch.arange(H) >= 2).expand(40, H)
    wild = torch.tensor([0.3, 0.3, 50.0]).view(1, H, 1)
    noisy = data.clone()
    noisy["vla_action", "chunk"][:, 2] += 99 * torch.randn(40, D_A)
    expected = source_leak(policy(passing(0.3)), data)
    assert source_leak(policy(lambda t, a, o: goal(o) + (wild - 1) * a), noisy)[1].spread < 0.4
    assert source_leak(policy(passing(0.3)), noisy) == expected
    first = data["vla_action", "chunk"][:, :2].diff(dim=1).norm(dim=-1).mean()
    assert expected[1].data_inner_step == pytest.approx(float(first))


def test_bad_input_is_named():
    actor, data = policy(passing(0.5)), windows(5)
    refuses(lambda: source_leak(actor, data.exclude(("vla_action", "chunk"))), KeyError, "chunk")
    refuses(lambda: source_leak(actor, data, episodes=torch.zeros(4)), ValueError, "episodes", "[4]", "[5]")
    refuses(lambda: source_leak(actor, data, draws=1), ValueError, "draws", 2, 1)
    refuses(lambda: source_leak(policy(lambda t, a, o: a / (t < 0.5)), data), FloatingPointError, "NFE 9")
