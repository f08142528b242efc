"""The package needs torch, tensordict and torchrl, and nothing that is optional."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import warmprior

OPTIONAL = ("robosuite", "lerobot", "h5py", "matplotlib", "scipy", "numba", "gymnasium", "mujoco", "tyro")

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


TRAINED = """
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


def test_optional_packages_are_not_imported_and_a_policy_trains_without_them():
    """Of the former those that TorchRL does not import itself where they are installed."""
    heavy = ("robosuite", "lerobot", "h5py", "matplotlib", "numba", "tyro")
    code = f"import sys, warmprior; print([n for n in {heavy} if n in sys.modules])\n"
    again = "for name in [n for n in sys.modules if n.split('.')[0] == 'warmprior']: del sys.modules[name]\n"
    done = subprocess.run(
        [sys.executable, "-c", code + again + BLOCK.format(names=OPTIONAL) + TRAINED],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-2:] == ["[]", "torch.Size([8, 4, 2])"]


ROOMS = [
    *("io", "modules", "lerobot", "transforms", "objectives", "deploy"),
    *("envs", "data", "diagnostics", "training", "rl"),
]
"""Each may import those before it alone."""


def imported(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield node.module, [alias.name for alias in node.names]
        elif isinstance(node, ast.Import):
            yield from ((alias.name, []) for alias in node.names)


def test_imports_point_one_way_and_name_nothing_private():
    package = Path(warmprior.__file__).parent
    root = package.parent
    assert {path.parent.name for path in package.glob("*/__init__.py")} == set(ROOMS)
    scripts = [*root.glob("benchmarks/**/*.py"), *root.glob("tests/**/*.py")]
    for path in [*package.glob("*/**/*.py"), *scripts]:
        room = path.relative_to(package).parts[0] if package in path.parents else None
        for module, names in imported(path):
            place = module.split(".")
            if place[0] != "warmprior" or len(place) == 1:
                continue
            if room is not None and place[1] in ROOMS:
                assert ROOMS.index(place[1]) <= ROOMS.index(room), f"{path} imports {module}"
            if place[1:2] != [room]:
                private = [n for n in (*place, *names) if n.startswith("_") and n != "__main__"]
                assert not private, f"{path} imports {private}"
