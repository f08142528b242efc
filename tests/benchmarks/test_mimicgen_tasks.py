"""The benchmark on MimicGen's tasks: what it chooses, and runs with a package of their interface."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.benchmarks.script_parts import described, options, stored
from tests.data.synthetic import env_args_14, write_robomimic_file
from tests.envs.mimicgen_stub import write_mimicgen

pytest.importorskip("robosuite")
pytest.importorskip("tyro")

import mimicgen_tasks as script
from options import parse
from paper import paper_success

SCRIPT = Path(script.__file__)


@pytest.fixture(scope="module", autouse=True)
def short_episodes():
    """Not here: scripted experts need their time."""


@pytest.fixture
def package(tmp_path, monkeypatch):
    write_mimicgen(tmp_path / "site")
    monkeypatch.syspath_prepend(tmp_path / "site")


def read(out, *argv):
    return parse(script.FEW, [*argv, "--out", str(out)], "mimicgen", None, adapt=script.adapt)


def test_papers_recipe(package, tmp_path, monkeypatch):
    """Table 3 of the paper, MimicGen's column."""
    monkeypatch.setattr("warmprior.training.options.require_rendering", lambda: None)
    for place in ("warmprior.training.options", "options"):
        monkeypatch.setattr(f"{place}.imagenet_weights", dict)
    found = read(tmp_path, "--preset", "paper", "--download")
    training, network = found.training, found.network
    assert (training.batch_size, training.iterations) == (128, 50_000)
    assert (training.learning_rate, training.warmup_ratio) == (1e-4, 0.2)
    assert (network.network, network.encoder) == ("chi_transformer", "resnet18-imagenet")
    assert (found.data.obs, network.crop_size, found.data.image_size) == ("image", 76, 84)
    assert found.data.task == ("stack_d0", "coffee_d0", "threading_d0")
    assert found.data.data == ("source",) and found.data.first("source") is None
    assert paper_success("coffee_d0", "source", "preview", 1, seen="image") == 29.4
    assert paper_success("threading_d0", "source", "past", 3, seen="image") == 16.6


def test_a_file_in_mimicgens_environment(tmp_path):
    """As a user starts it: the package is not taken for the script, nor is it missed by workers."""
    pytest.importorskip("matplotlib")
    write_mimicgen(tmp_path / "site")
    file, out = tmp_path / "stack.hdf5", tmp_path / "out"
    write_robomimic_file(file, lengths=(30, 20, 9), task="stack_d0", env_args=env_args_14("stack_d0"))
    argv = options(file, out, task=None, prior="past", envs=1, demonstrations=2)
    root = SCRIPT.parents[1]
    path = os.pathsep.join(map(str, (root, tmp_path / "site")))
    done = subprocess.run(
        [sys.executable, str(SCRIPT), *argv],
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    (row,) = stored(out)
    assert (row["task"], row["data"]) == ("stack_d0", "source")
    (task,) = described(out, "tasks")
    assert task["demonstrations"] == 2 and task["steps"] == 50
    assert "paper (official data)" not in done.stdout  # its policies see images
