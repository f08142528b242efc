"""HDF5 files that point elsewhere, declare what they do not hold, or hold what no robot could."""

from __future__ import annotations

import errno
import json
import os
import struct

import h5py
import numpy as np
import pytest

from tests.data.synthetic import env_args_15, write_robomimic_file
from warmprior.data import DatasetError, RobomimicExperienceReplay
from warmprior.data.hdf5 import read_index


def _replace(file, name, value=None, **options):
    del file[name]
    if value is not None:
        file[name] = value
    else:
        file.create_dataset(name, **options)


def _external_storage(file, folder):
    (folder / "secret").write_bytes(b"\x01" * 5 * 7 * 8)
    _replace(
        file,
        "data/demo_1/actions",
        shape=(5, 7),
        dtype="f8",
        external=[(str(folder / "secret"), 0, 5 * 7 * 8)],
    )


def _virtual_without_source(file, folder):
    del file["data/demo_1/actions"]
    layout = h5py.VirtualLayout((5, 7), "f8")
    layout[:] = h5py.VirtualSource(str(folder / "absent.hdf5"), "actions", (5, 7))
    file.create_virtual_dataset("data/demo_1/actions", layout)


def _never_written(file, folder):
    _replace(file, "data/demo_1/actions", shape=(5, 7), dtype="f8")


def _written_in_part(file, folder):
    _replace(file, "data/demo_1/actions", shape=(5, 7), dtype="f8", chunks=(2, 7))
    file["data/demo_1/actions"][:3] = 1


def _external_link(file, folder):
    with h5py.File(folder / "other.hdf5", "w") as other:
        other["actions"] = np.ones((5, 7))
    _replace(file, "data/demo_1/actions", h5py.ExternalLink(str(folder / "other.hdf5"), "/actions"))


def _external_group(file, folder):
    write_robomimic_file(folder / "other.hdf5")
    _replace(file, "data/demo_1", h5py.ExternalLink(str(folder / "other.hdf5"), "/data/demo_1"))


def _soft_link_to_an_external_one(file, folder):
    os.mkfifo(folder / "pipe")  # opening it would never return
    file["elsewhere"] = h5py.ExternalLink(str(folder / "pipe"), "/")
    _replace(file, "data/demo_1/actions", h5py.SoftLink("/elsewhere/actions"))


def _endless_soft_link(file, folder):
    _replace(file, "data/demo_1/actions", h5py.SoftLink("/data/demo_1/actions"))


def _group_for_a_dataset(file, folder):
    del file["data/demo_1/actions"]
    file.create_group("data/demo_1/actions")


def _dataset_for_a_group(file, folder):
    _replace(file, "data/demo_1", np.zeros(3))


def _dataset_for_the_observations(file, folder):
    _replace(file, "data/demo_0/obs", np.zeros(3))


def _dataset_for_data(file, folder):
    _replace(file, "data", np.zeros(3))


def _empty_actions(file, folder):
    _replace(file, "data/demo_1/actions", h5py.Empty("f8"))


def _huge_chunk(file, folder):
    _replace(
        file,
        "data/demo_1/actions",
        shape=(5, 7),
        dtype="f8",
        chunks=(32_000_000, 7),
        maxshape=(None, 7),
        compression="gzip",
    )


