"""The blocks of pages that need something of the reader run with small stand-ins for it."""

from functools import partial
from typing import ClassVar

import numpy as np
import pytest
import torch
from tensordict import TensorDict

import warmprior.training
from tests.data.lerobot_parts import numbers, write_lerobot
from tests.data.synthetic import write_robomimic_file
from tests.io.hub_server import TOKEN, model_hub
from tests.lerobot.conftest import found  # noqa: F401
from tests.lerobot.plugin_policies import NEEDS_PLUGIN, saved_flow_policy
from tests.lerobot.test_actor import Arm, preprocessed
from tests.lerobot.tiny import ACTION, CAMERA, STATE, make_smolvla
from tests.test_blocks import BLOCKS, GIVEN
from tests.toy_env import Halfway, demonstrations, mlp_actor
from warmprior import GaussianPrior, Normalizer, PastPrior, ReflowCoupling
from warmprior.deploy import AsyncExecutor
from warmprior.saving import save_policy
from warmprior.training import NetworkOptions, TrainingConfig

pytestmark = NEEDS_PLUGIN


@pytest.fixture
def here(monkeypatch, tmp_path):
    """An empty folder, no hub, and training runs of two iterations."""
    short = partial(warmprior.training.train_policy, training=TrainingConfig(iterations=2))
    monkeypatch.setattr(warmprior.training, "train_policy", short)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def saved(here, monkeypatch):
    """A policy in a folder, and a hub to push it to."""
    steps = TensorDict({"observation": torch.randn(50, 5), "action": torch.randn(50, 2)}, [50])
    actor = mlp_actor(PastPrior(3), observation_dim=5, normalizer=Normalizer.fit(steps))
    save_policy(actor, here / "policy")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    with model_hub(monkeypatch, here / "cache"):
        monkeypatch.setenv("HF_TOKEN", TOKEN)
        yield {"folder": here / "policy"}


@pytest.fixture
def robot(here, found):  # noqa: F811
    saved_flow_policy(found, here / "run/checkpoints/last/pretrained_model", (3, 32, 32))
    return {"joints": torch.zeros(STATE), "image": torch.zeros(32, 32, 3, dtype=torch.uint8)}


@pytest.fixture
def dataset(here):
    widths = {"observation.environment_state": 16, "observation.state": 2, "action": 2}
    write_lerobot(here / "data", (20, 12), {name: numbers(width) for name, width in widths.items()})
    return {"place": f"lerobot:{here / 'data'}"}


class FakeArm:
    """An arm with the names of LeRobot's SO-101 and one camera; it notes what it is sent."""

    joints = ("shoulder_pan.pos", "shoulder_lift.pos", "elbow_flex.pos", "gripper.pos")
    action_features: ClassVar = dict.fromkeys(joints, float)
    observation_features: ClassVar = action_features | {"front": (48, 64, 3)}

    def get_observation(self):
        return dict.fromkeys(self.joints, 0.1) | {"front": np.zeros((48, 64, 3), np.uint8)}

    def send_action(self, action):
        self.sent = action


@pytest.fixture
def lerobot_arm(here):
    """An arm of LeRobot beside an executor of a policy of its own recording, with its names."""
    arm = FakeArm()
    features = {name: numbers(4, list(arm.joints)) for name in ("observation.state", "action")}
    write_lerobot(here / "arm", (20, 12), features, images=[("front", "image")], fps=30)
    policy = warmprior.training.train_policy(
        f"lerobot:{here / 'arm'}",
        GaussianPrior(8),
        images=["observation.images.front"],
        network=NetworkOptions(encoder="small"),
    )
    with AsyncExecutor(policy, delay=0, control_rate=30) as executor:
        yield {"robot": arm, "executor": executor}
    assert tuple(arm.sent) == arm.joints and all(abs(target) < 10 for target in arm.sent.values())


@pytest.fixture
def places(here):
    write_robomimic_file(here / "square.hdf5")
    widths = {name: numbers(7) for name in ("observation.state", "action")}
    write_lerobot(here / "arm", (20, 12), widths, same=["action"])
    file = here / "square.hdf5"
    return {"moves": file, "joints": f"lerobot:{here / 'arm'}", "poses": file}


@pytest.fixture
def adapted(here):
    one = {"observation.state": torch.zeros(1, STATE), CAMERA: torch.zeros(1, 3, 64, 64)}
    batch = {name: value.repeat(2, *[1] * (value.dim() - 1)) for name, value in one.items()}
    actions = {"action": torch.randn(2, 100, ACTION), "action_is_pad": torch.zeros(2, 100, dtype=torch.bool)}
    policy = make_smolvla(chunk_size=50, n_action_steps=50)
    given = {"policy": policy, "batch": batch | actions, "observation": one, "fps": 20}
    return given | {"preprocessor": preprocessed, "postprocessor": lambda action: action}


@pytest.fixture
def simulated(here):
    policy = make_smolvla(chunk_size=50, n_action_steps=50)
    act = policy.predict_action_chunk
    policy.predict_action_chunk = lambda batch, **options: act(preprocessed(batch), **options)
    return {"policy": policy, "base": Arm()}


@pytest.fixture
def parts(here):
    teacher = mlp_actor(GaussianPrior(8), action_dim=2, observation_dim=3)
    network, pairs = teacher.network, ReflowCoupling(teacher)
    return {"network": network, "pairs": pairs, "start": Halfway(), "demos": demonstrations()}


STAND_INS = {
    saved: "folder",
    robot: "joints, image",
    dataset: "place",
    lerobot_arm: "robot, executor",
    places: "moves, joints, poses",
    adapted: "policy, preprocessor, postprocessor, batch, observation, fps",
    simulated: "policy, base",
    parts: "network, pairs, start, demos",
}
BY_NAMES = {names: stand_in.__name__ for stand_in, names in STAND_INS.items()}
GIVEN_BLOCKS = [  # but that of another release of LeRobot
    pytest.param(text, BY_NAMES[match[1]], id=name)
    for name, text in BLOCKS
    if (match := GIVEN.match(text)) and not name.startswith("groot_n15")
]


@pytest.mark.parametrize("text, stand_in", GIVEN_BLOCKS)
def test_a_block_runs_with_what_is_given(request, text, stand_in):
    given = request.getfixturevalue(stand_in)
    exec(compile(text.replace('"cuda"', '"cpu"'), "block", "exec"), given)
