"""Control steps in one go are those taken one by one, bit by bit."""

import pytest
import torch

pytest.importorskip("robosuite")

from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Transform

from warmprior import PastPrior, policy_transforms
from warmprior.envs import RobosuiteEnv

RESULT = ["reward", "success", "done", "terminated", "truncated"]
KINDS = {
    "two arms": {"task": "transport"},
    "robosuite's own loop": {"task": "lift", "control_loop": "robosuite"},
    "other observations": {"task": "lift", "low_dim_keys": ("object", "robot0_joint_vel")},
    "state and poses": {"task": "lift", "sim_state": True, "eef_pose": True},
}


def one_by_one(env, actions):
    results, data = [], env.reset()
    for action in actions:
        data = env.step(data.set("action", action))
        results.append(data["next"])
        if data["next", "done"]:
            break
        data = env.step_mdp(data)
    return results


def actions_of(env, number):
    generator = torch.Generator().manual_seed(0)
    return torch.rand(number, *env.action_spec.shape, generator=generator) * 2 - 1


def check(found, expected, keep):
    assert len(found) == len(expected)
    for i, (mine, theirs) in enumerate(zip(found, expected, strict=True)):
        if i < len(found) - keep:
            assert set(mine.keys()) == set(RESULT)
            theirs = theirs.select(*RESULT)
        assert set(mine.keys()) == set(theirs.keys())
        for key, value in theirs.items():
            assert torch.equal(mine[key], value), (i, key)
            assert mine[key].dtype == value.dtype


@pytest.mark.parametrize("options", KINDS.values(), ids=KINDS)
def test_in_one_go(options):
    env = RobosuiteEnv(**options)
    actions = actions_of(env, 12)
    env.set_seed(5)
    expected = one_by_one(env, actions)
    for cuts in ((12,), (1, 7, 4)):
        env.set_seed(5)
        env.reset()
        first = 0
        for number in cuts:
            part = slice(first, first + number)
            check(env.control_steps(actions[part], keep=2), expected[part], keep=2)
            first += number


@pytest.mark.parametrize("end", [1, 3, 6])
def test_an_episode_ends_on_the_way(monkeypatch, end):
    env = RobosuiteEnv("stack")
    actions, simulator, asked = actions_of(env, 8), env.loop.env, []

    def solved():
        asked.append(None)
        return len(asked) % end == 0

    monkeypatch.setattr(simulator, "_check_success", solved)
    expected = one_by_one(env, actions)
    assert len(expected) == end and expected[-1]["terminated"]
    env.set_seed(0)
    env.reset()
    check(env.control_steps(actions, keep=3), expected, keep=3)


class Onlooker(Transform):
    """Does nothing, but nobody can know, so that it is run at every step."""


@pytest.mark.parametrize(("steps", "last"), [(1, 5), (3, 1)])
def test_chunks(steps, last):
    """Also where a chunk's first action is the episode's last."""
    prior, found = PastPrior(8), []
    for before in ([], [Onlooker()]):
        transforms = [*before, *policy_transforms(prior, observation_steps=steps)]
        env = TransformedEnv(RobosuiteEnv("can", horizon=24 + last))
        for transform in transforms:
            env.append_transform(transform.clone())
        env.set_seed(2)
        generator, data, rows = torch.Generator().manual_seed(0), env.reset(), []
        for _ in range(4):
            chunk = torch.rand(8, 7, generator=generator) * 2 - 1
            data = env.step(data.set(("vla_action", "chunk"), chunk))
            rows.append(data["next"])
            data = env.step_mdp(data)
        assert rows[-1]["truncated"] and rows[-1]["executed_steps"] == last
        found.append(torch.stack(rows))
    assert (found[0] == found[1]).all()