def _env_args(value):
    def change(file, folder):
        file["data"].attrs["env_args"] = value

    change.__name__ = f"env_args_{str(value)[:12]}"
    return change


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (_external_storage, ["data/demo_1/actions", "another file", "copy"]),
        (_virtual_without_source, ["data/demo_1/actions", "virtual", "copy"]),
        (_never_written, ["data/demo_1/actions", "never written"]),
        (_written_in_part, ["data/demo_1/actions", "never written"]),
        (_external_link, ["data/demo_1/actions", "link to another file", "other.hdf5"]),
        (_external_group, ["data/demo_1", "link to another file"]),
        (_soft_link_to_an_external_one, ["elsewhere", "link to another file"]),
        (_endless_soft_link, ["data/demo_1/actions", "links"]),
        (_group_for_a_dataset, ["data/demo_1/actions", "a group", "dataset"]),
        (_dataset_for_a_group, ["data/demo_1", "a dataset", "group"]),
        (_dataset_for_the_observations, ["data/demo_0/obs", "a dataset", "group"]),
        (_dataset_for_data, ["data", "a dataset", "group"]),
        (_empty_actions, ["data/demo_1", "no steps"]),
        (_huge_chunk, ["data/demo_1/actions", "chunk", "h5repack"]),
        (_env_args("[" * 100_000), ["env_args", "JSON"]),
        (_env_args(np.bytes_(b'{"a": "\xff\xfe"}')), ["env_args", "JSON"]),
        (_env_args(h5py.Empty("S1")), ["env_args", "text"]),
        (_env_args(3), ["env_args", "text"]),
        (_env_args(np.zeros(4)), ["env_args", "text"]),
        (_env_args(json.dumps({"env_name": ["Lift"], "env_kwargs": {}})), ["env_args", "env_name"]),
        (_env_args(json.dumps({"env_name": "Lift", "env_kwargs": 3})), ["env_args", "env_kwargs"]),
    ],
    ids=lambda value: value.__name__.strip("_") if callable(value) else "",
)
def test_fault_is_refused_by_name(square_file, tmp_path, change, said):
    path, _ = square_file
    with h5py.File(path, "a") as file:
        change(file, tmp_path)
    with pytest.raises(DatasetError) as caught:
        read_index(path)
    for word in ["square.hdf5", *said]:
        assert word in str(caught.value)


@pytest.mark.parametrize("damage", ["place", "overlap", "behind the end"])
def test_an_index_of_chunks_that_is_damaged(square_file, damage):
    """HDF5 reads a chunk that it does not find as zeros, and two that share a place as the same."""
    path, _ = square_file
    with h5py.File(path, "a") as file:
        _replace(file, "data/demo_1/actions", shape=(5, 7), dtype="f8", chunks=(2, 7))
        file["data/demo_1/actions"][...] = 1
        first, second = (
            file["data/demo_1/actions"].id.get_chunk_info(i).byte_offset for i in (0, 1)
        )
    # An entry of the index: where in the array, and where in the file.
    before, size = struct.pack("<4Q", 2, 0, 0, second), path.stat().st_size
    after = {"place": (8, second), "overlap": (2, first), "behind the end": (2, size - 8)}[damage]
    content = path.read_bytes()
    assert content.count(before) == 1
    path.write_bytes(content.replace(before, struct.pack("<4Q", after[0], 0, 0, after[1])))
    with pytest.raises(DatasetError, match=r"square\.hdf5: data/demo_1/actions: its .* again"):
        RobomimicExperienceReplay(path)


def test_soft_links_inside_the_file_are_followed(square_file):
    path, demos = square_file
    with h5py.File(path, "a") as file:
        file.move("data/demo_1/actions", "kept")
        file["data/demo_1/actions"] = h5py.SoftLink("/kept")
        file.move("data/demo_2/rewards", "data/demo_2/sparse")
        file["data/demo_2/rewards"] = h5py.SoftLink("sparse")
    data = RobomimicExperienceReplay(path).data
    np.testing.assert_array_equal(
        data["action"][12:17].numpy(), demos[1]["actions"].astype(np.float32)
    )
    assert data["next", "reward"][-1] == 1


@pytest.mark.parametrize(
    ("mask", "said"),
    [
        (np.zeros((2, 2)), "names of demos"),
        (np.arange(3), "names of demos"),
        (h5py.Empty("S1"), "names of demos"),
        (np.array([b"demo_\xff"]), "utf-8"),
        (np.array([b"demo_0"] * 1000), "1000 names"),
        (None, "a group"),
    ],
    ids=["matrix", "numbers", "empty", "bytes", "long", "group"],
)
def test_masks_of_another_kind(square_file, mask, said):
    path, _ = square_file
    with h5py.File(path, "a") as file:
        del file["mask/train"]
        if mask is None:
            file.create_group("mask/train")
        else:
            file["mask/train"] = mask
    with pytest.raises(DatasetError, match=rf"square\.hdf5: .*mask/train.*({said})"):
        read_index(path, filter_key="train")


