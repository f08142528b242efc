import gc
import pickle
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import torch
from torchrl.data import SliceSampler
from torchrl.envs.transforms import RenameTransform

from tests.data.synthetic import env_args_15, write_robomimic_file
from tests.processes import apart
from warmprior.data import RobomimicDemonstrations
from warmprior.envs import absolute_actions, modernize_env_args
from warmprior.envs.tasks import TASKS


def _state(demo, task):
    return np.concatenate([demo[key] for key in TASKS[task].low_dim_keys], -1)


@pytest.mark.parametrize(("task", "storage"), [*((task, "memory") for task in TASKS), ("lift", "memmap")])
def test_values_equal_what_was_written(tmp_path, task, storage):
    path = tmp_path / "file.hdf5"
    demos = write_robomimic_file(path, lengths=(12, 1, 30), task=task, failures=(2,))
    scratch = tmp_path / "scratch" if task == "lift" else None
    replay = RobomimicDemonstrations(path, storage=storage, scratch_dir=scratch)
    data = replay.data
    assert data.batch_size == (43,) and len(replay) == 43
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
    assert replay.num_episodes == 3 and replay.data["episode"].bincount().tolist() == [12, 1, 30]
    assert replay.task is TASKS[task] and replay.path == path
    assert replay.observation_keys == TASKS[task].low_dim_keys
    assert replay.env_args == modernize_env_args(env_args_15(task))


def test_data_is_the_storage(square_file, tmp_path, monkeypatch):
    path, _ = square_file
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    mapped = {"storage": "memmap"}
    maps = mapped | {"scratch_dir": tmp_path / "maps"}
    replays = [RobomimicDemonstrations(path, batch_size=7, **options) for options in ({}, mapped, maps, maps)]
    for number, replay in enumerate(replays):
        assert replay.data["action"].data_ptr() == replay.data["action"].data_ptr()
        replay.data["action"].fill_(number)
    for number, replay in enumerate(replays):  # two have their files in one folder
        assert (replay.sample()["action"] == number).all()
    sent = [pickle.loads(pickle.dumps(replay.data)) for replay in replays]  # as to a worker process
    assert [data["action"].unique().tolist() for data in sent] == [[0], [1], [2], [3]]
    apart(lambda: sent.append(RobomimicDemonstrations(path, **mapped)))()  # a worker leaves nothing
    files = sorted(tmp_path.rglob("action.memmap"))
    assert [file.parents[1] for file in files] == [tmp_path / "maps"] * 2 + [tmp_path]
    part = replays[-1].data[:1].select("action")
    del replay, replays
    gc.collect()
    assert len(list(tmp_path.rglob("action.memmap"))) == 1 and (part["action"] == 3).all()
    del part
    assert not list(tmp_path.rglob("*.memmap"))


def test_works_with_torchrl_samplers_and_transforms(square_file):
    path, _ = square_file
    replay = RobomimicDemonstrations(
        path,
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
    replay = RobomimicDemonstrations(path, absolute_actions=True)
    poses = [
        np.concatenate([demos[1][f"robot{a}_{key}"] for a in (0, 1)], -1) for key in ("eef_pos", "eef_quat")
    ]
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    base = torch.stack((quarter, quarter.mT))
    expected = absolute_actions(*map(torch.from_numpy, (demos[1]["actions"], *poses)), base_rotation=base)
    torch.testing.assert_close(replay.data["action"][12:17], expected.float())
    replay.env_args["env_kwargs"].clear()
    assert replay.env_args["env_kwargs"]


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads Linux's /proc")
@pytest.mark.slow
@pytest.mark.parametrize("options", ["", "absolute_actions=True", "storage='memmap'"])
def test_peak_memory(tmp_path, options):
    small, large = tmp_path / "small.hdf5", tmp_path / "large.hdf5"
    write_robomimic_file(small)
    write_robomimic_file(large, lengths=[50_000, 400_000])
    code = f"""
        import re, sys
        from pathlib import Path
        from warmprior.data import RobomimicDemonstrations
        # What is imported or cached on first use is not the data's.
        RobomimicDemonstrations(sys.argv[1], {options})
        status = lambda key: 1024 * int(
            re.search(key + r":\\s+(\\d+)", Path("/proc/self/status").read_text())[1]
        )
        before = status("VmRSS")
        data = RobomimicDemonstrations(sys.argv[2], {options}).data
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
