"""The package needs torch, tensordict and torchrl, and nothing that is optional."""

from __future__ import annotations

import subprocess
import sys

OPTIONAL = ("robosuite", "lerobot", "h5py", "matplotlib", "scipy", "numba", "gymnasium", "mujoco")

BLOCK = """
import sys

class Without:
    # As if the packages were not installed: neither found nor importable.
    def __init__(self, finder):
        self.finder = finder
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] not in {names}:
            return self.finder.find_spec(name, path, target)
    def __getattr__(self, name):
        return getattr(self.finder, name)

sys.meta_path[:] = [Without(finder) for finder in sys.meta_path]
"""


def python(code):
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False
    )


def test_optional_packages_are_not_imported():
    """mujoco and gymnasium are left out: TorchRL imports them itself where they are installed."""
    code = f"import sys, warmprior; print([n for n in {OPTIONAL} if n in sys.modules])"
    done = python(code)
    assert done.returncode == 0, done.stderr
    loaded = set(eval(done.stdout.splitlines()[-1]))
    done = python(code.replace("sys, warmprior", "sys, torchrl.envs, torchrl.data"))
    by_torchrl = set(eval(done.stdout.splitlines()[-1]))
    assert loaded <= by_torchrl
    assert not loaded & {"robosuite", "lerobot", "h5py", "matplotlib"}


def test_a_policy_trains_where_nothing_optional_can_be_imported():
    code = """
import torch
from tensordict import TensorDict
from warmprior import FlowMatchingLoss, PastPrior, VelocityMLP, WarmPriorActor, window_replay_buffer
data = TensorDict({"observation": torch.randn(50, 3), "action": torch.randn(50, 2),
                   "episode": torch.arange(50) // 25}, [50])
prior = PastPrior(4)
actor = WarmPriorActor(VelocityMLP(2, 3, 4), prior)
batch = window_replay_buffer(data, prior, batch_size=8).sample()
FlowMatchingLoss(actor)(batch)["loss_flow_matching"].backward()
print(actor(batch)["vla_action", "chunk"].shape)
"""
    done = python(BLOCK.format(names=OPTIONAL) + code)
    assert done.returncode == 0, done.stderr
    assert "torch.Size([8, 4, 2])" in done.stdout
