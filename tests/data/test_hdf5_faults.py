"""HDF5 files that point elsewhere, declare what they do not hold, or hold what no robot could."""

import json
import os
import struct

import h5py
import numpy as np
import pytest

from tests.data.hdf5_faults import FAULTS, damage_heap, replace, unreadable
from tests.errors import refuses
from tests.fuzz import sandbox
from warmprior.data.formats.hdf5 import RobomimicDemonstrations
from warmprior.data.formats.heaps import open_checked


def replaced(name, value):
    return lambda file, folder: replace(file, f"data/demo_1/{name}", value)


def env_args(value):
    return lambda file, folder: file["data"].attrs.update(env_args=value)


def _no_demos(file, folder):
    for name in list(file["data"]):
        del file["data"][name]


def _two_rewards(file, folder):
    for name, demo in file["data"].items():
        replace(file, f"data/{name}/rewards", np.zeros((len(demo["actions"]), 2)))


ACTIONS, OBJECT = "data/demo_1/actions", "data/demo_1/obs/object"
OTHERS = {
    "dataset for a group": (replaced("", np.zeros(3)), ["data/demo_1", "dataset", "group"]),
    "dataset for observations": (replaced("obs", np.zeros(3)), ["data/demo_1/obs", "dataset", "group"]),
    "link to nothing": (replaced("", h5py.SoftLink("/nothing")), ["data/demo_1"]),
    "deep JSON": (env_args("[" * 100_000), ["env_args", "JSON"]),
    "type": (
        env_args(json.dumps({"env_name": "Lift", "type": {}, "env_kwargs": {}})),
        ["env_args", "type={}"],
    ),
    "no name": (env_args(json.dumps({"type": 1})), ["env_name"]),
    "number for kwargs": (env_args('{"env_name": "Lift", "env_kwargs": 3}'), ["env_args", "env_kwargs"]),
    "no data": (lambda f, folder: f.move("data", "elsewhere"), ["'data'", "elsewhere"]),
    "no demos": (_no_demos, ["no demos"]),
    "other name": (lambda f, folder: f.move("data/demo_1", "data/second"), ["data/second"]),
    "no key": (lambda f, folder: f.pop(OBJECT), ["data/demo_1", "'object'", "robot0_eef_pos"]),
    "short object": (replaced("obs/object", np.zeros((4, 14))), [OBJECT, "(4, 14)", "5 rows"]),
    "wide actions": (replaced("actions", np.zeros((5, 8))), [ACTIONS, "(5, 8)", "NutAssemblySquare", 7]),
    "two rewards": (_two_rewards, ["data/demo_0/rewards", "(12, 2)"]),
    "text": (replaced("obs/object", np.array([b"a"] * 5)), [OBJECT, "numbers"]),
}
NAMED = {
    "external storage": [OBJECT, "another file"],
    "virtual": [OBJECT, "another file"],
    "external link": [OBJECT, "other.hdf5"],
    "link to a link": ["elsewhere", "pipe"],
    "group": [OBJECT, "group", "dataset"],
    "huge chunk": [OBJECT, "h5repack"],
    "all with many rows": ["data/demo_1"],
    "missing": ["data/demo_1", "'object'"],
}


@pytest.mark.parametrize("fault", FAULTS)
def test_no_recording_is_read_that_holds(square_file, tmp_path, fault):
    path, _ = square_file
    with h5py.File(path, "a") as file:
        FAULTS[fault](file, OBJECT, tmp_path)
    unreadable(path, *NAMED.get(fault, [OBJECT]), steps={})


@pytest.mark.parametrize("name", OTHERS)
def test_what_does_not_fit_is_refused_by_name(square_file, tmp_path, name):
    path, _ = square_file
    change, facts = OTHERS[name]
    with h5py.File(path, "a") as file:
        change(file, tmp_path)
    unreadable(path, *facts, steps={})


@pytest.mark.parametrize("damage", ["place", "overlap", "behind the end"])
def test_an_index_of_chunks_that_is_damaged(square_file, damage):
    """HDF5 reads a chunk that it does not find as zeros, and two that share a place as the same."""
    path, _ = square_file
    with h5py.File(path, "a") as file:
        replace(file, "data/demo_1/actions", chunks=(2, 7))
        file["data/demo_1/actions"][...] = 1
        first, second = (file["data/demo_1/actions"].id.get_chunk_info(i).byte_offset for i in (0, 1))
    # An entry of the index: where in the array, and where in the file.
    before, size = struct.pack("<4Q", 2, 0, 0, second), path.stat().st_size
    after = {"place": (8, second), "overlap": (2, first), "behind the end": (2, size - 8)}[damage]
    content = path.read_bytes()
    assert content.count(before) == 1
    path.write_bytes(content.replace(before, struct.pack("<4Q", after[0], 0, 0, after[1])))
    unreadable(path, "data/demo_1/actions", steps={})


def test_values_whose_storage_ends_before_they_do(square_file):
    """By one number: HDF5 makes zeros of what is missing."""
    path, _ = square_file
    with h5py.File(path) as file:
        place = file["data/demo_1/actions"].id.get_offset()
    content, before = path.read_bytes(), struct.pack("<2Q", place, 5 * 7 * 8)
    assert content.count(before) == 1
    path.write_bytes(content.replace(before, struct.pack("<2Q", place, 5 * 7 * 8 - 8)))
    unreadable(path, "data/demo_1/actions", "never written", steps={})


