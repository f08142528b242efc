"""Transforms that wait to a chunk's end, against the same environment stepped one action at a time."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import (
    ActionScaling,
    Compose,
    EnvBase,
    ObservationNorm,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)

from tests.toy_env import ACTION_DIM, CountingEnv
from warmprior import ChunkStep, ObservationStack

H = 5


def norm(key="observation", **options):
    loc, scale = torch.tensor([0.3, -1.0, 0.1, 0.7]), torch.tensor([3.0, 0.7, 1.3, 0.9])
    return ObservationNorm(loc=loc, scale=scale, in_keys=[key], standard_normal=True, **options)


def scaling():
    loc, scale = torch.tensor([0.1, -0.2]), torch.tensor([0.7, 0.3])
    return ActionScaling(in_keys_inv=["action"], in_keys=[], loc=loc, scale=scale)


def transforms(steps):
    return [norm(), scaling(), ObservationStack(steps)]


def single_steps(env, chunks, execute):
    """Observations and numbers of steps after each chunk, played action by action."""
    found, data = [], env.reset()
    for chunk in chunks:
        for i in range(execute):
            data = env.step(data.set("action", chunk[i]))
            done, data = bool(data["next", "done"]), env.step_mdp(data)
            if done:
                break
        found.append((data["observation"], i + 1))
        if done:
            data = env.reset()
    return found


@pytest.mark.parametrize("steps", [1, 2, 4, 7])
@pytest.mark.parametrize("execute", [1, 2, H])
@pytest.mark.parametrize("lengths", [(9,), (30,), (7, 13, 4)])
def test_chunks_lead_to_what_single_steps_lead_to(lengths, execute, steps):
    """Bit by bit, also where one row of several ends inside its chunk."""
    base = SerialEnv(len(lengths), [partial(CountingEnv, n) for n in lengths])
    env = TransformedEnv(base, Compose(*transforms(steps), ChunkStep(H, execute=execute)))
    chunks = torch.rand(len(lengths), 6, H, ACTION_DIM, generator=torch.Generator().manual_seed(0))
    plain = [
        single_steps(TransformedEnv(CountingEnv(n), Compose(*transforms(steps))), row, execute)
        for n, row in zip(lengths, chunks, strict=True)
    ]
    data = env.reset()
    for i in range(6):
        data, after = env.step_and_maybe_reset(data.set(("vla_action", "chunk"), chunks[:, i]))
        for row, found in enumerate(plain):
            observation, taken = found[i]
            assert torch.equal(data["next", "observation"][row], observation)
            assert data["next", "executed_steps"][row].item() == taken
        data = after


def late_of(env):
    return env.transform[-1]._inner_step()[1]


@pytest.mark.parametrize(("steps", "runs"), [(1, 1), (2, 2), (3, 3), (9, 7)])
def test_only_the_steps_that_count_are_transformed(monkeypatch, steps, runs):
    seen = []
    apply = ObservationNorm._apply_transform
    monkeypatch.setattr(ObservationNorm, "_apply_transform", lambda t, x: seen.append(x) or apply(t, x))
    env = TransformedEnv(CountingEnv(20), Compose(norm(), ObservationStack(steps), ChunkStep(8)))
    data = env.step_mdp(env.rand_step(env.reset()))  # the first one asks for specs
    seen.clear()
    env.rand_step(data)
    # The container transforms the first of the eight steps by itself.
    assert len(seen) == 1 + runs


class Subclass(ObservationStack):
    """What it does besides is not known."""


EVERY_STEP = {
    "memory": (CountingEnv, [StepCounter(), ObservationStack(2)]),
    "unknown": (CountingEnv, [Subclass(2)]),
    "transformed base": (
        lambda: TransformedEnv(CountingEnv(), StepCounter(), auto_unwrap=False),
        [ObservationStack(2)],
    ),
    "reward": (CountingEnv, [norm("reward")]),
    "state": (CountingEnv, [norm(in_keys_inv=["gain"])]),
}


@pytest.mark.parametrize("case", EVERY_STEP)
def test_others_run_at_every_step(case):
    make_base, before = EVERY_STEP[case]
    env = TransformedEnv(make_base(), Compose(*before, ChunkStep(H)), auto_unwrap=False)
    assert late_of(env) is None


def test_a_nested_action():
    class NestedEnv(CountingEnv):
        def __init__(self):
            super().__init__(9)
            self.action_spec = Composite(robot=Composite(action=Bounded(-1, 1, (ACTION_DIM,))))

        def _step(self, tensordict):
            return super()._step(tensordict["robot"])

    chunk = ChunkStep(H, action_key=("robot", "action"))
    env = TransformedEnv(NestedEnv(), Compose(ObservationStack(2), chunk))
    found = env.rollout(2)
    seen, planned = found["next", "observation"][..., 2:], found["vla_action", "chunk"]
    assert torch.equal(seen[0], planned[0, H - 2 :])
    assert torch.equal(seen[1], planned[1, 2:4])
    assert late_of(env) is None


class StatelessEnv(EnvBase):
    """Counts in the tensordict; ``"x"`` is read as it was transformed."""

    def __init__(self):
        super().__init__()
        self.observation_spec = Composite(x=Unbounded((4,)))
        self.state_spec = self.observation_spec.clone()
        self.action_spec = Bounded(-1, 1, (ACTION_DIM,))
        self.reward_spec = Unbounded((1,))
        self.done_spec = Composite(
            {key: Categorical(2, dtype=torch.bool, shape=(1,)) for key in ("done", "terminated")}
        )

    def _reset(self, tensordict=None, **kwargs):
        return TensorDict({"x": torch.zeros(4), "done": torch.zeros(1, dtype=torch.bool)})

    def _set_seed(self, seed):
        """Nothing is random."""

    def _step(self, tensordict):
        done = torch.zeros(1, dtype=torch.bool)
        x = tensordict["x"] + 1
        return TensorDict({"x": x, "reward": x[:1], "done": done, "terminated": done})


def test_a_state_that_is_transformed():
    """Every step starts from what the transforms made of the step before."""
    env = TransformedEnv(StatelessEnv(), Compose(norm("x"), ChunkStep(H)))
    assert late_of(env) is None
    plain = TransformedEnv(StatelessEnv(), norm("x"))
    data, total = plain.reset(), 0
    for _ in range(H):
        data = plain.rand_step(data)
        total, data = total + data["next", "reward"], plain.step_mdp(data)
    found = env.rollout(1)["next"]
    assert torch.equal(found["x"][0], data["x"])
    torch.testing.assert_close(found["reward"][0], total)


def test_states_that_are_not_transformed():
    """They go from step to step as the environment gives them, while others wait."""
    env = TransformedEnv(
        StatelessEnv(),
        Compose(norm("x", out_keys=["seen"]), ObservationStack(2, observation_key="seen"), ChunkStep(H)),
    )
    assert late_of(env) is not None
    found = env.rollout(2)["next"]
    assert found["x"][:, 0].tolist() == [H, 2 * H]
    expected = (torch.tensor([H - 1.0, H])[:, None] - norm().loc) / norm().scale
    torch.testing.assert_close(found["seen"][0], expected)