def test_a_mask_that_is_no_group(square_file):
    path, _ = square_file
    with h5py.File(path, "a") as file:
        _replace(file, "mask", np.zeros(3))
    with pytest.raises(DatasetError, match=r"square\.hdf5: mask is a dataset"):
        read_index(path, filter_key="train")


def test_more_rows_than_memory_are_refused_before_any_is_taken(square_file, monkeypatch):
    path, _ = square_file
    needed = 47 * (23 * 4 + 7 * 4 + 4 + 3 + 16)
    monkeypatch.setattr("warmprior.data.replay.available_memory", lambda: needed - 1)
    with pytest.raises(DatasetError, match=r"square\.hdf5: 47 steps .*memmap"):
        RobomimicExperienceReplay(path)
    monkeypatch.setattr("warmprior.data.replay.available_memory", lambda: needed)
    RobomimicExperienceReplay(path)


@pytest.mark.parametrize("value", [1e38, -1e38, 1e10])
@pytest.mark.parametrize("key", ["actions", "rewards", "obs/object"])
def test_values_that_no_robot_has(square_file, key, value):
    """One of them would make all others of its feature equal after normalisation."""
    path, _ = square_file
    with h5py.File(path, "a") as file:
        file[f"data/demo_2/{key}"][17, ...] = value
    with pytest.raises(DatasetError, match=rf"square\.hdf5: data/demo_2/{key} .* row 17\b"):
        RobomimicExperienceReplay(path)


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 0), (0, 0, 0, 2), (0.9, 0, 0, 0)])
def test_absolute_actions_need_unit_quaternions(square_file, quaternion):
    path, _ = square_file
    with h5py.File(path, "a") as file:
        file["data/demo_1/obs/robot0_eef_quat"][3] = quaternion
    RobomimicExperienceReplay(path)
    with pytest.raises(
        DatasetError, match=r"square\.hdf5: data/demo_1/obs/robot0_eef_quat .* row 3\b.*length"
    ):
        RobomimicExperienceReplay(path, absolute_actions=True)


@pytest.mark.parametrize("absolute", [False, True])
@pytest.mark.parametrize(
    "change",
    [
        {"controller_configs": 3},
        {"controller_configs": [3]},
        {"controller_configs": {"body_parts": 3}},
        {"controller_configs": {"body_parts": {"right": 3}}},
        {"robots": 3, "controller_configs": {"type": "OSC_POSE", "output_max": "far"}},
    ],
    ids=str,
)
def test_env_args_that_describe_no_environment(tmp_path, change, absolute):
    path = tmp_path / "file.hdf5"
    meta = env_args_15("square")
    meta["env_kwargs"] |= change
    write_robomimic_file(path, env_args=meta)
    if "robots" in change and not absolute:
        return  # nothing asks for them
    with pytest.raises(DatasetError, match=r"file\.hdf5: data\.attrs\['env_args'\]"):
        RobomimicExperienceReplay(path, absolute_actions=absolute)


@pytest.mark.parametrize("named", [False, True])
def test_a_disk_without_space_for_memory_maps(square_file, tmp_path, monkeypatch, named):
    """Before anything is written: writing to a map without space kills the process."""
    path, _ = square_file
    taken = []
    take = os.posix_fallocate

    def count(file, start, length):
        taken.append(length)
        take(file, start, length)

    options = {"storage": "memmap", "scratch_dir": tmp_path / "maps" if named else None}
    monkeypatch.setattr(os, "posix_fallocate", count)
    data = RobomimicExperienceReplay(path, **options).data
    sizes = [v.numel() * v.element_size() for v in data.values(True, True)]
    assert sorted(taken) == sorted(sizes)

    def full(file, start, length):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    monkeypatch.setattr("warmprior.data.robomimic.read_rows", lambda *a: pytest.fail("was filled"))
    with pytest.raises(OSError, match=r"(maps|temporary files): cannot take .*scratch_dir"):
        RobomimicExperienceReplay(path, **options)
