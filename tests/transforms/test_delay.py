"""Late chunks against a simulation, step by step, of a robot that goes on while its policy computes."""

from functools import partial
from itertools import product

import pytest
import torch
from torchrl.envs import ParallelEnv, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from lab.measures.source_errors import mean_revision
from tests.errors import raises, refuses
from tests.toy_env import ACTION_DIM, ChunkPolicy, CountingEnv, closing
from warmprior import GaussianPrior, InferenceDelay, PastPrior, PreviewPrior, keys, policy_transforms
from warmprior.diagnostics import executed_actions, smoothness
from warmprior.history import ENTRIES
from warmprior.transforms import executed_chunk

PRIORS = {prior.name: prior for prior in (GaussianPrior(6), PastPrior(6), PreviewPrior(6))}


def lagging(length):
    """Action i of a chunk names the step it was decided at, and which step it is for."""

    def chunk(data):
        step = data["observation"][..., -1, 0, None, None]  # of the last observation in the stack
        target = step + torch.arange(length).view(-1, 1)
        made = step.expand_as(target)
        return torch.cat([made, target], -1) / 1000

    return ChunkPolicy(chunk)


def lone_robot(length, prediction, execute, delay):
    """What is executed in an episode: a loop over control steps, as a robot runs it.

    Decisions are known by their step; the first one is waited for.
    """
    actions, current, started, pending = [], None, 0, None
    for step in range(length):
        if pending is not None and step == pending + delay:
            current, pending = pending, None
        if current is None:
            current = started = step
        elif step == started + execute:
            assert pending is None  # one thought at a time
            started = pending = step
            if delay == 0:
                current, pending = pending, None
        assert step - current < prediction
        actions.append(torch.tensor([current, step]) / 1000)
    return actions


@pytest.mark.parametrize("name", PRIORS)
@pytest.mark.parametrize(("execute", "delay"), [(3, 0), (3, 1), (3, 3), (4, 2), (5, 1)])
def test_a_robot_that_does_not_wait(name, execute, delay):
    """Three sub-environments whose episodes end apart, and begin anew."""
    prior, lengths = PRIORS[name], (7, 16, 22)
    size = prior.prediction_length
    base = SerialEnv(len(lengths), [partial(CountingEnv, n) for n in lengths])
    env = late(None, base, name, execute, delay)
    rollout = env.rollout(12, lagging(size), break_when_any_done=False)
    actions, _, episode = executed_actions(rollout)
    for row, length in enumerate(lengths):
        expected = lone_robot(length, size, execute, delay)
        for number in range(int(episode[row].max())):  # but for the last, which may be cut
            found = actions[row][episode[row] == number]
            torch.testing.assert_close(found, torch.stack(expected))
            # Each is the action for the step at which it was executed.
            torch.testing.assert_close(found[:, 1] * 1000, torch.arange(float(length)))
    check_what_simulators_got(rollout)


def check_what_simulators_got(rollout):
    """The toy's observation shows the last action of every decision."""
    last = (rollout["next", "executed_steps"] - 1).unsqueeze(-1).expand(-1, -1, 1, ACTION_DIM)
    given = executed_chunk(rollout).gather(-2, last).squeeze(-2)
    torch.testing.assert_close(given, rollout["next", "observation"][..., 0, 2:])


def history(rollout, row, decision):
    """All actions executed in the episode before a decision, control step by control step."""
    done = rollout["next", "done"][row, :decision].flatten()
    first = int(done.nonzero().max()) + 1 if done.any() else 0
    chunk, steps = executed_chunk(rollout)[row], rollout["next", "executed_steps"][row]
    parts = [chunk[d, : int(steps[d])] for d in range(first, decision)]
    return torch.cat(parts) if parts else chunk[0, :0]


@pytest.mark.parametrize(("execute", "delay"), [(3, 2), (4, 2), (5, 1)])
def test_the_past_is_what_was_executed(execute, delay):
    prior = PRIORS["past"]
    base = SerialEnv(2, [partial(CountingEnv, n) for n in (13, 40)])
    env = late(None, base, execute=execute, delay=delay)
    rollout = env.rollout(9, lagging(6), break_when_any_done=False)
    warm = 0
    for row, decision in product(range(2), range(9)):
        before = history(rollout, row, decision)
        source = prior.distribution(rollout["history"][row, decision])
        assert source.warm.all() == source.warm.any() == (len(before) >= 6)
        if len(before) >= 6:
            warm += 1
            assert torch.equal(source.loc, before[-6:])
    assert warm > 6


@pytest.mark.parametrize(("execute", "delay"), [(3, 2), (6, 6), (5, 1)])
def test_the_preview_is_the_forecast_of_the_same_steps(execute, delay):
    prior = PRIORS["preview"]
    rollout = late(50, name="preview", execute=execute, delay=delay).rollout(8, lagging(12))
    for decision in range(1, len(rollout)):
        step = decision * execute
        loc = prior.distribution(rollout["history"][decision]).loc[:6] * 1000
        # Made by the decision before, for the six steps from here on.
        torch.testing.assert_close(loc[:, 0], torch.full((6,), float(step - execute)))
        torch.testing.assert_close(loc[:, 1], step + torch.arange(6.0))
        # What is left of the chunk is the same forecast, and reaches as far as that did.
        assert rollout["history", "forecast_steps"][decision] == 12 - execute
        forecast = rollout["history", "forecast"][decision]
        assert torch.equal(forecast[:6] * 1000, loc)
        assert not forecast[12 - execute :].any()


