import torch
from tensordict import TensorDict
from torch import nn

from warmprior import GaussianPrior, WarmPriorActor
from warmprior.history import cold_history

H, D_A = 3, 2


class Field(nn.Module):
    def __init__(self, function):
        super().__init__()
        self.function = function

    def forward(self, t, a, observation):
        return self.function(t.view(-1, 1, 1), a, observation)


def policy(function, prior=None, seed=0, **options):
    prior = GaussianPrior(H) if prior is None else prior
    generator = torch.Generator().manual_seed(seed)
    return WarmPriorActor(Field(function), prior, generator=generator, **options)


def batch(n=5, length=H, d_a=D_A, **extra):
    torch.manual_seed(1)
    data = {"observation": torch.randn(n, 1, 4), "history": cold_history([n], min(H, length), length, d_a)}
    return TensorDict({**data, **extra}, [n])


def targets(prior, n, spread=1.0, loc=0.0, d_a=D_A):
    """Windows of a prior with random targets around a mean; of a few, the first ends early."""
    length = prior.prediction_length
    target = loc + spread * torch.randn(n, length, d_a, generator=torch.Generator().manual_seed(0))
    pad = torch.zeros(n, length, dtype=torch.bool)
    pad[0, 1:] = n < 100
    return batch(n, length, d_a, vla_action={"chunk": target}, action_is_pad=pad)


def remember(data, loc, warm=True):
    """Write a history that both WP-Past and WP-Preview make the mean ``loc`` of, where it is warm."""
    history = data["history"]
    length = history["actions"].shape[-2]
    for steps in ("steps", "forecast_steps"):
        history[steps] = torch.full((len(data), 1), length) * warm
    for actions in ("actions", "forecast"):
        history[actions][:, :length] = loc[:, :length]
    return data
