"""What other people's environments do: their own buffers, whole-number actions, skipped steps."""

from functools import partial

import pytest
import torch
from tensordict import NonTensorData, NonTensorStack, TensorDict
from torchrl.data import Bounded, Categorical, Composite, MultiCategorical, NonTensor, OneHot, Unbounded
from torchrl.envs import (
    ActionDiscretizer,
    Compose,
    ConditionalPolicySwitch,
    ConditionalSkip,
    FrameSkipTransform,
    GymEnv,
    MultiAction,
    ParallelEnv,
    RenameTransform,
    RewardScaling,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.transforms import Transform

from tests.errors import raises, refuses
from tests.toy_env import ACTION_DIM, PLACES, ChunkPolicy, CountingEnv, demonstrations, mlp_actor, placed
from warmprior import (
    ActionHistory,
    ChunkStep,
    Normalizer,
    ObservationStack,
    PastPrior,
    keys,
    policy_transforms,
    window_replay_buffer,
    window_transforms,
)

H = 4
PRIOR = PastPrior(H)


def chosen(tensordict):
    """Chunks that tell the last observation."""
    seen = tensordict["observation"][..., -1:, :ACTION_DIM]
    return seen / 10 + torch.arange(H)[:, None]


POLICY = ChunkPolicy(chosen)


class OwnBuffers(CountingEnv):
    """Writes every observation, reward and flag into the same memory, as some simulators do."""

    buffers = None

    def _seen(self, out):
        self.buffers = self.buffers or {}
        for key, value in out.items():
            buffer = self.buffers.setdefault(key, torch.empty_like(value))
            out.set(key, buffer.copy_(value))
        return out


@pytest.mark.parametrize("counted", [False, True])
@pytest.mark.parametrize("execute", [1, 2, H])
def test_an_environment_may_overwrite_what_it_returned(execute, counted):
    def played(env):
        first = [StepCounter()] if counted else []
        env = TransformedEnv(env, Compose(*first, *policy_transforms(PRIOR, execute=execute)))
        data, decisions = env.reset(), []
        for _ in range(4):
            data, after = env.step_and_maybe_reset(POLICY(data))
            decisions.append(data.clone())  # TorchRL keeps references
            data = after
        return torch.stack(decisions)

    found, expected = played(OwnBuffers(7)), played(CountingEnv(7))
    for key in expected.keys(True, True):
        torch.testing.assert_close(found[key], expected[key], msg=str(key))


def integers(spec):
    env = CountingEnv(7)
    env.action_spec = spec
    return env


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_history_has_the_precision_of_the_actions(dtype):
    env = TransformedEnv(integers(Unbounded((ACTION_DIM,), dtype=dtype)), policy_transforms(PRIOR))
    data = env.reset()
    chunk = torch.full((H, ACTION_DIM), -3.31)
    after = env.step(data.set(keys.CHUNK, chunk))["next"]
    for place in (data, after):
        assert place["history", "actions"].dtype == place["history", "forecast"].dtype == dtype
    torch.testing.assert_close(after["history", "actions"].float(), chunk)


WHOLE = [
    (Bounded(0, 9, (ACTION_DIM,), dtype=torch.int32), "[4, 2] of torch.int32"),
    (MultiCategorical([5] * ACTION_DIM), "MultiCategorical [4, 2]"),
    (OneHot(ACTION_DIM), "OneHot [4, 2] of torch.bool"),
]


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize(("spec", "kind"), WHOLE)
def test_whole_numbers_are_no_actions_without_a_normaliser_either(place, spec, kind):
    """The simulator would get real numbers, and the buffers of workers would cut them."""
    with raises(TypeError, kind.replace("[", "[2, ") if "outside" in place else kind, "rounds"):
        placed(place, lambda: policy_transforms(PRIOR), (9, 9), lambda n: integers(spec)).reset()


class Rounded(Transform):
    """Gives an environment whole numbers for a policy's real ones."""

    def __init__(self):
        super().__init__(in_keys_inv=["action"], out_keys_inv=["action"])

    def _inv_apply_transform(self, action):
        return action.round().to(torch.int32)

    def transform_input_spec(self, input_spec):
        leaf = input_spec["full_action_spec", "action"]
        input_spec["full_action_spec", "action"] = Bounded(0.0, 9.0, leaf.shape)
        return input_spec


def test_rounded_numbers_are():
    env = TransformedEnv(integers(WHOLE[0][0]), Compose(Rounded(), *policy_transforms(PRIOR)))
    after = env.step(env.reset().set(keys.CHUNK, torch.full((H, ACTION_DIM), 3.31)))["next"]
    assert after["observation"][-1, 2:].tolist() == [3.0] * ACTION_DIM
    assert torch.equal(after["history", "actions"], torch.full((H, ACTION_DIM), 3.31))


@pytest.mark.parametrize("dtype", [torch.int64, torch.bool, torch.uint8])
def test_windows_and_policies_of_whole_numbers(dtype):
    data = demonstrations(40, 10, d_a=2)
    data["action"] = (data["action"] > data["action"].mean()).to(dtype)
    scaler = Normalizer.fit(data)
    windows = window_replay_buffer(scaler.normalize(data), PRIOR, batch_size=8, observation_steps=1)
    plain = window_replay_buffer(data, PRIOR, batch_size=8, observation_steps=1)
    for buffer, values in ((windows, [-1.0, 1.0]), (plain, [0.0, 1.0])):
        batch = buffer.sample()
        for key in (keys.CHUNK, ("history", "actions")):
            assert batch[key].dtype == torch.float32
        assert set(batch[keys.CHUNK].unique().tolist()) <= set(values)
    actor = mlp_actor(PRIOR, observation_dim=3, steps=1, normalizer=scaler)
    assert actor(windows.sample())[keys.CHUNK].dtype == torch.float32


def every_second(tensordict):
    """Skip where the last decision executed something."""
    return tensordict[keys.EXECUTED] > 0


class Repeats(FrameSkipTransform):
    """It repeats actions, but not as often as ``frame_skip`` says."""


def test_a_chunk_is_not_repeated():
    env = TransformedEnv(CountingEnv(30), Compose(*policy_transforms(PRIOR), Repeats(1)))
    refuses(lambda: env.reset(), RuntimeError, "FrameSkipTransform", "before")
    env = TransformedEnv(CountingEnv(30), Compose(*policy_transforms(PRIOR), FrameSkipTransform(2)))
    refuses(lambda: env.reset(), RuntimeError, "FrameSkipTransform", "before")
    for before, after in ([FrameSkipTransform(2)], []), ([], [FrameSkipTransform(1)]):
        env = TransformedEnv(CountingEnv(30), Compose(*before, *policy_transforms(PRIOR), *after))
        assert env.step(POLICY(env.reset()))["next", keys.EXECUTED] == H


@pytest.mark.parametrize("rows", [(), (9, 30)])
def test_a_skipped_decision_changes_nothing(rows):
    base = SerialEnv(2, [partial(CountingEnv, n) for n in rows]) if rows else CountingEnv(30)
    env = TransformedEnv(base, Compose(*policy_transforms(PRIOR), ConditionalSkip(every_second)))
    data = env.reset()
    for i in range(4):
        before = data.clone()
        step = env.step(POLICY(data))
        after, data = step["next"], env.step_mdp(step)
        if i % 2:
            assert not after[keys.EXECUTED].any() and not after["reward"].any()
            for key in ("observation", *(("history", name) for name in ("actions", "steps", "forecast"))):
                torch.testing.assert_close(after[key], before[key], msg=str(key))
        else:
            assert (after[keys.EXECUTED] == H).all()


def test_a_row_may_skip_its_decision():
    def second_row(tensordict):
        return torch.tensor([[False], [True]])

    base = SerialEnv(2, [partial(CountingEnv, 9)] * 2)
    env = TransformedEnv(base, Compose(*policy_transforms(PRIOR), ConditionalSkip(second_row)))
    data = env.reset()
    after = env.step(POLICY(data))["next"]
    assert after[keys.EXECUTED].flatten().tolist() == [H, 0]
    assert after["reward"].flatten().tolist() == [10.0, 0.0]
    torch.testing.assert_close(after["observation"][1], data["observation"][1])
    assert not after["history", "steps"][1].any()


def test_single_steps_are_not_skipped():
    skip = ConditionalSkip(lambda tensordict: torch.tensor([False]))
    transforms = Compose(ObservationStack(1), skip, ChunkStep(H), ActionHistory(H))
    env = TransformedEnv(CountingEnv(9), transforms)
    refuses(lambda: env.rollout(2, POLICY), RuntimeError, "ConditionalSkip")


def test_single_steps_are_not_skipped_by_a_part_of_a_part_either():
    skip = ConditionalSkip(lambda tensordict: torch.tensor([False]))
    env = TransformedEnv(CountingEnv(9), Compose(Compose(skip), *policy_transforms(PRIOR)))
    refuses(lambda: env.rollout(2, POLICY), RuntimeError, "ConditionalSkip")


def test_another_policy_does_not_act_within_a_chunk():
    """The history would lack its actions; between two chunks it is a decision like others."""

    def switch(policy, place):
        return ConditionalPolicySwitch(policy, lambda data: data["observation"].flatten()[place] == 2)

    single = switch(lambda data: data.set("action", torch.ones(ACTION_DIM)), 0)
    env = TransformedEnv(CountingEnv(9), Compose(single, *policy_transforms(PRIOR, observation_steps=1)))
    refuses(lambda: env.rollout(2, POLICY), RuntimeError, "ConditionalPolicySwitch")
    transforms = policy_transforms(PRIOR, observation_steps=1, execute=2)
    env = TransformedEnv(CountingEnv(9), Compose(*transforms, switch(POLICY, 0)))
    after = env.step(POLICY(env.reset()))["next"]
    assert after["history", "steps"] == after["observation"][0, 0] == 4
    torch.testing.assert_close(after["history", "actions"][-1], after["observation"][0, 2:])


class Doubled(Compose):
    def _step(self, tensordict, next_tensordict):
        result = super()._step(tensordict, next_tensordict)
        return result.set("reward", 2 * result["reward"])


def test_transforms_that_are_composed_of_others_step_as_wholes():
    """Their own part, which none of the others has, is that of each action of a chunk."""

    def rewards(kind):
        env = TransformedEnv(CountingEnv(9), Compose(kind(RewardScaling(0, 1)), *policy_transforms(PRIOR)))
        return env.rollout(3, POLICY)["next", "reward"]

    plain = rewards(Compose)
    assert plain.sum() > 0 and torch.equal(rewards(Doubled), 2 * plain)


def test_single_actions_are_no_chunk():
    env = TransformedEnv(CountingEnv(9), Compose(*policy_transforms(PRIOR), MultiAction()))
    refuses(lambda: env.rollout(2, POLICY), ValueError, f"[*B, {H}, d_a]")


@pytest.mark.parametrize("batch", [SerialEnv, None])
def test_single_steps_are_not_skipped_inside_of_workers_either(batch):
    def skipping():
        skip = ConditionalSkip(lambda tensordict: torch.tensor([False]))
        return TransformedEnv(CountingEnv(9), skip, auto_unwrap=False)

    base = skipping() if batch is None else batch(2, skipping)
    env = TransformedEnv(base, Compose(*policy_transforms(PRIOR)), auto_unwrap=False)
    refuses(lambda: env.rollout(2, POLICY), RuntimeError, "ConditionalSkip")
    env.close()


class Instructed(CountingEnv):
    """Says what to do in words, beside the observation."""

    def __init__(self, length):
        super().__init__(length)
        self.observation_spec["instruction"] = NonTensor(shape=())

    def _seen(self, out):
        return out.set("instruction", NonTensorData(f"step {self.t} of {self.length}"))


def instructions(base):
    env = TransformedEnv(base, policy_transforms(PRIOR))
    data, heard = env.reset(), []
    for _ in range(3):
        step, data = env.step_and_maybe_reset(POLICY(data))
        words = (place["instruction"] for place in (step, step["next"]))
        heard.append([[w] if isinstance(w, str) else list(w) for w in words])
    return heard


@pytest.mark.parametrize("kind", [SerialEnv, partial(ParallelEnv, mp_start_method="fork")])
def test_language_beside_the_observation(kind):
    lengths = (9, 6)
    env = kind(2, [partial(Instructed, n) for n in lengths])
    found, alone = instructions(env), [instructions(Instructed(n)) for n in lengths]
    assert found == [[[*a, *b] for a, b in zip(*step, strict=True)] for step in zip(*alone, strict=True)]
    assert found[1][1] == ["step 8 of 9", "step 6 of 6"]  # the second row rested for two steps
    env.close()


class Points(CountingEnv):
    """As many points as steps."""

    def __init__(self, length):
        super().__init__(length)
        self.observation_spec["points"] = Unbounded((length, 3))

    def _seen(self, out):
        return out.set("points", torch.full((self.length, 3), float(self.t)))


def test_observations_of_other_shapes_in_other_rows():
    lengths = (9, 6)
    inside = [lambda n=n: TransformedEnv(Points(n), policy_transforms(PRIOR)) for n in lengths]
    env = SerialEnv(2, inside)
    after = env.step(POLICY(env.reset()))["next"]
    assert [row["points"].unique().tolist() for row in after.unbind(0)] == [[4.0], [4.0]]
    env = TransformedEnv(SerialEnv(2, [partial(Points, n) for n in lengths]), policy_transforms(PRIOR))
    refuses(lambda: env.step(POLICY(env.reset())), RuntimeError, "['points']")


class PerAgent(CountingEnv):
    """Ends of three agents, at the root."""

    def __init__(self):
        super().__init__(9)
        flags = {
            n: Categorical(2, dtype=torch.bool, shape=(3, 1)) for n in ("done", "terminated", "truncated")
        }
        self.done_spec = Composite(flags)

    def _seen(self, out):
        return out.update({key: out[key].expand(3, 1).clone() for key in self.done_keys})


def test_environments_that_chunks_do_not_fit():
    discrete = TransformedEnv(GymEnv("Pendulum-v1"), ActionDiscretizer(num_intervals=5))
    for base, fact in ((PerAgent(), "[3, 1]"), (discrete, "ActionDiscretizer")):
        env = TransformedEnv(base, Compose(ObservationStack(1), ChunkStep(H)))
        zeros = torch.zeros(H, env.full_action_spec[keys.CHUNK].shape[-1])
        with raises(RuntimeError, fact):
            env.rollout(2, ChunkPolicy(lambda data, zeros=zeros: zeros))


def test_a_number_and_text_are_no_observations():
    data = demonstrations().set("observation", torch.zeros(60))
    refuses(lambda: window_replay_buffer(data, PRIOR, batch_size=4), ValueError, "'observation'")
    words = NonTensorStack(*["go"] * 60)
    group = TensorDict({"state": torch.zeros(60, 2), "task": words}, [60])
    for seen, key in ((words, "'observation'"), (group, "'task'")):
        with raises(ValueError, key, "text"):
            window_replay_buffer(demonstrations().set("observation", seen), PRIOR, batch_size=4)
    with raises(ValueError, "'frame'", "float32"):
        window_transforms(demonstrations(), PRIOR)(TensorDict({"frame": torch.zeros(2)}, [2]))
    for name, spec in (("observation", Unbounded(())), ("task", Composite(task=NonTensor(())))):
        env = CountingEnv(9)
        env.observation_spec = Composite(observation=spec)
        with raises(ValueError, f"'{name}'", "text", "UnsqueezeTransform"):
            _ = TransformedEnv(env, policy_transforms(PRIOR)).observation_spec


def test_a_state_is_not_stacked_but_its_copy_is():
    def make():
        env = CountingEnv(9)
        env.state_spec = env.observation_spec.clone()
        return env

    with raises(ValueError, "'observation'", "state", "RenameTransform"):
        TransformedEnv(make(), policy_transforms(PRIOR)).reset()
    copied = RenameTransform(["observation"], ["seen"], create_copy=True)
    env = TransformedEnv(make(), Compose(copied, policy_transforms(PRIOR, observation_key="seen")))
    steps = env.rollout(3)["next"]
    assert torch.equal(steps["seen"][:, -1], steps["observation"])


@pytest.mark.slow
def test_a_step_compiles_from_cold():
    env = TransformedEnv(CountingEnv(9), policy_transforms(PRIOR))
    step = torch.compile(env.step_and_maybe_reset, backend="eager")
    data, executed = env.reset(), []
    for _ in range(4):
        done, data = step(POLICY(data))
        executed.append(int(done["next", keys.EXECUTED]))
    assert executed == [H, H, 1, H]
