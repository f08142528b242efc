"""A deterministic environment whose returns, lengths and observations are known in closed form; histories."""

from contextlib import contextmanager
from functools import partial

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase, ParallelEnv, SerialEnv, TransformedEnv

from warmprior import ActionWindow, PastPrior, Prior, StartPoint, VelocityMLP, WarmPriorActor
from warmprior.history import advance, cold_history, without

ACTION_DIM = 2


def demonstrations(steps=60, length=20, d_o=3, d_a=2):
    """Random contiguous steps, actions in [-1, 1]."""
    generator = torch.Generator().manual_seed(0)
    data = {
        "observation": torch.randn(steps, d_o, generator=generator),
        "action": torch.rand(steps, d_a, generator=generator) * 2 - 1,
        "episode": torch.arange(steps) // length,
    }
    return TensorDict(data, [steps])


def window_histories(actions, frames, chunk_length):
    """Histories of an episode's training windows, at some of its steps."""
    steps = {"observation": torch.zeros(len(actions), 1), "action": actions}
    steps["episode"] = torch.zeros(len(actions), dtype=torch.int64)
    window = ActionWindow(TensorDict(steps, [len(actions)]), chunk_length)
    return window(TensorDict({"frame": frames}, frames.shape))["history"]


def ends_of(*batch):
    """The specification of an episode's ends."""
    names = ("done", "terminated", "truncated")
    return Composite({n: Categorical(2, dtype=torch.bool, shape=(*batch, 1)) for n in names}, shape=batch)


class CountingEnv(EnvBase):
    """Observation ``[step, episode, *last action]``; reward ``step`` at each step; ends after ``length``."""

    def __init__(self, length: int = 7, truncate: bool = False, device: str | None = "cpu") -> None:
        super().__init__(device=device, batch_size=[])
        self.length, self.truncate = length, truncate
        self.observation_spec = Composite(observation=Unbounded((2 + ACTION_DIM,)))
        self.action_spec = Bounded(-1, 1, (ACTION_DIM,))
        self.reward_spec = Unbounded((1,))
        self.done_spec = ends_of()
        self.t, self.episode = 0, -1

    def _seen(self, out: TensorDict) -> TensorDict:
        """Of classes that show more than this one: what a reset or a step returns."""
        return out

    def _observation(self, action: torch.Tensor) -> torch.Tensor:
        return torch.cat([torch.tensor([float(self.t), float(self.episode)]), action])

    def _reset(self, tensordict=None, **kwargs):
        self.t = 0
        self.episode += 1
        out = TensorDict({"observation": self._observation(torch.zeros(ACTION_DIM))}, [])
        return self._seen(out.update(self.full_done_spec.zero()))

    def _step(self, tensordict):
        self.t += 1
        done = torch.tensor([self.t >= self.length])
        never = torch.zeros(1, dtype=torch.bool)
        out = {
            "observation": self._observation(tensordict["action"]),
            "reward": torch.tensor([float(self.t)]),
            "done": done,
            "terminated": never if self.truncate else done,
            "truncated": done if self.truncate else never,
        }
        return self._seen(TensorDict(out, []))

    def _set_seed(self, seed):
        return seed


class ChunkPolicy(TensorDictModuleBase):
    """A policy from a function ``tensordict -> chunk [*B, P, d_a]``."""

    def __init__(self, chunk) -> None:
        super().__init__()
        self.in_keys, self.out_keys = ["observation"], [("vla_action", "chunk")]
        self.chunk = chunk

    def forward(self, tensordict):
        return tensordict.set(self.out_keys[0], self.chunk(tensordict))


def random_history(prior, *batch, action_dim: int = ACTION_DIM, seed: int = 0, cold: float = 0.5):
    """Histories after ``H`` executed actions, of which about a share is cold."""
    generator = torch.Generator().manual_seed(seed)
    shape = prior.history_length, prior.prediction_length, action_dim
    chunk = torch.randn(*batch, *shape[1:], generator=generator)
    executed = torch.full((*batch, 1), prior.chunk_length)
    history = advance(cold_history(batch, *shape), chunk, executed)
    return without(history, torch.rand(batch, generator=generator) < cold)


def mlp_actor(
    prior, action_dim=ACTION_DIM, observation_dim=2 + ACTION_DIM, steps=2, hidden_dim=8, seed=0, **options
):
    """A policy with a small network."""
    torch.manual_seed(seed)
    network = VelocityMLP(action_dim, observation_dim, prior.prediction_length, steps, hidden_dim=hidden_dim)
    return WarmPriorActor(network, prior, **options)


def stirred(module, by=0.1):
    """The same with other parameters: the last layer of networks begins at zero."""
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.add_(by * torch.randn_like(parameter))
    return module


@contextmanager
def closing(env):
    """An environment that is closed behind its use, by whomever."""
    try:
        yield env
    finally:
        env.close(raise_if_closed=False)


PLACES = ("single", "serial-outside", "serial-inside", "parallel-outside", "parallel-inside")


def placed(place, make_transforms, lengths, make_env=CountingEnv):
    """Environments of these lengths, with transforms inside of workers or common ones outside."""

    def one(length):
        return TransformedEnv(make_env(length), make_transforms())

    if place == "single":
        return one(lengths[0])
    batched = SerialEnv if "serial" in place else partial(ParallelEnv, mp_start_method="fork")
    if place.endswith("inside"):
        return batched(len(lengths), [partial(one, n) for n in lengths])
    return TransformedEnv(batched(len(lengths), [partial(make_env, n) for n in lengths]), make_transforms())


class Momentum(Prior):
    """Goes on as the last two actions did."""

    name = "momentum-of-the-tests"

    def mean(self, history):
        before, last = history["actions"][..., -2:-1, :], history["actions"][..., -1:, :]
        ahead = torch.arange(1, self.prediction_length + 1).view(-1, 1)
        warm = (history["steps"] >= 2).unsqueeze(-1)
        return last + ahead * (last - before), warm.expand_as(history["forecast"][..., :1])


class Learned(PastPrior, nn.Module):
    """A source whose shift is trained with the network."""

    name = "learned-of-the-tests"

    def __init__(self, chunk_length, *, action_dim=ACTION_DIM):
        nn.Module.__init__(self)
        super().__init__(chunk_length)
        self.action_dim = action_dim
        self.shift = nn.Parameter(torch.zeros(action_dim))
        self.register_buffer("offset", torch.zeros(()))

    def mean(self, history):
        loc, warm = super().mean(history)
        return loc + self.shift + self.offset, warm


class Halfway(StartPoint):
    """Enters the flow at the time 0.5, with half of the noise around the last action and a weight."""

    name = "halfway-of-the-tests"
    time = noise_share = 0.5

    def __init__(self, initial=0.0):
        nn.Module.__init__(self)
        self.initial = initial
        self.shift = nn.Parameter(torch.full((), initial))

    def centre(self, history, observation):
        return history["actions"][..., -1:, :].expand_as(history["forecast"]) + self.shift

    def forward(self, noise, history, observation):
        return self.centre(history, observation) + self.noise_share * noise
