"""What the package may import, and what it may not contain: command lines, prints, benchmarks."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import warmprior


def ran(code, **environment):
    environment = {**os.environ, **environment}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return done


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


# TorchRL imports simulators itself where they are installed.
LOADED = """
import sys
import warmprior
assert "torch" not in sys.modules  # it takes seconds: the first public name imports it
import torchrl.collectors, torchrl.data, torchrl.envs, torchrl.modules, torchrl.objectives, torchrl.record
before = set(sys.modules)
assert warmprior.PastPrior.__name__ in warmprior.__all__ and not hasattr(warmprior, "unknown")
print(*sys.modules)
import warmprior.training
print(*set(sys.modules) - before)
for name in [name for name in sys.modules if name.split(".")[0] == "warmprior"]:
    del sys.modules[name]
"""


@pytest.fixture(scope="module")
def fresh():
    """Return what a process says that imports the package, then again without other packages.

    PyTorch, whose import takes seconds, is imported once.
    """
    return ran(LOADED + BLOCK.format(names=OPTIONAL) + TRAINED)


def test_optional_packages_are_not_imported_and_a_policy_trains_without_them(fresh):
    """Of the former those that TorchRL does not import itself where they are installed."""
    loaded, *_, trained = fresh.stdout.splitlines()
    heavy = {"robosuite", "lerobot", "h5py", "matplotlib", "numba", "tyro"}
    assert "warmprior" in loaded.split() and not heavy & set(loaded.split())
    assert trained == "torch.Size([8, 4, 2])"


def test_training_loads_neither_simulator_nor_renderer_nor_experts(fresh):
    new = set(fresh.stdout.splitlines()[1].split())
    assert "warmprior.training.train" in new
    heavy = {"robosuite", "mujoco", "OpenGL", "numba", "h5py", "lerobot", "loky", "matplotlib", "tyro"}
    assert not {name.split(".")[0] for name in new} & {*heavy, "lab", "benchmarks"}
    rooms = {".".join(name.split(".")[:2]) for name in new}
    assert not rooms & {"warmprior.envs", "warmprior.data", "warmprior.lerobot", "warmprior.deploy"}


ROOMS = [
    *("options", "io", "modules", "lerobot", "transforms", "objectives", "deploy"),
    *("envs", "data", "diagnostics", "saving", "tasks", "evaluation", "training", "rl"),
]
"""Each may import those before it alone."""

ROOMS_OF_THE_LAB = ["io", "demonstrations", "methods", "options", "measures", "speed", "reporting", "running"]
"""The same holds here."""


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


def test_imports_of_the_lab_point_one_way():
    lab = BENCHMARKS / "lab"
    assert {path.parent.name for path in lab.glob("*/__init__.py")} == set(ROOMS_OF_THE_LAB)
    assert {path.name for path in lab.glob("*.py")} == {"__init__.py"}
    for path in lab.glob("*/**/*.py"):
        room = ROOMS_OF_THE_LAB.index(path.relative_to(lab).parts[0])
        for module, names in imported(path):
            place = module.split(".")
            if place[0] == "lab":
                for other in place[1:2] or names:
                    assert ROOMS_OF_THE_LAB.index(other) <= room, f"{path} imports {module}"


PACKAGE = Path(warmprior.__file__).parent
BENCHMARKS = PACKAGE.parent / "benchmarks"
FLAG = re.compile(r"(?<![\w-])--[a-z][\w.-]*")


def sources():
    return {path.relative_to(PACKAGE).as_posix(): path.read_text() for path in PACKAGE.rglob("*.py")}


def test_the_package_names_no_option_of_a_command_line():
    found = [
        f"{name}:{number}: {line.strip()}"
        for name, text in sources().items()
        for number, line in enumerate(text.splitlines(), 1)
        if name != "__main__.py" and FLAG.search(line) and "pip install" not in line  # pip's own are fine
    ]
    assert not found, "\n".join(found)


def test_the_package_knows_no_benchmark():
    for path in PACKAGE.rglob("*.py"):
        roots = {module.split(".")[0] for module, _ in imported(path)}
        assert not roots & {"lab", "benchmarks", *(script.stem for script in BENCHMARKS.glob("*.py"))}, path


def test_a_renderer_that_cannot_be_loaded_stops_no_import(tmp_path):
    pytest.importorskip("mujoco")
    (tmp_path / "OpenGL").mkdir()  # as without the library: PyOpenGL raises this
    error = "AttributeError(\"'NoneType' object has no attribute 'glGetError'\")"
    (tmp_path / "OpenGL" / "__init__.py").write_text(f"raise {error}\n")
    path = os.pathsep.join([str(tmp_path), *sys.path])
    code = "import os, warmprior, mujoco; print(os.environ.get('MUJOCO_GL'), warmprior.__version__)"
    done = ran(code, MUJOCO_GL="osmesa", PYTHONPATH=path)
    assert done.stdout.split() == ["None", warmprior.__version__]
    assert "MUJOCO_GL=osmesa" in done.stderr and "glGetError" in done.stderr
