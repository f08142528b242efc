"""Transforms that wait to a chunk's end, against the same environment stepped one action at a time."""

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import ActionScaling, Compose, ObservationNorm, SerialEnv, StepCounter, TransformedEnv

from tests.toy_env import ACTION_DIM, CountingEnv
from warmprior import ChunkStep, Normalizer, ObservationStack, PastPrior, policy_transforms

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


def test_the_transforms_of_a_normalised_policy_wait():
    """A camera would otherwise render at every step."""
    data = TensorDict({"observation": torch.rand(9, 4), "action": torch.rand(9, ACTION_DIM)}, [9])
    transforms = policy_transforms(PastPrior(H), normalizer=Normalizer.fit(data, ("observation", "action")))
    env = TransformedEnv(CountingEnv(9))
    for transform in transforms:
        env.append_transform(transform.clone())
    (chunk,) = [t for t in env.transform if isinstance(t, ChunkStep)]
    assert chunk._inner_step()[1] is not None


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
