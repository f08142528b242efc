"""A task of a user's own whose comparisons take seconds."""

from dataclasses import replace
from itertools import count

import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite, Unbounded

from tests.benchmarks.script_parts import command_line
from tests.toy_env import CountingEnv
from warmprior import PastPrior
from warmprior.data import demonstrations_of
from warmprior.tasks import Play, Task

H, OBSERVATION_DIM, ACTION_DIM = 4, 19, 7


class DriftEnv(CountingEnv):
    """A state that drifts with the actions from a start by seed; the task is to go to one side.

    Episodes last 9 to 15 steps. It measures how far it is on that side.
    """

    def __init__(self):
        super().__init__(length=9)
        self.seed_ = 0
        flag = Categorical(2, dtype=torch.bool, shape=(1,))
        seen = {"observation": Unbounded((OBSERVATION_DIM,)), "solved": flag, "side": Unbounded((1,))}
        self.observation_spec = Composite(seen)
        self.action_spec = Bounded(-1, 1, (ACTION_DIM,))

    def _set_seed(self, seed):
        self.seed_, self.length = seed, 9 + seed % 7

    def _seen(self, out):
        side = self.state[:ACTION_DIM].sum().reshape(1)
        seen = {"observation": self.state.clone(), "solved": out["done"] & (side > 0), "side": side}
        return out.update(seen)

    def _reset(self, tensordict=None, **kwargs):
        self.state = torch.randn(OBSERVATION_DIM, generator=torch.Generator().manual_seed(self.seed_))
        return super()._reset(tensordict)

    def _step(self, tensordict):
        self.state[:ACTION_DIM] += 0.4 * tensordict["action"]
        return super()._step(tensordict)


def demonstrations(seed=0):
    generator, lengths = torch.Generator().manual_seed(seed), [30, 5, 40]
    numbers = torch.randn(75, OBSERVATION_DIM + ACTION_DIM, generator=generator)
    seen, actions = numbers.split([OBSERVATION_DIM, ACTION_DIM], -1)
    seen = torch.cat([part.cumsum(0) for part in seen.split(lengths)])
    episode = torch.arange(3).repeat_interleave(torch.tensor(lengths))
    return TensorDict({"observation": seen, "action": actions.tanh(), "episode": episode}, [75])


def task(options=None, seed=0, name="drift", make_env=DriftEnv, success="solved"):
    """Named as ``--task tests.benchmarks.drift:task``."""
    play = Play(make_env, success=success, measures={"side": "max"})
    return Task(demonstrations_of(demonstrations(seed), name, style="own"), play=play)


drawn = count()


def unseeded(options):
    """With other demonstrations each time they are read."""
    return task(options, seed=next(drawn))


def other(options):
    return task(options, seed=1)


def renamed(options):
    """The same as another task."""
    return task(options, name="Drift 2")


class Broken(DriftEnv):
    """Built and reset like the other, and no further."""

    def _step(self, tensordict):
        raise RuntimeError("a cable is loose")


def mute(options):
    """With an environment that does not say whether it is solved."""
    return task(options, success="won")


def narrow(options):
    data = demonstrations()
    data["observation"] = data["observation"][:, 1:]
    return Task(demonstrations_of(data, "drift", style="own"), play=Play(DriftEnv, success="solved"))


def broken(options):
    return task(options, make_env=Broken)


class Widening(PastPrior, torch.nn.Module):
    """A source whose noise is learnt with the flow."""

    name = "widening"

    def __init__(self, chunk_length, *, sigma=0.5):
        torch.nn.Module.__init__(self)
        super().__init__(chunk_length, sigma=sigma)
        self.scale = torch.nn.Parameter(torch.ones(()))

    def distribution(self, history, observation=None):
        source = super().distribution(history, observation)
        return replace(source, scale=self.scale * source.scale)


def arguments(out, **more):
    values = {"task": f"{__name__}:task", "out": out, "prior": ["gaussian", "past", "preview"], "chunk": H}
    values |= {
        "iterations": 20,
        "batch_size": 16,
        "learning_rate": 1e-2,
        "checkpoints": 2,
        "log_every": 5,
        "save_every": 10,
    }
    values |= {
        "network": "mlp,hidden_dim=16",
        "episodes": 7,
        "seeds": 2,
        "nfe": [3, 1],
        "workers": 1,
        "logger": "none",
    }
    return command_line(**values | more)
