"""Where demonstrations are, as command lines name it."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("pyarrow")

from tests.data.synthetic import write_robomimic_file
from warmprior.data.opening import (
    check_place,
    name_of_place,
    open_demonstrations,
    resolved_place,
)
from warmprior.io.files import file_digest


def test_places_are_checked_without_being_read(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data" / "meta").mkdir(parents=True)
    (tmp_path / "data" / "meta" / "info.json").write_text("nothing is read")
    (tmp_path / "lift.hdf5").write_text("likewise")
    for place in ("lerobot:data", f"lerobot:{tmp_path}/data", "lerobot:user/name", "lift.hdf5"):
        check_place(place, "--dataset")
        check_place(Path(place), "--dataset")
    for place in ("lerobot:absent", "lerobot:a/b/c", "lerobot:lift.hdf5", "lerobot:/user/name"):
        with pytest.raises(FileNotFoundError, match=f"--validation {place}: no such folder"):
            check_place(place, "--validation")
    with pytest.raises(FileNotFoundError, match=r"--dataset absent: no such file$"):
        check_place("absent", "--dataset")
    with pytest.raises(FileNotFoundError, match=r"no such file; .* write lerobot:data"):
        check_place("data", "--dataset")


def test_places_are_the_same_from_elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").mkdir()
    for place in ("lerobot:data", "lerobot:./data", f"lerobot:{tmp_path}/data"):
        assert resolved_place(Path(place)) == f"lerobot:{tmp_path}/data"
        assert name_of_place(Path(place)) == "data"
    assert resolved_place(Path("lerobot:user/name")) == "lerobot:user/name"
    assert resolved_place(Path("lift.hdf5")) == str(tmp_path / "lift.hdf5")
    assert name_of_place("lerobot:.") == tmp_path.name


def test_a_file_is_opened_as_ever(tmp_path):
    path = tmp_path / "lift.hdf5"
    write_robomimic_file(path, task="lift", lengths=(3,))
    found = open_demonstrations(path)
    assert found.name == "lift.hdf5" and found.digest() == file_digest(path)
    assert found.index().cameras == ("agentview",)
    assert len(found.replay(demos=1)) == 3