def late(length, base=None, name="past", execute=4, delay=2):
    transforms = policy_transforms(PRIORS[name], observation_steps=1, execute=execute, delay=delay)
    return TransformedEnv(CountingEnv(length) if base is None else base, transforms)


@pytest.mark.parametrize("batched", [SerialEnv, partial(ParallelEnv, mp_start_method="fork")])
def test_inside_of_batched_environments(batched):
    lengths = (7, 16)
    with closing(batched(2, [partial(late, n) for n in lengths])) as env:
        rollout = env.rollout(10, lagging(6), break_when_any_done=False)
    actions, _, episode = executed_actions(rollout)
    for row, length in enumerate(lengths):
        alone = executed_actions(late(length).rollout(10, lagging(6)))[0]
        for number in range(int(episode[row].max())):
            torch.testing.assert_close(actions[row][episode[row] == number], alone)
    check_what_simulators_got(rollout)


def test_only_the_rows_of_a_partial_step_change():
    env, policy = late(20, SerialEnv(2, partial(CountingEnv, 20))), lagging(6)
    first = policy(env.reset()).set("_step", torch.tensor([True, False]))
    assert env.step(first)["next", "rtc", "delay"].tolist() == [[2], [0]]
    data = env.step_mdp(env.step(policy(env.reset())))
    data.set("_step", torch.tensor([True, False]))
    after = env.step(policy(data))["next"]
    for key in (*((keys.HISTORY, name) for name in ENTRIES), keys.DELAY):
        assert torch.equal(data[key][1], after[key][1]), key
    assert not torch.equal(data[keys.FORECAST][0], after[keys.FORECAST][0])
    # A reset of the other row leaves the first one as it is.
    fresh = env.reset(env.step_mdp(env.step(policy(data))).set("_reset", torch.tensor([[False], [True]])))
    assert fresh["rtc", "delay"].tolist() == [[2], [0]]
    assert fresh[keys.FORECAST_STEPS].tolist() == [[2], [0]]


def test_specs_and_jumps_where_chunks_take_effect():
    env = late(20)
    check_env_specs(env)
    rollout = env.rollout(10, lagging(6))
    decision = executed_actions(rollout)[1].tolist()
    assert decision == [0] * 6 + [1] * 4 + [2] * 4 + [3] * 4 + [4] * 2
    # Only there the actions jump: made at another step. Inside, the steps they are for follow each other.
    found = smoothness(rollout)
    assert found.inner_jump == pytest.approx(0.001, rel=1e-3)
    assert found.boundary_jump == pytest.approx((0.004**2 + 0.001**2) ** 0.5, rel=1e-3)
    assert found.boundaries == 4
    # The mean is compared with what the policy predicts, and carried on from what was executed.
    made = [rollout["vla_action", "chunk"][d] for d in range(5)]
    played = executed_chunk(rollout)
    loc, squares = torch.cat([played[0, :4], played[1, :4]])[2:], []
    for d in (2, 3, 4):
        squares.append((made[d] - loc).square())
        loc = torch.cat([loc, played[d, :4]])[4:]
    expected = torch.cat(squares).mean().sqrt()
    source = PRIORS["past"].distribution(rollout["history"])
    rollout[keys.LOC], rollout[keys.WARM] = source.loc, source.warm
    assert mean_revision(rollout) == pytest.approx(float(expected), rel=1e-5)


def test_numbers_that_do_not_go_together():
    refuses(lambda: InferenceDelay(4, execute=3), ValueError, "delay", 4, 3)
    refuses(lambda: InferenceDelay(1.5, execute=3), ValueError, "delay", 0)
    with raises(ValueError, 6, 5, "delay", 2, 4):
        TransformedEnv(CountingEnv(9), policy_transforms(PRIORS["past"], execute=5, delay=2)).reset()
    refuses(lambda: policy_transforms(PRIORS["past"], delay=4), ValueError, "delay", 4, 6, 3)
    # As many as the delay leaves are executed.
    whole = TransformedEnv(CountingEnv(9), policy_transforms(PRIORS["past"], delay=2))
    assert whole.rollout(2, lagging(6))["next", "executed_steps"].flatten().tolist() == [4, 4]
    refuses(lambda: whole.step(lagging(6)(whole.reset()).exclude("rtc")), KeyError, "delay")
    more = TransformedEnv(CountingEnv(9), policy_transforms(PRIORS["past"], delay=2))
    next(part for part in more.transform if isinstance(part, InferenceDelay)).execute = 3
    refuses(lambda: more.rollout(1, lagging(6)), RuntimeError, "ChunkStep", 4, 3)
