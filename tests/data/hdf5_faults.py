"""Faults that HDF5 allows in the place of a dataset, and that no recording holds: each is refused."""

import os

import h5py
import numpy as np

from tests.errors import raises
from warmprior.data import DatasetError
from warmprior.data.formats.hdf5 import RobomimicDemonstrations

NUMBERS = ("actions", "rewards", "obs/object", "obs/robot0_eef_pos", "obs/robot0_eef_quat")


def unreadable(path, *facts, steps=None, **options):
    """Check that a file is refused with its name and these facts: by its index, or by its steps."""
    with raises(DatasetError, path.name, *facts):
        file = RobomimicDemonstrations(path, **options)
        file.index() if steps is None else file.steps(**steps)


def replace(file, name, value=None, **options):
    """Put a value there, or a new dataset that has the shape of the old one unless options say otherwise."""
    shape = getattr(file[name], "shape", None)
    del file[name]
    if value is not None:
        file[name] = value
    else:
        file.create_dataset(name, **{"shape": shape, "dtype": "f8"} | options)


def _new(**options):
    return lambda file, name, folder: replace(file, name, **options)


def _external_storage(file, name, folder):
    (folder / "other").write_bytes(bytes(8 * file[name].size))
    replace(file, name, external=[(str(folder / "other"), 0, h5py.h5f.UNLIMITED)])


def _written_in_part(file, name, folder):
    replace(file, name, chunks=(2, *file[name].shape[1:]))
    file[name][:3] = 1


def _in_another_file(file, name, folder):
    with h5py.File(folder / "other.hdf5", "w") as other:
        other["x"] = np.zeros(file[name].shape)
    return str(folder / "other.hdf5"), "x"


def _external_link(file, name, folder):
    replace(file, name, h5py.ExternalLink(*_in_another_file(file, name, folder)))


def _link_to_a_link(file, name, folder):
    if not (folder / "pipe").exists():
        os.mkfifo(folder / "pipe")  # opening it would never return
    file["elsewhere"] = h5py.ExternalLink(str(folder / "pipe"), "/")
    replace(file, name, h5py.SoftLink("/elsewhere/x"))


def _virtual(file, name, folder):
    layout = h5py.VirtualLayout(file[name].shape, "f8")
    layout[:] = h5py.VirtualSource(*_in_another_file(file, name, folder), layout.shape)
    del file[name]
    file.create_virtual_dataset(name, layout)


def _many_rows(file, name, folder):
    row = file[name].shape[1:]
    replace(file, name, shape=(10**9, *row), chunks=(1024, *row), compression="gzip")


def _all_with_many_rows(file, name, folder):
    demo = name.split("/")[1]
    for key in (*NUMBERS, "obs/robot0_gripper_qpos"):
        _many_rows(file, f"data/{demo}/{key}", folder)


def _huge_chunk(file, name, folder):
    row = file[name].shape[1:]
    replace(file, name, chunks=(32_000_000, *row), maxshape=(None, *row), compression="gzip")


def _group(file, name, folder):
    del file[name]
    file.create_group(name)


def _resized(change):
    return lambda file, name, folder: replace(file, name, np.zeros(change(file[name].shape)))


def _holding(value):
    def change(file, name, folder):
        file[name][0, ...] = value

    return change


FAULTS = {
    "external storage": _external_storage,
    "never written": _new(),
    "written in part": _written_in_part,
    "external link": _external_link,
    "link to a link": _link_to_a_link,
    "virtual": _virtual,
    "loop": lambda file, name, folder: replace(file, name, h5py.SoftLink("/" + name)),
    "many rows": _many_rows,
    "all with many rows": _all_with_many_rows,
    "huge chunk": _huge_chunk,
    "group": _group,
    "empty": lambda file, name, folder: replace(file, name, h5py.Empty("f8")),
    "missing": lambda file, name, folder: file.pop(name),
    **{str(dtype): _new(dtype=dtype) for dtype in ("S3", "c16", [("a", "f8")], h5py.string_dtype())},
    "a row less": _resized(lambda shape: (shape[0] - 1, *shape[1:])),
    "a row more": _resized(lambda shape: (shape[0] + 1, *shape[1:])),
    "another dimension": _resized(lambda shape: (*shape, 2)),
    **{str(value): _holding(value) for value in (np.nan, np.inf, -np.inf, 1e38, -1e38)},
}


def damage_heap(path, part, size):
    """Change the size of the first string, or of the free part behind an only one, in a file's last heap."""
    content = bytearray(path.read_bytes())
    string = content.rindex(b"GCOL") + 16
    length = int.from_bytes(content[string + 8 : string + 16], "little")
    header = {"string": string, "free": string + 16 + -(-length // 8) * 8}[part]
    assert content[header : header + 8] == {"string": b"\1" + bytes(7), "free": bytes(8)}[part]
    content[header + 8 : header + 16] = size.to_bytes(8, "little")
    path.write_bytes(content)
