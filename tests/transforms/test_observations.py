from functools import partial

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs.utils import check_env_specs

from tests.errors import refuses
from tests.toy_env import ACTION_DIM, PLACES, CountingEnv, closing, placed
from warmprior import (
    ActionWindow,
    FlowMatchingLoss,
    GaussianPrior,
    PastPrior,
    VelocityNetwork,
    WarmPriorActor,
    policy_transforms,
)
from warmprior.saving.policies import load_policy, save_policy

H, TO = 3, 2
LENGTHS = (7, 4)
IMAGE = (3, 2, 8)


class CameraEnv(CountingEnv):
    """The toy with an image of its step beside its state: flat, alone, or nested."""

    def __init__(self, length=7, layout="nested"):
        super().__init__(length)
        self.layout = layout
        state, image = Unbounded((4,)), Bounded(0, 255, IMAGE, dtype=torch.uint8)
        self.observation_spec = {
            "image": Composite(observation=image),
            "nested": Composite(observation=Composite(state=state, pixels=image)),
            "named": Composite(sensors=Composite(low=Composite(joints=state))),
        }[layout]

    def _seen(self, out):
        state = out.pop("observation")
        state[1] = 0  # the episode's number
        image = torch.full(IMAGE, 20 * self.t, dtype=torch.uint8)
        if self.layout == "image":
            return out.set("observation", image)
        if self.layout == "nested":
            return out.set("observation", TensorDict({"state": state, "pixels": image}, []))
        return out.set(("sensors", "low", "joints"), state)


NAMES = {"image": {}, "nested": {}, "named": {"observation_key": ("sensors", "low", "joints")}}


class Encoder(VelocityNetwork):
    """Takes any observation; its velocity shows all of it."""

    def __init__(self, action_dim, observation_dim, prediction_length, observation_steps):
        super().__init__(action_dim, observation_dim, prediction_length, observation_steps)
        self.weight = nn.Parameter(torch.tensor(0.125))

    def forward(self, t, a, observation):
        self.check_chunk(a)
        entries = observation.values() if isinstance(observation, TensorDictBase) else [observation]
        code = sum(
            (entry.to(a.dtype).flatten(2).mean(-1) @ torch.tensor([1.0, 3.0]))[:, None, None]
            for entry in entries
        )
        return self.weight * code / 100 - 0.1 * a


def build(place, layout, prior, **options):
    transforms = partial(policy_transforms, prior, observation_steps=TO, **NAMES[layout], **options)
    return placed(place, transforms, LENGTHS, partial(CameraEnv, layout=layout))


def replay(layout, chunks, length):
    """Demonstrations: the control steps of an episode in which these chunks were executed."""
    env, rows = CameraEnv(length, layout), []
    data = env.reset()
    for action in chunks.flatten(0, 1)[:length]:
        rows.append(data.exclude("done", "terminated", "truncated").set("action", action))
        data = env.step_mdp(env.step(data.set("action", action)))
    data = torch.stack([row.select(*env.observation_keys, "action") for row in rows])
    return data.set("episode", torch.zeros(length, dtype=torch.int64))


@pytest.mark.parametrize(
    ("place", "layout"),
    [*((place, "nested") for place in PLACES), ("single", "image"), ("serial-outside", "named")],
)
def test_a_decision_in_the_environment_is_a_window_of_its_recording(place, layout, tmp_path):
    """What the actor met when it decided, in shape, dtype and value, is what it is trained on."""
    prior, names = PastPrior(H), NAMES[layout]
    torch.manual_seed(0)
    actor = WarmPriorActor(Encoder(ACTION_DIM, 4, H, TO), prior, nfe=2, clip=1.0, **names)
    save_policy(actor, tmp_path)
    actor = load_policy(tmp_path)
    chunk_key = ("vla_action", "chunk")
    with closing(build(place, layout, prior)) as env, torch.no_grad():
        check_env_specs(env)
        rollout = env.rollout(6, actor, break_when_any_done=False)
    rollout = rollout[None] if place == "single" else rollout
    loss = FlowMatchingLoss(actor)
    observation_key = names.get("observation_key", "observation")
    for row, length in zip(rollout, LENGTHS, strict=False):
        decisions = -(-length // H)
        row = row[:decisions]
        ends = [min(start + H, length) for start in range(0, length, H)]
        played, after = [range(i * H + 1, end + 1) for i, end in enumerate(ends)], row["next"]
        assert after["executed_steps"].flatten().tolist() == [len(steps) for steps in played]
        assert after["reward"].flatten().tolist() == [sum(steps) for steps in played]
        assert after["done"].flatten().tolist() == [end == length for end in ends]
        data = replay(layout, row[chunk_key], length)
        window = ActionWindow(data, H, observation_steps=TO, **names)
        frames = torch.arange(decisions) * H
        windows = window(TensorDict({"frame": frames}, [decisions]))
        read = row.select(observation_key, *actor.in_keys[1:])
        for key, value in read.items(True, True):
            assert windows[key].dtype == value.dtype
            assert torch.equal(windows[key], value), key
        counted = ~windows["action_is_pad"]
        assert torch.equal(windows[chunk_key][counted], row[chunk_key][counted])
        row["action_is_pad"] = windows["action_is_pad"]
        losses = []
        for batch in (windows, row):
            loss.generator = torch.Generator().manual_seed(1)
            losses.append(loss(batch)["loss_flow_matching"])
        losses[0].backward()
        assert torch.equal(*losses)


@pytest.mark.parametrize("place", ["single", "serial-inside", "parallel-outside"])
def test_the_last_actions_are_appended_to_the_vector_among_several(place):
    with closing(build(place, "nested", GaussianPrior(H), see_history=True)) as env:
        check_env_specs(env, break_when_any_done="both")
        rollout = env.rollout(3, break_when_any_done=False)
    seen, own = rollout["prior", "observation"], rollout["observation"]
    assert torch.equal(seen["pixels"], own["pixels"])
    known = (rollout["history", "steps"] >= H).float()
    actions = rollout["history", "actions"].flatten(-2)
    added = torch.cat([known * actions, known], -1).unsqueeze(-2)
    expected = torch.cat([own["state"], added.expand(*own["state"].shape[:-1], -1)], -1)
    assert torch.equal(seen["state"], expected) and bool(added.any())


@pytest.mark.parametrize(("shape", "dtype"), [((9,), None), ((9, 2, 2), None), ((9, 2), torch.complex64)])
def test_windows_refuse_actions_that_are_no_vector_of_numbers(shape, dtype):
    actions = torch.zeros(shape, dtype=dtype)
    data = TensorDict({"observation": torch.zeros(9, 3), "action": actions}, [9])
    data["episode"] = torch.zeros(9, dtype=torch.int64)
    refuses(lambda: ActionWindow(data, H), ValueError, "'action'", "[N, d_a]", "(9")
