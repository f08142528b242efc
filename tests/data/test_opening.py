"""Where demonstrations are, as command lines name it."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("pyarrow")

from warmprior.data.opening import check_place


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
