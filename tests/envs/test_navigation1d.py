"""The navigation toy: its geometry by dense sampling, its episodes, and its metrics on known paths."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.errors import raises
from tests.toy_env import ChunkPolicy
from warmprior import GaussianPrior, PastPrior, policy_transforms, window_replay_buffer
from warmprior.envs import (
    NavigationEnv,
    navigation_demonstrations,
    navigation_heights,
    navigation_metrics,
    navigation_positions,
)
from warmprior.envs.navigation1d import navigation_collides


@pytest.mark.parametrize("batch_size", [(), (3,), (2, 2)])
@pytest.mark.parametrize("octaves", [0, 4])
@pytest.mark.parametrize("route", [None, (1, -1)])
def test_specs(batch_size, octaves, route):
    check_env_specs(NavigationEnv(route, octaves=octaves, batch_size=batch_size))


def test_a_policy_may_see_the_position_alone():
    rollout = NavigationEnv(octaves=0).rollout(64)
    demonstrations = navigation_demonstrations(octaves=0)["observation"]
    for seen in rollout["observation"], demonstrations[:64]:
        torch.testing.assert_close(seen, navigation_positions()[:, None])
    for make in NavigationEnv, navigation_demonstrations:
        for octaves in -1, 1.5, True:
            with raises(ValueError, "octaves", octaves):
                make(octaves=octaves)


def test_demonstrations_avoid_the_obstacles_on_both_sides():
    heights, x = navigation_heights(), navigation_positions()
    assert heights.shape == (6, 64) and heights.abs().max() < 1
    assert (heights[:3] > 0).all() and (heights[3:] < 0).all()
    assert not navigation_collides(x.expand(6, 64), heights).any()
    data = navigation_demonstrations()
    assert torch.equal(data["action"].view(6, 64), heights)
    assert torch.equal(data["observation"][:64, 0], x)
    assert data["episode"].tolist() == [k for k in range(6) for _ in range(64)]
    batch = window_replay_buffer(data, PastPrior(4), batch_size=8, observation_steps=1).sample()
    assert batch["observation"].shape == (8, 1, 9)


@settings(max_examples=60, deadline=None)
@given(x=st.floats(-0.99, 0.9), width=st.floats(0.01, 1.0), y=st.tuples(st.floats(-1, 1), st.floats(-1, 1)))
def test_collision_of_a_segment_against_dense_points(x, width, y):
    share = torch.linspace(0, 1, 20_001, dtype=torch.float64)
    px, py = x + share * width, y[0] + share * (y[1] - y[0])
    # How deep the deepest point lies inside an obstacle; touching it is too close to call.
    depth = max(float(torch.minimum(0.12 - (px - c).abs(), 0.45 - py.abs()).max()) for c in (-0.45, 0.45))
    hit = navigation_collides(
        torch.tensor([x, x + width], dtype=torch.float64), torch.tensor(y, dtype=torch.float64)
    )
    if abs(depth) > 1e-3:
        assert bool(hit) == (depth > 0)


def heights_policy(heights, chunk):
    """Plays given heights ``[n, 64]`` in chunks."""
    padded = torch.cat([heights, heights[:, -1:].expand(-1, chunk)], 1)
    return ChunkPolicy(lambda data: padded.gather(1, data["step_index"] + torch.arange(chunk)).unsqueeze(-1))


@pytest.mark.parametrize("chunk", [1, 4, 5])
def test_episode_executes_the_heights_and_reports_collisions(chunk):
    torch.manual_seed(0)
    heights = torch.cat([navigation_heights(), torch.zeros(1, 64), 0.6 * torch.randn(5, 64)])
    transforms = policy_transforms(GaussianPrior(chunk), observation_steps=1)
    env = TransformedEnv(NavigationEnv(batch_size=[12]), transforms)
    rollout = env.rollout(1000, heights_policy(heights, chunk))
    assert rollout.shape == (12, math.ceil(64 / chunk))
    last = rollout["next"][:, -1]
    assert (last["step_index"] == 64).all() and last["terminated"].all()
    hit = navigation_collides(navigation_positions().expand(12, 64), heights).any(1)
    assert last["success"].flatten().tolist() == (~hit).tolist()
    assert rollout["next", "reward"].sum(1).flatten().tolist() == (~hit).float().tolist()
    assert not hit[:6].any() and hit[6:].all()
    torch.testing.assert_close(last["height"].flatten(), heights[:, -1])
    seen = rollout["observation"][:, :, 0, 0]
    torch.testing.assert_close(seen, navigation_positions()[::chunk].expand_as(seen))


def test_metrics_of_known_paths():
    above, below = navigation_heights()[1], navigation_heights()[4]
    switching = torch.where(torch.arange(64) // 4 % 2 == 0, above, below)
    crossing = torch.where(torch.arange(64) < 32, above, below)  # between the obstacles
    late = torch.where(torch.arange(64) < 34, above, below)  # the same, inside a chunk
    paths = {"a": above, "s": switching, "c": crossing, "l": late}
    one = {name: navigation_metrics(path[None], 4) for name, path in paths.items()}
    assert [m.switch_rate for m in one.values()] == pytest.approx([0, 1, 1 / 15, 0])
    assert [m.commit_rate for m in one.values()] == [1, 0, 0, 0]
    assert [m.collision_rate for m in one.values()] == [0, 1, 0, 0]
    assert one["c"].recombination_rate == 1.0 and one["a"].recombination_rate == 0.0
    assert all(m.distance == 0 for m in one.values())
    slow = torch.linspace(0.6, -0.6, 64)[None]  # several steps near the axis, on neither side
    assert navigation_metrics(slow, 4).commit_rate == 0 and navigation_metrics(0 * slow, 4).commit_rate == 1
    assert one["a"].jump < 0.1 < one["s"].jump
    routes = torch.stack([above, below, crossing, -crossing])
    assert navigation_metrics(routes, 4).route_entropy == pytest.approx(2.0)
    assert navigation_metrics(routes[:2], 4).route_entropy == pytest.approx(1.0)
    assert navigation_metrics(above[None] + 0.01, 4).distance == pytest.approx(0.01, rel=1e-3)
