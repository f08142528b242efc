"""A LeRobot policy in TorchRL's environments, and frozen under an agent."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, check_env_specs, set_exploration_type

from tests.errors import refuses
from tests.lerobot.seen import watch
from tests.lerobot.tiny import ACTION, CAMERA, LENGTH, STATE
from tests.toy_env import CountingEnv
from warmprior import PastPrior, PreviewPrior, policy_transforms
from warmprior.history import ENTRIES, cold_history, window_history
from warmprior.lerobot import LeRobotActor
from warmprior.lerobot.names import entry_names
from warmprior.rl import PriorDecoder


class Arm(CountingEnv):
    """A state that sums up actions, and a picture of it."""

    def __init__(self) -> None:
        super().__init__(length=20)
        seen = {"state": Unbounded((STATE,)), "top": Bounded(0, 255, (3, 64, 64), dtype=torch.uint8)}
        self.observation_spec = Composite(observation=Composite(**seen))
        self.action_spec = Unbounded((ACTION,))

    def _reset(self, tensordict=None, **kwargs):
        self.at = torch.zeros(STATE)
        return super()._reset(tensordict)

    def _step(self, tensordict):
        self.at = self.at + tensordict["action"][:STATE]
        return super()._step(tensordict)

    def _seen(self, out):
        seen = {"state": self.at.clone(), "top": torch.full((3, 64, 64), self.t, dtype=torch.uint8)}
        return out.set("observation", TensorDict(seen, []))


NAMES = {"state": "observation.state", "top": CAMERA}


def preprocessed(batch):
    """What a preprocessor would add: the task in tokens."""
    tokens = torch.full((len(batch["observation.state"]), 5), 7)
    mask = torch.ones_like(tokens, dtype=torch.bool)
    return {**batch, "observation.language.tokens": tokens, "observation.language.attention_mask": mask}


def history_of(actions):
    """That of robots which executed these, ``[*B, H, d_a]``."""
    steps = torch.full((*actions.shape[:-2], 1), actions.shape[-2])
    return window_history(actions, steps, torch.zeros_like(actions), actions.shape[-2])


def actor_of(made, prior, **options):
    options = {"generator": torch.Generator().manual_seed(0)} | options
    return LeRobotActor(made, prior, names=NAMES, preprocess=preprocessed, **options)


@pytest.mark.parametrize("family", ["smolvla", "xvla"])
@pytest.mark.parametrize("prior", [PastPrior(LENGTH, sigma=0.0), PreviewPrior(LENGTH // 2, sigma=0.0)])
def test_rollouts_start_from_the_mean(policy, family, prior):
    made = policy(family)
    env = TransformedEnv(Arm(), policy_transforms(prior, observation_steps=1))
    actor = actor_of(made, prior)
    check_env_specs(env)
    with watch(family, made) as seen:
        rollout = env.rollout(4, actor, break_when_any_done=False)
    calls = len(seen.x) // 4
    starts = [x[0, : prior.prediction_length, :ACTION] for x in seen.x[::calls]]
    warm = rollout["prior", "warm"][:, 0, 0].tolist()
    assert warm == [False, True, True, prior.chunk_length < LENGTH]  # 20 steps are three chunks
    half = prior.chunk_length
    for step in range(1, 4):
        if warm[step]:
            assert torch.equal(starts[step][:half], rollout["prior", "loc"][step, :half])
    for start, noise in zip(starts, rollout["prior", "noise"], strict=True):
        assert torch.equal(start, noise)
    if prior.chunk_length == LENGTH:
        assert torch.equal(rollout["prior", "loc"][1], rollout["vla_action", "chunk"][0])
    whole, selected = actor_of(made, prior), actor_of(made, prior).select_out_keys(("vla_action", "chunk"))
    one, other = (policy(rollout.select("observation", "history")) for policy in (whole, selected))
    history = {f"history_{name}": rollout["history", name] for name in ENTRIES}
    generator = torch.Generator().manual_seed(0)
    *_, dispatched = whole(observation=rollout["observation"], **history, generator=generator)
    for chunk in (other["vla_action", "chunk"], dispatched):
        assert torch.equal(one["vla_action", "chunk"], chunk)


def test_several_observations_and_the_lead_of_a_chunk(policy):
    made, prior = policy("multi_task_dit"), PastPrior(LENGTH - 1, sigma=0.0)
    actor = LeRobotActor(made, prior, names=NAMES, preprocess=preprocessed)
    history = history_of(torch.randn(3, LENGTH - 1, ACTION))
    data = TensorDict({"observation": {"state": torch.randn(3, 2, STATE)}, "history": history}, [3])
    with watch("multi_task_dit", made) as seen:
        chunk = actor(data)["vla_action", "chunk"]
    assert torch.equal(seen.x[0][:, 1:], data["history", "actions"])
    assert torch.equal(data["prior", "loc"], data["history", "actions"])
    by_hand = seen.x[0] + sum(seen.out) / len(seen.out)
    torch.testing.assert_close(chunk, by_hand[:, 1:])
    short = data.clone().update({"observation": {"state": torch.randn(3, 1, STATE)}})
    refuses(lambda: actor(short), ValueError, "1 of 2", "ObservationStack(2)")


def test_tokens_may_be_observations_and_states_whole_numbers(policy):
    made, prior = policy("smolvla"), PastPrior(LENGTH)
    seen = {"state": torch.arange(STATE).expand(2, 1, STATE), "top": torch.zeros(2, 1, 3, 64, 64).byte()}
    data = TensorDict({"observation": seen, "history": history_of(torch.randn(2, LENGTH, ACTION))}, [2])
    expected = actor_of(made, prior)(data.clone())["vla_action", "chunk"]
    more = {name: f"observation.language.{name}" for name in ("tokens", "attention_mask")}
    for name, value in zip(more, (torch.tensor(7), torch.tensor(True)), strict=True):
        data["observation", name] = value.expand(2, 1, 5)
    actor = LeRobotActor(made, prior, names=NAMES | more, generator=torch.Generator().manual_seed(0))
    assert torch.equal(actor(data)["vla_action", "chunk"], expected)


def test_the_rest_of_the_source_is_drawn_anew_for_actors_and_fixed_for_decoders(policy):
    made, prior = policy("multi_task_dit"), PastPrior(LENGTH - 1, sigma=0.0)
    actor = actor_of(made, prior)
    observation = torch.randn(1, 2, STATE).expand(2, -1, -1)
    loc = torch.randn(1, LENGTH - 1, ACTION).expand(2, -1, -1)
    data = TensorDict({"observation": {"state": observation}, "history": history_of(loc)}, [2])
    with watch("multi_task_dit", made) as seen:
        for _ in range(2):
            actor(data.clone())
        acted = torch.cat([x[:, 0] for x in seen.x[:: len(seen.x) // 2]])
    assert torch.cdist(acted, acted).add(torch.eye(4)).min() > 1e-3  # two decisions of two rows
    with watch("multi_task_dit", made) as seen, set_exploration_type(ExplorationType.DETERMINISTIC):
        chunks = [actor(data.clone())["vla_action", "chunk"] for _ in range(2)]
    assert torch.equal(*chunks) and not seen.x[0][:, 0].any()
    data["prior", "noise"] = loc.contiguous()
    with watch("multi_task_dit", made) as seen:
        chunks = [actor.ode(data.clone())["vla_action", "chunk"] for _ in range(2)]
        decoded = torch.cat([x[:, 0] for x in seen.x[:: len(seen.x) // 2]])
    assert torch.equal(decoded, decoded[:1].expand(4, -1))
    assert torch.equal(*chunks)
    refuses(lambda: actor.ode(data.clone(), padding=torch.zeros(2, 3, 4)), ValueError, "padding", "[2, 3, 4]")


def test_a_frozen_policy_decodes_what_an_agent_chooses(policy):
    made, prior = policy("pi05"), PastPrior(LENGTH)
    actor = actor_of(made, prior, nfe=1)
    decoder = PriorDecoder(actor, delta=0.5)
    assert not list(decoder.parameters())
    anchor, delta = torch.randn(2, LENGTH, ACTION), torch.full((2, LENGTH, ACTION), 0.25)
    seen = {"state": torch.randn(2, 1, STATE), "top": torch.zeros(2, 1, 3, 64, 64, dtype=torch.uint8)}
    data = TensorDict({"observation": seen, "prior": {"anchor": anchor, "delta": delta}}, [2])
    copy = decoder.ode.policy
    assert copy is not made
    with watch("pi05", copy) as seen:
        chunk = decoder(data.clone())["vla_action", "chunk"]
    assert torch.equal(seen.x[0][..., :ACTION], anchor + delta)
    torch.testing.assert_close(chunk, (seen.x[0] - seen.out[0])[..., :ACTION])
    # A function of the source alone, whatever else is in the batch.
    assert torch.equal(decoder(data.clone())["vla_action", "chunk"], chunk)
    decoder.select_out_keys(("vla_action", "chunk"))
    torch.testing.assert_close(decoder(data[1:].clone())["vla_action", "chunk"], chunk[1:])


def test_decisions_of_several_threads_take_turns(policy):
    made = policy("smolvla")
    actors = [actor_of(made, PastPrior(LENGTH), nfe=1, generator=None) for _ in range(2)]
    history = cold_history([1], LENGTH, LENGTH, ACTION)
    data = TensorDict({"observation": Arm().reset()["observation"][None, None], "history": history}, [1])
    with ThreadPoolExecutor(4) as pool:
        chunks = [pool.submit(actors[i % 2], data.clone()) for i in range(40)]
    assert all(chunk.result()["vla_action", "chunk"].isfinite().all() for chunk in chunks)
    assert "sample_actions" not in vars(made.model)  # the sampler is the policy's own again


def test_names_of_cameras_that_end_alike_or_do_not_exist():
    images = [f"observation.images.{name}" for name in ("left.rgb", "right.rgb", "top", "empty_camera_0")]
    names = entry_names(["observation.state", *images])
    assert list(names) == ["state", "left.rgb", "right.rgb", "top"]
    assert list(names.values()) == ["observation.state", *images[:3]]
