import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import (
    Compose,
    EnvBase,
    FlattenAction,
    FlattenObservation,
    RenameTransform,
    SerialEnv,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from tests.errors import raises, refuses
from tests.toy_env import CountingEnv, mlp_actor
from warmprior import (
    ActionHistory,
    ChunkStep,
    GaussianPrior,
    HistoryObservation,
    InferenceDelay,
    ObservationStack,
    PastPrior,
    PriorAnchor,
    PriorDecoder,
    policy_transforms,
)
from warmprior.deploy import AsyncExecutor
from warmprior.evaluation import play_episode

H, LENGTH = 3, 7


class TwoArms(EnvBase):
    """Sees the step, and the last actions of two arms, of one and two dimensions."""

    def __init__(self):
        super().__init__(batch_size=[])
        self.observation_spec = Composite(observation=Unbounded((4,)))
        self.action_spec = Composite(left=Composite(action=Bounded(-9, 9, (1,))), right=Bounded(-9, 9, (2,)))
        self.reward_spec = Unbounded((1,))
        self.done_spec = Categorical(2, dtype=torch.bool, shape=(1,))
        self.played = []

    def _observation(self):
        last = torch.cat(self.played[-1]) if self.played else torch.zeros(3)
        return torch.cat([torch.tensor([float(len(self.played))]), last])

    def _reset(self, tensordict=None, **kwargs):
        self.played = []
        return TensorDict({"observation": self._observation(), "done": torch.zeros(1, dtype=torch.bool)}, [])

    def _step(self, tensordict):
        self.played.append((tensordict["left", "action"], tensordict["right"]))
        done = torch.tensor([len(self.played) == LENGTH])
        out = {"observation": self._observation(), "reward": torch.ones(1), "done": done}
        return TensorDict({**out, "terminated": done}, [])

    def _set_seed(self, seed):
        pass


def actor(prior, action_dim, name, *parts):
    own = {f"{part}_key": (name, part) for part in ("history", "source", "chunk", *parts)}
    return mlp_actor(prior, action_dim, 4, steps=1, nfe=1, **own)


ARMS = (("left", 0), ("other", 2))


def own(name):
    return {"chunk_key": (name, "chunk"), "history_key": (name, "history")}


def histories_of(*names):
    return [ActionHistory(H, **own(name)) for name in names]


def two_arms(*more):
    chunks = [("left", "chunk"), ("other", "chunk")]
    step = ChunkStep(H, action_keys=[("left", "action"), "right"], chunk_keys=chunks)
    return TransformedEnv(TwoArms(), Compose(ObservationStack(1), step, *more))


def test_two_policies_act_side_by_side():
    left, right = actor(PastPrior(H), 1, "left"), actor(GaussianPrior(H), 2, "other")
    env = two_arms(*histories_of("left", "other"))
    check_env_specs(env)
    rollout = env.rollout(10, TensorDictSequential(left, right))
    assert rollout["next", "executed_steps"].flatten().tolist() == [3, 3, 1]
    assert rollout["next", "reward"].sum() == LENGTH
    for key, played in zip(("left", "other"), zip(*env.base_env.played, strict=True), strict=True):
        whole = rollout[key, "chunk"].flatten(0, 1)[:LENGTH]
        assert torch.equal(whole, torch.stack(played))
        assert torch.equal(rollout[key, "history", "actions"][1:], rollout[key, "chunk"][:-1])
    assert torch.equal(rollout["left", "source", "loc"][1:], rollout["left", "chunk"][:-1])
    assert not rollout["other", "source", "warm"].any()


def test_two_transforms_that_write_one_key_are_refused():
    for more in (
        histories_of("left"),
        [InferenceDelay(d, execute=H, **own(n)) for n, d in ARMS],
        [PriorAnchor(actor(GaussianPrior(H), 2, n)) for n, _ in ARMS],
        [HistoryObservation(history_key=(n, "history")) for n, _ in ARMS],
    ):
        with raises(ValueError, "overwrite"):
            two_arms(*histories_of("left", "other"), *more).rollout(1)


def test_what_knows_the_usual_keys_alone_says_so(tmp_path):
    policy = actor(PastPrior(H), 2, "left")
    env = TransformedEnv(CountingEnv(LENGTH), policy_transforms(PastPrior(H)))
    usual = "policy.replace(history_key='history', source_key='prior', chunk_key=('vla_action', 'chunk'))"
    for call in (
        lambda: PriorDecoder(policy, delta=0.5),
        lambda: AsyncExecutor(policy),
        lambda: play_episode(policy, env, 0),
    ):
        with raises(ValueError, usual):
            call()


@pytest.mark.parametrize("keys", [["right"], [("left", "action"), "right", "third"]])
def test_an_action_that_nobody_chooses_is_refused(keys):
    with raises(KeyError, "left", "right", "action_keys"):
        TransformedEnv(TwoArms(), ChunkStep(H, action_keys=keys, chunk_keys=keys)).rollout(1)
    refuses(lambda: ChunkStep(H, action_keys=keys, chunk_keys=[]), ValueError, "chunk_key", "action_key")


@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize("around", [lambda env: env, lambda env: SerialEnv(2, lambda: env)])
def test_a_group_of_agents_is_refused(n, around):
    def make_env():
        env = CountingEnv(LENGTH)
        env.observation_spec = Composite(agents=Composite(observation=Unbounded((n, 4)), shape=(n,)))
        env.action_spec = Composite(agents=Composite(action=Unbounded((n, 2)), shape=(n,)))
        return env

    policy, key = actor(PastPrior(H), 2, "agents", "observation"), ("agents", "action")
    for transforms in (
        lambda: policy_transforms(policy, action_key=key),
        lambda: ChunkStep(H, action_keys=[key]),
        lambda: ObservationStack(1, observation_key=("agents", "observation")),
    ):
        with raises(ValueError, "groups of agents", "FlattenObservation", "FlattenAction"):
            _ = TransformedEnv(around(make_env()), transforms()).specs
        with raises(ValueError, "groups of agents", "FlattenObservation", "FlattenAction"):
            _ = around(TransformedEnv(make_env(), transforms())).specs


class Agents(CountingEnv):
    """Three agents that see their own number, and the actions that they were given."""

    def __init__(self):
        super().__init__(LENGTH)
        self.observation_spec = Composite(agents=Composite(observation=Unbounded((3, 4)), shape=(3,)))
        self.action_spec = Composite(agents=Composite(action=Unbounded((3, 2)), shape=(3,)))
        self.given = []

    def _seen(self, out):
        seen = torch.arange(3.0)[:, None].expand(3, 4).clone()
        return out.exclude("observation").set("agents", TensorDict({"observation": seen}, [3]))

    def _step(self, tensordict):
        self.given.append(tensordict["agents", "action"])
        return super()._step(tensordict.set("action", self.given[-1][0]))


def test_a_centralised_policy_moves_a_group_as_one_vector():
    policy, base = mlp_actor(PastPrior(H), action_dim=6, observation_dim=12, steps=1), Agents()
    seen = FlattenObservation(-2, -1, [("agents", "observation")], ["observation"])
    moved = FlattenAction(in_keys_inv=[("agents", "action")], out_keys_inv=["action"])
    decisions = TransformedEnv(base, Compose(seen, moved, *policy_transforms(policy))).rollout(2, policy)
    assert decisions["observation"][0].tolist() == [[0.0] * 4 + [1.0] * 4 + [2.0] * 4]
    chunks = decisions["vla_action", "chunk"].flatten(0, 1)
    assert torch.equal(torch.stack(base.given), chunks.unflatten(-1, (3, 2)))
    renamed = RenameTransform([("agents", "observation")], ["observation"])
    env = TransformedEnv(Agents(), Compose(renamed, moved.clone(), *policy_transforms(policy)))
    refuses(lambda: env.rollout(1, policy), ValueError, "12", "3, 4", "FlattenObservation")


@pytest.mark.parametrize("inside", [False, True])
def test_nested_keys_of_one_policy(inside):
    policy = actor(PastPrior(H), 2, "left", "observation")

    def renamed():
        places = [("left", "observation")], ["action"], [("left", "action")]
        return TransformedEnv(CountingEnv(LENGTH), RenameTransform(["observation"], *places))

    def chunked(env):
        return TransformedEnv(env, policy_transforms(policy, action_key=("left", "action")))

    env = SerialEnv(2, lambda: chunked(renamed())) if inside else chunked(SerialEnv(2, renamed))
    check_env_specs(env)
    rollout = env.rollout(10, policy)
    assert rollout["next", "executed_steps"].squeeze(-1).tolist() == [[3, 3, 1]] * 2
    assert torch.equal(rollout["left", "source", "loc"][:, 1:], rollout["left", "chunk"][:, :-1])
