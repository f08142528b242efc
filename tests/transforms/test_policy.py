import pytest
import torch
from tensordict import TensorDict

from tests.errors import raises
from tests.toy_env import ACTION_DIM, ChunkPolicy, mlp_actor, placed
from warmprior import Normalizer, PastPrior, policy_transforms

SEEN = torch.tensor([[0.0, -1.0, -0.5, 3.0], [10.0, 5.0, 0.5, 3.0]])
DONE = torch.tensor([[-0.5, -0.1], [0.25, 0.3]])
NORMALIZER = Normalizer.fit(TensorDict({"observation": SEEN, "action": DONE}, [2]))


@pytest.mark.parametrize(
    ("place", "observation_steps"),
    [("single", 1), ("serial-inside", 2), ("serial-outside", 3), ("parallel-inside", 2)],
)
def test_policy_sees_the_last_normalised_observations(place, observation_steps):
    """The stack is of control steps, also across the steps inside a chunk, and starts afresh."""
    prior = PastPrior(3)
    lengths = (7,) if place == "single" else (7, 4)

    def transforms():
        return policy_transforms(prior, normalizer=NORMALIZER, observation_steps=observation_steps)

    env = placed(place, transforms, lengths)
    policy = ChunkPolicy(lambda data: torch.full((*data.batch_size, 3, ACTION_DIM), 0.5))
    rollout = env.rollout(6, policy, break_when_any_done=False)
    rollout = rollout[None] if place == "single" else rollout
    env.close(raise_if_closed=False)
    loc, scale = NORMALIZER.loc("observation"), NORMALIZER.scale("observation")
    executed = 0.5 * NORMALIZER.scale("action") + NORMALIZER.loc("action")
    for row, length in zip(rollout, lengths, strict=True):
        time = 0
        for t in range(6):
            stack = row["observation"][t] * scale + loc
            expected = [max(time - back, 0) for back in reversed(range(observation_steps))]
            torch.testing.assert_close(stack[:, 0], torch.tensor(expected).float())
            for moment, frame in zip(expected, stack, strict=True):
                action = executed if moment else torch.zeros(ACTION_DIM)
                torch.testing.assert_close(frame[2:], action)
            after = row["next", "observation"][t] * scale + loc
            time = min(time + 3, length)
            assert after[-1, 0].round() == time
            time = 0 if time == length else time


def test_a_compiled_policy_is_asked_as_it_is():
    actor = mlp_actor(PastPrior(3), steps=1)
    for policy in (actor, torch.compile(actor)):
        stack, chunk, _ = policy_transforms(policy)
        assert (stack.steps, chunk.chunk_length) == (1, 3)


def test_the_normaliser_knows_the_action():
    ones = {"observation": torch.ones(4), "move": torch.ones(2)}
    normalizer = Normalizer({key: -2 * value for key, value in ones.items()}, ones)
    with raises(ValueError, "'move'", "'action'"):
        policy_transforms(PastPrior(3), normalizer=normalizer)
