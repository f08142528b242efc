import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import torch
from torchrl.data import SliceSampler, TensorDictReplayBuffer, TensorStorage
from torchrl.envs.transforms import RenameTransform

from tests.data.synthetic import env_args_15, write_robomimic_file
from tests.errors import missing
from warmprior.data.formats.hdf5 import RobomimicDemonstrations
from warmprior.envs import absolute_actions
from warmprior.envs.robosuite_tasks import TASKS


def _state(demo, task):
    return np.concatenate([demo[key] for key in TASKS[task].low_dim_keys], -1)


@pytest.mark.parametrize("task", TASKS)
def test_values_equal_what_was_written(tmp_path, task):
    path = tmp_path / "file.hdf5"
    demos = write_robomimic_file(path, lengths=(12, 1, 30), task=task, failures=(2,))
    demonstrations = RobomimicDemonstrations(path)
    data = demonstrations.steps()
    assert data.batch_size == (43,)
    expected = {
        "observation": np.concatenate([_state(demo, task) for demo in demos]),
        "action": np.concatenate([demo["actions"] for demo in demos]),
    }
    for key, value in expected.items():
        assert data[key].dtype == torch.float32
        np.testing.assert_array_equal(data[key].numpy(), value.astype(np.float32))
    rewards = np.concatenate([demo["rewards"] for demo in demos])[:, None]
    np.testing.assert_array_equal(data["next", "reward"].numpy(), rewards)
    assert data["episode"].tolist() == [0] * 12 + [1] + [2] * 30
    assert data["frame"].tolist() == list(range(43))
    ends = {"done": [11, 12, 42], "terminated": [11, 12], "truncated": [42]}
    for key, rows in ends.items():
        assert data["next", key].shape == (43, 1) and data["next", key].dtype == torch.bool
        assert data["next", key].squeeze(-1).nonzero().squeeze(-1).tolist() == rows
    assert set(data.keys(True, True)) == {
        *("observation", "action", "episode", "frame"),
        *(("next", key) for key in ("reward", "done", "terminated", "truncated")),
    }
    assert data["episode"].bincount().tolist() == [12, 1, 30]
    index = demonstrations.index()
    assert index.task is TASKS[task] and index.path == path and index.lengths == (12, 1, 30)
    assert index.observation_keys == TASKS[task].low_dim_keys
    assert index.env_args == env_args_15(task)
    assert not missing(repr(demonstrations), "3 demonstrations", "43 steps", "object", TASKS[task].env_name)


def test_works_with_torchrl_samplers_and_transforms(square_file):
    path, _ = square_file
    replay = TensorDictReplayBuffer(
        storage=TensorStorage(RobomimicDemonstrations(path).steps()),
        batch_size=20,
        sampler=SliceSampler(slice_len=5, end_key=("next", "done")),
        transform=RenameTransform(["observation"], ["state"]),
    )
    sample = replay.sample().reshape(4, 5)
    assert (sample["frame"].diff(dim=-1) == 1).all()
    assert (sample["episode"].diff(dim=-1) == 0).all()
    assert "state" in sample.keys() and "observation" not in sample.keys()  # noqa: SIM118


def test_absolute_actions_of_deltas_in_the_frame_of_the_base(tmp_path):
    """The two bases of transport face each other along y."""
    path, meta = tmp_path / "file.hdf5", env_args_15("transport", "base")
    demos = write_robomimic_file(path, task="transport", env_args=meta)
    data = RobomimicDemonstrations(path).steps(actions="absolute")
    poses = [
        np.concatenate([demos[1][f"robot{a}_{key}"] for a in (0, 1)], -1) for key in ("eef_pos", "eef_quat")
    ]
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    base = torch.stack((quarter, quarter.mT))
    expected = absolute_actions(*map(torch.from_numpy, (demos[1]["actions"], *poses)), base_rotation=base)
    torch.testing.assert_close(data["action"][12:17], expected.float())


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads Linux's /proc")
@pytest.mark.slow
@pytest.mark.parametrize("options", ["", "actions='absolute'"])
def test_peak_memory(tmp_path, options):
    small, large = tmp_path / "small.hdf5", tmp_path / "large.hdf5"
    write_robomimic_file(small)
    write_robomimic_file(large, lengths=[50_000, 400_000])
    code = f"""
        import re, sys
        from pathlib import Path
        from warmprior.data.formats.hdf5 import RobomimicDemonstrations
        # What is imported or cached on first use is not the data's.
        RobomimicDemonstrations(sys.argv[1]).steps({options})
        status = lambda key: 1024 * int(
            re.search(key + r":\\s+(\\d+)", Path("/proc/self/status").read_text())[1]
        )
        before = status("VmRSS")
        data = RobomimicDemonstrations(sys.argv[2]).steps({options})
        size = sum(v.numel() * v.element_size() for v in data.values(True, True))
        print((status("VmHWM") - before) / size, size)
    """
    result = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code), str(small), str(large)],
        check=True,
        capture_output=True,
        text=True,
    )
    ratio, size = map(float, result.stdout.split())
    assert size > 5e7
    assert 0.7 < ratio < 1.3  # below, the measurement itself would be broken
