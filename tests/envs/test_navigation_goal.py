import itertools

import pytest
import torch

from warmprior.envs import NavigationEnv, navigation_heights

ROUTES = list(itertools.product((1, -1), repeat=2))
STEPS = 64


def crossing_paths():
    """The six demonstrations, and as many that change sides halfway between the obstacles."""
    heights = navigation_heights()
    crossing = heights.clone()
    crossing[:, STEPS // 2 :] *= -1
    return torch.cat([heights, crossing])


def play(env, paths):
    """Per path its rewards until its end, and what the last state tells."""
    data = env.reset()
    rewards = torch.zeros(len(paths), STEPS)
    length = torch.zeros(len(paths), dtype=torch.int64)
    solved = torch.zeros(len(paths), dtype=torch.bool)
    for step in range(STEPS):
        running = length == 0
        following = env.step(data.set("action", paths[:, step, None]))["next"]
        rewards[running, step] = following["reward"][running, 0]
        ended = running & following["done"][:, 0]
        assert torch.equal(following["done"], following["terminated"])
        length[ended] = step + 1
        solved[ended] = following["success"][ended, 0]
        data = following.exclude("reward")
    assert (length > 0).all()
    return rewards, length, solved


@pytest.mark.parametrize("route", ROUTES)
def test_which_demonstrations_succeed(route):
    """Brute force over the heights above the two obstacles' centres."""
    paths = crossing_paths()
    x = torch.linspace(-1, 1, STEPS)
    middles = [int((x - c).abs().argmin()) for c in (-0.45, 0.45)]
    rewards, length, solved = play(NavigationEnv(route, batch_size=[len(paths)]), paths)
    sides = paths[:, middles].sign()
    for i, sign in enumerate(sides.tolist()):
        wrong = [m for m, got, asked in zip(middles, sign, route, strict=True) if got != asked]
        assert bool(solved[i]) == (not wrong)
        assert int(length[i]) == (wrong[0] + 1 if wrong else STEPS)
        expected = torch.zeros(STEPS)
        expected[-1] = float(not wrong)  # a reward at the very end, and for success alone
        assert torch.equal(rewards[i], expected)
    # Three of the six demonstrations if the goal keeps to one side, none of them if it crosses.
    assert int(solved[:6].sum()) == (3 if route[0] == route[1] else 0)
    assert int(solved.sum()) == 3
