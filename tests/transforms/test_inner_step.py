from functools import partial

import pytest
import torch
from torchrl.data import Bounded, Unbounded
from torchrl.envs import (
    CatFrames,
    Compose,
    DoubleToFloat,
    ParallelEnv,
    SerialEnv,
    StepCounter,
    ToTensorImage,
    TransformedEnv,
)
from torchrl.envs.transforms import Transform, VecNormV2
from torchrl.envs.utils import check_env_specs

from tests.errors import refuses
from tests.states import same
from tests.toy_env import ACTION_DIM, ChunkPolicy, CountingEnv, closing
from warmprior import ChunkStep, ObservationStack
from warmprior.transforms.inner_step import InnerStep

H = 3
LENGTHS = (7, 4)


class SensorsEnv(CountingEnv):
    """The toy with a camera, ``"pixels"`` uint8 [2, 4, 3], and a float64 sensor, both the step."""

    def __init__(self, length=7):
        super().__init__(length)
        self.observation_spec["pixels"] = Bounded(0, 255, (2, 4, 3), dtype=torch.uint8)
        self.observation_spec["sensor"] = Unbounded((2,), dtype=torch.float64)

    def _seen(self, out):
        out["pixels"] = torch.full((2, 4, 3), 10 * self.t, dtype=torch.uint8)
        out["sensor"] = torch.full((2,), 1 / (3 + self.t), dtype=torch.float64)
        return out


CHANGES = {
    "dtype": partial(DoubleToFloat, in_keys=["sensor"]),
    "shape": partial(CatFrames, 2, dim=-1, in_keys=["sensor"]),
    "both": partial(ToTensorImage, in_keys=["pixels"]),
    "stack": partial(ObservationStack, 2),
}


def half(data):
    return torch.full((*data.batch_size, H, ACTION_DIM), 0.5)


def outside(batched, *transforms, lengths=LENGTHS):
    base = batched(len(lengths), [partial(SensorsEnv, n) for n in lengths])
    return TransformedEnv(base, Compose(*transforms))


@pytest.mark.parametrize(
    ("kind", "buffers", "change"),
    [
        *((SerialEnv, True, change) for change in CHANGES),
        (SerialEnv, False, "both"),
        (ParallelEnv, True, "both"),
        (ParallelEnv, False, "shape"),
    ],
)
def test_rows_end_inside_their_chunks_after_any_change_of_observations(kind, buffers, change):
    """What workers with the transforms inside give, where no row is ever left out."""
    batched = partial(kind, use_buffers=buffers)
    if kind is ParallelEnv:
        batched = partial(batched, mp_start_method="fork")

    def one(length):
        transforms = Compose(StepCounter(), CHANGES[change](), ChunkStep(H))
        return TransformedEnv(SensorsEnv(length), transforms)

    found = []
    for env in (
        outside(batched, StepCounter(), CHANGES[change](), ChunkStep(H)),
        SerialEnv(len(LENGTHS), [partial(one, n) for n in LENGTHS]),
    ):
        with closing(env):
            check_env_specs(env)
            env.reset()  # the toy counts its resets
            found.append(env.rollout(6, ChunkPolicy(half), break_when_any_done=False))
    for rollout in found:
        for part in (rollout, rollout["next"]):
            part["observation"][..., 1] = 0  # the episode's number
    ours, theirs = (dict(rollout.items(True, True)) for rollout in found)
    assert same(ours, theirs) and all(theirs[key].dtype == value.dtype for key, value in ours.items())


@pytest.mark.parametrize("change", CHANGES)
def test_a_row_that_rests_keeps_everything(change):
    env = outside(SerialEnv, StepCounter(), CHANGES[change](), ChunkStep(H), lengths=(20, 20))
    data = env.step_mdp(env.step(env.rand_action(env.reset())))
    before = data.clone()
    data = env.step(env.rand_action(data).set("_step", torch.tensor([False, True])))
    after = env.step_mdp(data)
    for key in set(env.observation_spec.keys(True, True)) - {"executed_steps"}:
        assert torch.equal(after[key][0], before[key][0]), key
    assert after["step_count"].flatten().tolist() == [H, 2 * H]
    assert after["observation"].reshape(2, -1)[:, -4].tolist() == [H, 2 * H]
    assert after["executed_steps"].flatten().tolist() == [0, H]
    assert set(data["next"].keys()) == set(env.fake_tensordict()["next"].keys())


class Difference(Transform):
    """The change of the sensor in a control step."""

    def _reset(self, tensordict, tensordict_reset):
        return tensordict_reset.set("change", torch.zeros_like(tensordict_reset["sensor"]))

    def _step(self, tensordict, next_tensordict):
        return next_tensordict.set("change", next_tensordict["sensor"] - tensordict["sensor"])

    def transform_observation_spec(self, observation_spec):
        return observation_spec.set("change", observation_spec["sensor"].clone())


@pytest.mark.parametrize("workers", [False, True])
def test_a_transform_may_read_what_was_before_while_another_row_rests(workers):
    transforms = [ChunkStep(H)] if workers else [Difference(), ChunkStep(H)]
    make = (lambda n: TransformedEnv(SensorsEnv(n), Difference())) if workers else SensorsEnv
    env = TransformedEnv(SerialEnv(2, [partial(make, n) for n in LENGTHS]), Compose(*transforms))
    steps = env.rollout(6, ChunkPolicy(half), break_when_any_done=False)["next"]
    before = 1 / (1 / steps["sensor"] - 1)
    torch.testing.assert_close(steps["change"], steps["sensor"] - before)


@pytest.mark.parametrize("nested", [False, True])
def test_statistics_see_every_control_step_once(nested):
    """Running statistics in the container, against the same steps one at a time."""
    chunked, plain = (VecNormV2(in_keys=["sensor"], decay=0.9) for _ in range(2))
    rest = (StepCounter(), ChunkStep(H))
    rest = (Compose(*rest),) if nested else rest
    env = TransformedEnv(SensorsEnv(12), Compose(chunked, *rest))
    single = TransformedEnv(SensorsEnv(12), Compose(plain))
    env.rollout(2)
    single.rollout(2 * H)
    for name, value in plain.state_dict().items():
        torch.testing.assert_close(chunked.state_dict()[name], value)


def test_outside_an_environment():
    refuses(lambda: InnerStep(ChunkStep(H)), RuntimeError, "ChunkStep")
