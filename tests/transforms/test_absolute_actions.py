"""Absolute poses in environments that take deltas; scipy and a kinematic gripper are the references."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import ExcludeTransform, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.errors import raises, refuses
from tests.toy_env import PLACES, CountingEnv, placed
from warmprior import GaussianPrior
from warmprior.modules.normalize import Normalizer
from warmprior.transforms import AbsoluteActions, policy_transforms

Rotation = pytest.importorskip("scipy.spatial.transform").Rotation

SCALE = [0.05, 0.05, 0.05, 0.5, 0.5, 0.5]
H = 4


def absolute(pose, delta, scale=SCALE, base=None):
    """What the controller makes of a delta, by hand: ``[10]`` from ``[3, 4]`` and ``[7]``."""
    base = base or Rotation.identity()
    goal = pose[:, 3] + base.apply(np.multiply(delta[:3], scale[:3]))
    turn = base * Rotation.from_rotvec(np.multiply(delta[3:6], scale[3:])) * base.inv()
    rotation = (turn * Rotation.from_matrix(pose[:, :3])).as_matrix()
    return np.concatenate([goal, rotation[0], rotation[1], delta[6:]])


def pose_of(position, rotation):
    return np.concatenate([rotation.as_matrix(), np.reshape(position, (3, 1))], 1)


def floats(least, most, n):
    return st.lists(st.floats(least, most, width=32), min_size=n, max_size=n)


@st.composite
def rotations(draw):
    """Any rotation, half turns and nearly half turns often among them."""
    axis = np.array(draw(floats(-1, 1, 3)))
    length = np.linalg.norm(axis)
    axis = np.array([0.0, 0.0, 1.0]) if length < 1e-3 else axis / length
    near = st.sampled_from([0.0, 1e-9, 1e-7, 1e-4, 1e-2]).map(lambda short: np.pi - short)
    return Rotation.from_rotvec(axis * draw(st.one_of(st.floats(-np.pi, np.pi), near)))


@given(
    deltas=floats(-1, 1, 14),
    positions=floats(-2, 2, 6),
    hands=st.tuples(rotations(), rotations()),
    yaws=floats(-3, 3, 2),
    scale=floats(0.125, 0.75, 6),
)
def test_round_trip(deltas, positions, hands, yaws, scale):
    bases = [Rotation.from_euler("z", yaw) for yaw in yaws]
    poses = [pose_of(positions[3 * a : 3 * a + 3], hands[a]) for a in range(2)]
    targets = [absolute(poses[a], np.array(deltas[7 * a : 7 * a + 7]), scale, bases[a]) for a in range(2)]
    transform = AbsoluteActions(scale, torch.from_numpy(np.stack([base.as_matrix() for base in bases])))
    data = {
        "action": torch.from_numpy(np.concatenate(targets)),
        "eef_pose": torch.from_numpy(np.stack(poses)),
    }
    found = transform.inv(TensorDict(data))["action"]
    assert found.dtype == torch.float64
    np.testing.assert_allclose(found.numpy(), deltas, rtol=0, atol=1e-6)


@given(position=floats(-1, 1, 3), here=floats(-1, 1, 3), target=rotations(), now=rotations())
def test_far_targets_are_approached_at_full_speed(position, here, target, now):
    turn = (target * now.inv()).as_rotvec()
    if np.linalg.norm(turn) > np.pi - 1e-3:
        return  # half a turn may go either way
    matrix = target.as_matrix()
    action = np.concatenate([position, 3 * matrix[0], matrix[1] - 2 * matrix[0], [7.0]])
    data = {"action": torch.from_numpy(action), "eef_pose": torch.from_numpy(pose_of(here, now))[None]}
    found = AbsoluteActions(SCALE).inv(TensorDict(data))["action"].numpy()
    move = np.subtract(position, here) / SCALE[:3]
    expected = np.concatenate([move, turn / SCALE[3:], [7.0]]).clip(-1, 1)
    np.testing.assert_allclose(found, expected, atol=1e-6)


class Gripper(CountingEnv):
    """Moves exactly as its action says, from a start that its seed decides."""

    def __init__(self, length=10):
        super().__init__(length)
        self.start = 0
        self.observation_spec = Composite(observation=Unbounded((4,)), eef_pose=Unbounded((1, 3, 4)))
        self.action_spec = Bounded(-1, 1, (7,))

    def _seen(self, out):
        pose = torch.from_numpy(pose_of(self.position, self.rotation)).float()
        gripper = torch.tensor([self.fingers], dtype=torch.float32)
        return out.update({"observation": torch.cat([pose[:, 3], gripper]), "eef_pose": pose[None]})

    def _reset(self, tensordict=None, **kwargs):
        rng = np.random.default_rng(self.start)
        self.start += 1
        self.position, self.rotation = rng.normal(size=3), Rotation.random(random_state=self.start)
        self.fingers = 0.0
        return super()._reset(tensordict)

    def _step(self, tensordict):
        action = tensordict["action"].double().numpy()
        assert action.shape == (7,) and np.abs(action).max() <= 1
        self.position = self.position + action[:3] * SCALE[:3]
        self.rotation = Rotation.from_rotvec(action[3:6] * SCALE[3:]) * self.rotation
        self.fingers = float(action[6])
        return super()._step(tensordict)

    def _set_seed(self, seed):
        self.start = seed


def transforms():
    low, high = torch.full((10,), -3.0), torch.full((10,), 5.0)
    seen = torch.ones(4)
    normalizer = Normalizer({"action": low, "observation": -2 * seen}, {"action": high, "observation": seen})
    return policy_transforms(GaussianPrior(H), normalizer=normalizer, actions=AbsoluteActions(SCALE))


def grippers(place):
    return placed(place, transforms, (10, 6), Gripper)


@pytest.fixture(params=PLACES)
def env(request):
    env = grippers(request.param)
    yield env
    env.close(raise_if_closed=False)


def test_specs(env):
    check_env_specs(env)
    chunk = env.full_action_spec["vla_action", "chunk"]
    assert chunk.shape == (*env.batch_size, H, 10)
    # Bounds of 2 m and 1, by the normaliser's middle of 1 and half range of 4.
    limits = torch.tensor([2.0] * 3 + [1.0] * 7)
    torch.testing.assert_close(chunk.space.low, ((-limits - 1) / 4).expand(chunk.shape))


def targets(pose, rng):
    """A chunk ``[H, 10]`` that is within reach, and where it leads."""
    chunk = []
    for _ in range(H):
        action = absolute(pose, rng.uniform(-0.9, 0.9, 7))
        rows = action[3:9].reshape(2, 3)
        matrix = np.stack([*rows, np.cross(*rows)])
        pose = np.concatenate([matrix, action[:3, None]], 1)
        chunk.append(action)
    return np.stack(chunk), pose


def test_grippers_go_where_they_are_told(env):
    """Chunk by chunk, across ends of episodes that leave other rows in the middle of theirs."""
    rng, td = np.random.default_rng(0), env.reset()
    for _ in range(7):
        poses = td["eef_pose"].reshape(-1, 3, 4).double().numpy()
        chunks, ends = zip(*(targets(pose, rng) for pose in poses), strict=True)
        chunk = (torch.from_numpy(np.stack(chunks)).float() - 1) / 4
        td["vla_action", "chunk"] = chunk.view(*env.batch_size, H, 10)
        stepped, following = env.step_and_maybe_reset(td)
        steps = stepped["next", "executed_steps"].flatten()
        reached = stepped["next", "eef_pose"].reshape(-1, 3, 4).numpy()
        for row in range(len(poses)):
            if steps[row] == H:
                np.testing.assert_allclose(reached[row], ends[row], atol=2e-5)
            else:
                goal = chunks[row][int(steps[row]) - 1]
                np.testing.assert_allclose(reached[row][:, 3], goal[:3], atol=2e-5)
        td = following
    assert steps.max() <= H


def test_refusals():
    refuses(lambda: AbsoluteActions([0.05] * 3), ValueError, "output_max", [6], [3])
    two_arms = AbsoluteActions(SCALE, torch.eye(3).expand(2, 3, 3))
    refuses(lambda: TransformedEnv(Gripper(), two_arms).full_action_spec, ValueError, 2, 14, 7)
    with raises(KeyError, "eef_pose=True"):
        blind = TransformedEnv(Gripper(), ExcludeTransform("eef_pose"))
        TransformedEnv(blind, AbsoluteActions(SCALE)).full_action_spec  # noqa: B018
    env = TransformedEnv(Gripper(), AbsoluteActions(SCALE))
    env.reset()
    refuses(lambda: env.step(TensorDict({"action": torch.zeros(10)})), KeyError, "reset")
