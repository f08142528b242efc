import pytest
import torch
from tensordict import TensorDict

from warmprior import PastPrior, RestingJoints, VelocityMLP, WarmPriorActor
from warmprior.diagnostics.held_out import held_out_errors


def test_errors_stand_beside_those_of_actions_that_know_nothing():
    lengths, chunk = (12, 9), 4
    episode = torch.repeat_interleave(torch.arange(2), torch.tensor(lengths))
    observation, action = (torch.rand(21, 3, generator=torch.Generator().manual_seed(i)) for i in (0, 1))
    data = TensorDict({"observation": observation, "action": action[:, :2], "episode": episode}, [21])
    policy = WarmPriorActor(VelocityMLP(2, 3, chunk), PastPrior(chunk))
    mean, (still, always) = torch.tensor([0.25, 0.75]), ([], [])
    errors, others = held_out_errors(policy, data, [1], mean, RestingJoints([2, -1]))
    for i in range(21):
        for k in range(i, min(i + chunk, lengths[0] if i < lengths[0] else 21)):
            still.append((data["action"][k] - torch.stack((observation[i, 2], mean[1]))).square())
            always.append((data["action"][k] - mean).square())
    expected = (torch.stack(terms).mean().item() for terms in (always, still))
    assert list(others.values()) == pytest.approx(list(expected), rel=1e-5)
    assert list(errors) == [1] and len(held_out_errors(policy, data, [1], mean, None)[1]) == 1
