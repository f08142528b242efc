from pathlib import Path

import pytest

from tests.data.synthetic import write_robomimic_file


@pytest.fixture(scope="module", autouse=True)
def offline():
    """LeRobot asks the hub for nothing."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
        yield


@pytest.fixture
def square_file(tmp_path: Path):
    """A square file of three demos with masks, and the arrays in it."""
    path = tmp_path / "square.hdf5"
    demos = write_robomimic_file(path, masks={"train": [2, 0], "valid": [1], "empty": []})
    return path, demos
