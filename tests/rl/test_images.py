from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import SerialEnv, TransformedEnv
from torchrl.envs.transforms import Compose
from torchrl.envs.utils import check_env_specs

from tests.errors import raises
from tests.rl.training_parts import EVALUATION_SEED, LENGTHS, H, SolvableEnv, make_actor, make_config
from tests.toy_env import ACTION_DIM
from warmprior import (
    EncodeObservation,
    ImageEncoder,
    PastPrior,
    PreconditionedNetwork,
    PriorAnchor,
    VelocityMLP,
    VisionNetwork,
    WarmPriorActor,
    policy_transforms,
)
from warmprior.rl import PriorSpaceTraining

SIZE, STATE = 10, 2 + ACTION_DIM
IMAGE = (3, SIZE, SIZE)


class CameraEnv(SolvableEnv):
    """The toy with an image whose brightness is its step."""

    def __init__(self, length):
        super().__init__(length, truncate=True)
        image = Bounded(0, 255, IMAGE, dtype=torch.uint8)
        self.observation_spec["observation"] = Composite(state=Unbounded((STATE,)), cam=image)

    def _seen(self, out):
        image = torch.full(IMAGE, 20 * self.t, dtype=torch.uint8)
        seen = TensorDict({"state": out["observation"], "cam": image}, [])
        return super()._seen(out).set("observation", seen)


class Counted(ImageEncoder):
    calls: list[int] = []  # noqa: RUF012, shared by the copies

    def forward(self, observation):
        self.calls.append(len(observation))
        return super().forward(observation)


@pytest.fixture
def policy():
    torch.manual_seed(0)
    Counted.calls.clear()
    encoder = Counted(["cam"], STATE, image_size=SIZE, crop_size=8, backbone="small")
    network = VisionNetwork(encoder, VelocityMLP(ACTION_DIM, encoder.observation_dim, H, 1, hidden_dim=8))
    return WarmPriorActor(PreconditionedNetwork(network), PastPrior(H), nfe=2, clip=1.0)


def environment(policy, seed=0):
    transforms = policy_transforms(policy.prior, observation_steps=1)
    inner = SerialEnv(2, [partial(CameraEnv, length) for length in LENGTHS])
    return TransformedEnv(inner, Compose(transforms, EncodeObservation(policy), PriorAnchor(policy)))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_features_are_those_of_the_policy_in_evaluation_mode(policy, dtype):
    policy.to(dtype).train()
    env = environment(policy)
    check_env_specs(env, break_when_any_done="both")
    reading = policy.replace(observation_key="features")
    rollout = env.rollout(3, reading, break_when_any_done=False)
    network = policy.eval().network.network
    for place in (rollout, rollout["next"]):
        observation = place["observation"].reshape(-1)
        expected = network.encode(observation).detach()
        torch.testing.assert_close(place["features"].flatten(0, 1), expected)


@pytest.mark.parametrize("algorithm", ["dsrl-na", "dsrl-sac"])
def test_agents_learn_from_features_alone(policy, tmp_path, algorithm):
    decisions = []

    class Decided(PriorSpaceTraining):
        def _collect(self, env, data):
            before = len(Counted.calls)
            result = super()._collect(env, data)
            decisions.append(len(Counted.calls) - before)
            return result

    training = Decided(
        policy.replace(observation_key="features"),
        lambda seed: environment(policy, seed),
        make_config(algorithm=algorithm),
        tmp_path,
        evaluation_seed=EVALUATION_SEED,
        description=None,
    )
    training.run()
    assert set(decisions) <= {1, 2}  # the next state's, and that of environments which start again
    stored = training.buffer[:]
    assert {"features"} <= set(stored.keys()) and "observation" not in stored.keys()  # noqa: SIM118
    assert all(value.dtype != torch.uint8 for value in stored.values(True, True))
    assert training.agent.state_keys[0] == "features"


def test_an_agent_of_raw_images_is_refused_before_the_first_episode(policy, tmp_path):
    training = PriorSpaceTraining(
        policy, lambda seed: environment(policy, seed), make_config(), tmp_path, evaluation_seed=0
    )
    with raises(ValueError, "'observation'", "EncodeObservation"):
        training.run()
    assert training.steps == 0 and not training.state_path.exists()


def test_a_policy_of_vectors_has_nothing_to_encode():
    with raises(ValueError, "VelocityMLP", "encoder"):
        EncodeObservation(make_actor())
