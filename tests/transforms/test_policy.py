import torch
from tensordict import TensorDict

from tests.errors import refuses
from tests.toy_env import mlp_actor
from warmprior import Normalizer, PastPrior, policy_transforms

SEEN = torch.tensor([[0.0, -1.0, -0.5, 3.0], [10.0, 5.0, 0.5, 3.0]])
DONE = torch.tensor([[-0.5, -0.1], [0.25, 0.3]])
NORMALIZER = Normalizer.fit(TensorDict({"observation": SEEN, "action": DONE}, [2]))


def test_a_compiled_policy_is_asked_as_it_is():
    actor = mlp_actor(PastPrior(3), steps=1)
    for policy in (actor, torch.compile(actor)):
        stack, chunk, _ = policy_transforms(policy)
        assert (stack.steps, chunk.chunk_length) == (1, 3)


def test_the_normaliser_knows_the_action():
    ones = {"observation": torch.ones(4), "move": torch.ones(2)}
    normalizer = Normalizer({key: -2 * value for key, value in ones.items()}, ones)
    refuses(lambda: policy_transforms(PastPrior(3), normalizer=normalizer), ValueError, "'move'", "'action'")