MASKS = {
    "matrix": (np.zeros((2, 2)), "demos"),
    "bytes": (np.array([b"demo_\xff"]), "utf-8"),
    "long": (np.array([b"demo_0"] * 1000), 1000),
    "group": (None, "group"),
}


@pytest.mark.parametrize("name", MASKS)
def test_masks_of_another_kind(square_file, name):
    path, _ = square_file
    mask, fact = MASKS[name]
    with h5py.File(path, "a") as file:
        del file["mask/train"]
        if mask is None:
            file.create_group("mask/train")
        else:
            file["mask/train"] = mask
    unreadable(path, "mask/train", fact, mask="train")


@pytest.mark.parametrize("mask", [None, "texts"])
@pytest.mark.parametrize(("part", "size"), [("free", 0), ("free", 8), ("string", 2**64 - 16)])
def test_a_heap_of_strings_over_which_hdf5_walks_for_ever(square_file, monkeypatch, part, size, mask):
    path, _ = square_file
    if mask is not None:
        with h5py.File(path, "a") as file:
            file.create_dataset(f"mask/{mask}", data=["demo_0"], dtype=h5py.string_dtype())
    damage_heap(path, part, size)
    monkeypatch.setattr(sandbox, "LIMIT_SECONDS", 10.0)
    found = sandbox.attempt(RobomimicDemonstrations(path, mask=mask).steps, str(path))
    assert found.kind == "refused", found
    assert "heap" in found.detail


@pytest.mark.parametrize("part", ["string", "heap"])
def test_a_heap_that_is_damaged_or_longer_than_the_file(square_file, part):
    path, _ = square_file
    if part == "string":
        damage_heap(path, part, 2**64 - 16)
    else:
        content = bytearray(path.read_bytes())
        heap = content.rindex(b"GCOL")
        content[heap + 8 : heap + 16] = (2**40).to_bytes(8, "little")
        path.write_bytes(content)
    unreadable(path, "heap")


def test_a_file_that_is_cut_off_while_it_is_read(square_file):
    path, _ = square_file
    with open_checked(path) as file:
        actions = file["data/demo_2/actions"]
        os.truncate(path, actions.id.get_offset() + 8)
        refuses(lambda: actions[()], OSError, "ends early")


def test_more_rows_than_memory_are_refused_before_any_is_taken(square_file, monkeypatch):
    path, _ = square_file
    needed = 47 * (23 * 4 + 7 * 4 + 4 + 3 + 16)
    monkeypatch.setattr("warmprior.data.steps.available_memory", lambda: needed - 1)
    unreadable(path, 47, steps={})
    monkeypatch.setattr("warmprior.data.steps.available_memory", lambda: needed)
    RobomimicDemonstrations(path).steps()
    with h5py.File(path, "a") as file:
        for demo in file["data"].values():
            demo["obs/front"] = np.zeros((len(demo["actions"]), 8, 8, 3), np.uint8)
    unreadable(path, 47, "memmap", steps={"images": ["front"]})
    RobomimicDemonstrations(path).steps(images=["front"], storage="memmap")


@pytest.mark.parametrize("value", [np.nan, -np.inf, 1e39, -1e38, 1e10])
@pytest.mark.parametrize("key", ["actions", "rewards", "obs/object"])
def test_values_that_no_robot_has(square_file, key, value):
    """One of them would make all others of its feature equal after normalisation."""
    path, _ = square_file
    with h5py.File(path, "a") as file:
        file[f"data/demo_2/{key}"][17, ...] = value
    unreadable(path, f"data/demo_2/{key}", "row 17", steps={})


OFFSETS = {"metres of a map": (5.4e6, 0.05), "ticks": (10**8, 3), "seconds": (2e8, 0.05)}


@pytest.mark.parametrize("name", OFFSETS)
@pytest.mark.parametrize("key", ["actions", "obs/object"])
def test_large_numbers_whose_steps_float32_would_lose(square_file, key, name):
    path, _ = square_file
    offset, step = OFFSETS[name]

    def write(values):
        """Write a column that rests in the first demo, and begins elsewhere in each of the others."""
        with h5py.File(path, "a") as file:
            for number, demo in enumerate(file["data"].values()):
                column = values(np.arange(len(demo["actions"])) * (number > 0)) + 1000 * number
                old = demo[key][()].astype(column.dtype)
                old[:, 2] = column
                replace(demo, key, old)

    write(lambda t: offset + step * t)
    facts = "column 2", f"{np.spacing(np.float32(offset + 1000)):g}", f"{step:g}", "offset"
    unreadable(path, f"data/demo_1/{key}", *facts, steps={"actions": "stored"})
    # Without the offset, in large steps, at rest, or as they were recorded in float32.
    for values in (
        lambda t: step * t,
        lambda t: offset + 1000 * step * t,
        lambda t: np.full(len(t), offset + 0.3),
        lambda t: (offset + step * t).astype(np.float32),
    ):
        write(values)
        RobomimicDemonstrations(path).steps(actions="stored")


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 0), (0, 0, 0, 2), (0.9, 0, 0, 0)])
def test_absolute_actions_need_unit_quaternions(square_file, quaternion):
    path, _ = square_file
    with h5py.File(path, "a") as file:
        file["data/demo_1/obs/robot0_eef_quat"][3] = quaternion
    RobomimicDemonstrations(path).steps()
    unreadable(path, "data/demo_1/obs/robot0_eef_quat", "row 3", steps=dict(actions="absolute"))
