"""Collection by actors of a Ray cluster: the same kind of transitions, and learning from them."""

import pytest
import torch

pytest.importorskip("ray")
from functools import partial

from lab.running.ray_collection import ray_rounds
from tests.processes import apart
from tests.rl.training_parts import LENGTHS, H, check_transitions, make_actor, make_env, make_training
from tests.states import copied, same
from warmprior import PastPrior
from warmprior.rl import PriorSpaceConfig
from warmprior.rl.agent import PriorSpaceAgent, WarmUpSwitch


def test_a_buffer_says_which_policy_acts():
    agent = PriorSpaceAgent(make_actor(), PriorSpaceConfig(nfe=2, hidden_dim=8, num_layers=1))
    switch = WarmUpSwitch(agent.warmup, agent.policy)
    assert switch.state_dict()["learning"].item() is False
    data = make_env(0).reset()
    for learning, policy in ((False, agent.warmup), (True, agent.policy)):
        switch.learning.fill_(learning)
        found = []
        for act in (switch, policy):
            torch.manual_seed(3)
            found.append(act(data.clone())["vla_action", "chunk"])
        assert torch.equal(*found)


@pytest.mark.slow
@apart
def test_actors_collect_what_is_so_by_hand_and_follow_the_agent(ray_address, tmp_path):
    actor = make_actor(PastPrior(H, sigma=0.01))
    collect = partial(ray_rounds, collectors=2, address=ray_address)
    training = make_training(tmp_path, actor, warmup_steps=40, running={"collect": collect})
    fresh = copied(training.agent.state())
    training.run()
    lengths = LENGTHS * 2
    check_transitions(training, lengths=lengths)
    assert 90 <= training.steps < 90 + len(lengths) * H
    # The warm-up's residuals are the prior's, and then the agent's: the actors received its weights.
    drawn = training.buffer[:]["prior", "delta"]
    executed = training.buffer[:]["next", "executed_steps"].reshape(-1, len(lengths)).sum(1)
    warm = len(lengths) * int((executed.cumsum(0) - executed < 40).sum())
    assert drawn[:warm].std() == pytest.approx(0.01, rel=0.15) and drawn[warm:].std() > 0.1
    # No two actors draw alike.
    rounds = drawn.unflatten(0, (-1, 2, 2))
    assert not torch.isclose(rounds[:, 0], rounds[:, 1]).all(-1).any()
    assert not same(fresh, training.agent.state())
    again = make_training(tmp_path, actor, warmup_steps=40)
    assert again.steps == training.steps and again.curve == training.curve
