from __future__ import annotations

import h5py
import pytest

from tests.data.synthetic import env_args_14, write_robomimic_file
from warmprior.data import DatasetError, MimicGenExperienceReplay
from warmprior.envs.tasks import TASKS


@pytest.mark.parametrize("task", ["stack_d0", "coffee_d0", "threading_d0"])
def test_files_of_robosuite_14(tmp_path, task):
    path = tmp_path / "file.hdf5"
    write_robomimic_file(path, task=task, env_args=env_args_14(task))
    with h5py.File(path, "a") as file:  # as MimicGen has it beside the observations
        file["data/demo_0/datagen_info/eef_pose"] = [[1.0]]
    data = MimicGenExperienceReplay(path, demos=2, absolute_actions=True)
    assert data.task is TASKS[task] and data.num_episodes == 2
    assert data.data["observation"].shape == (17, TASKS[task].observation_dim)
    assert data.data["action"].shape == (17, 10)
    arm = data.recorded_env_args["env_kwargs"]["controller_configs"]["body_parts"]["right"]
    assert arm["input_ref_frame"] == "world"
    assert "lite_physics" not in data.env_args["env_kwargs"]


def test_files_of_others_are_refused(tmp_path, square_file):
    with pytest.raises(DatasetError, match=r"square\.hdf5: NutAssemblySquare is none of MimicGen's"):
        MimicGenExperienceReplay(square_file[0])
    with pytest.raises(FileNotFoundError, match=r"stack_d0: no such file.*download=True"):
        MimicGenExperienceReplay("stack_d0")
    with pytest.raises(ValueError, match="choose one of stack_d0, coffee_d0, threading_d0"):
        MimicGenExperienceReplay("square", download=True)
