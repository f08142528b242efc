"""A folder of robomimic's HDF5 files, such as one per session, as one place."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, override

import numpy as np
from tensordict import TensorDictBase
from torch import Tensor

from warmprior.data.checks import DatasetError, check_count
from warmprior.data.demonstrations import Demonstrations
from warmprior.data.formats.hdf5 import RATE, RobomimicDemonstrations, RobomimicReader, open_robomimic
from warmprior.data.index import DatasetIndex, DemonstrationReader
from warmprior.data.steps import StoredActions, are_poses
from warmprior.io.extras import require
from warmprior.io.files import digest_of, file_digest
from warmprior.modules.recording import Recording

EQUAL = ("env_args", "observation_keys", "observation_dims", "image_shapes", "action_dim", "rewards")
"""All files of a folder agree in these entries of their indices."""

ENDINGS = (".hdf5", ".h5")
"""The usual endings of HDF5 files, in any case."""

NAMED = 5
"""The number of files and folders that are named where they are left out."""


class RobomimicFolder(Demonstrations):
    """The demonstrations of all HDF5 files in a folder, in the order of the files' names.

    Those of folders below are not read; what is left out names them.
    """

    prefix = ""

    @classmethod
    @override
    def reads(cls, place: str) -> bool:
        return Path(place).is_dir()

    @property
    def files(self) -> list[RobomimicDemonstrations]:
        """The files, each with all of its demonstrations, or those of the mask."""
        self.check()
        options: dict[str, Any] = {"mask": self.mask, "image_size": self.image_size, "resize": self.resize}
        return [RobomimicDemonstrations(path, **options) for path in self.paths]

    @property
    def paths(self) -> list[Path]:
        """The files' paths, with any of the usual endings."""
        return sorted(p for p in Path(self.place).iterdir() if p.suffix.lower() in ENDINGS)

    @property
    def others(self) -> list[str]:
        """HDF5 files that are not read: those with another ending, and the folders that hold further ones."""
        is_hdf5, found = require("h5py", "sim").is_hdf5, []
        for path in sorted({*Path(self.place).iterdir()} - {*self.paths}):
            with suppress(OSError):  # what may not be read is not needed either
                if path.is_dir() and not path.is_symlink():
                    below = sum(entry.suffix.lower() in ENDINGS for entry in path.iterdir())
                    found += [f"{path.name}/ with {below} file{'s' if below > 1 else ''}"] if below else []
                elif path.is_file() and is_hdf5(path):
                    found.append(path.name)
        return [*found[:NAMED], f"{len(found) - NAMED} more"] if len(found) > NAMED + 1 else found

    @override
    def check(self) -> None:
        if not self.paths:
            elsewhere = f"; there are {', '.join(found)}" if (found := self.others) else ""
            other = f"a LeRobotDataset is lerobot:{self.place}"
            raise FileNotFoundError(
                f"{self.place}: no file *.hdf5 or *.h5 in this folder{elsewhere}; {other}"
            )

    @override
    def recording(self, index: DatasetIndex, actions: str | None = None) -> Recording:
        found, others = super().recording(index, actions), self.others
        if not others:
            return found
        return replace(found, left_out={**found.left_out, "": [*found.left_out.get("", []), *others]})

    @override
    def index(
        self, observations: Sequence[str] | None = None, images: Sequence[str] = (), *, poses: bool = False
    ) -> DatasetIndex:
        first, *others = indices = [file.index(observations, images, poses=poses) for file in self.files]
        for other, name in ((other, name) for other in others for name in EQUAL):
            if (mine := getattr(other, name)) != (theirs := getattr(first, name)):
                values = "" if name == "env_args" else f" ({mine}, not {theirs})"
                raise DatasetError(
                    f"{other.path}: {name} differ from those of {first.path}{values}: keep recordings of one "
                    "environment and robot in a folder, or choose observations that all have"
                )
        rates = {index.rate: index.path for index in indices if index.rate is not None}
        if len(rates) > 1:
            (one, first_path), (two, second_path), *_ = rates.items()
            raise DatasetError(
                f"{second_path} has {two:g} control steps per second, and {first_path} {one:g}: keep them in "
                f"folders of their own, or correct data.attrs[{RATE!r}]"
            )
        present = sorted({key for index in indices for key in index.available_keys})
        options = {
            key: {i.taken_by.get(key, "observations") if key in i.available_keys else "" for i in indices}
            for key in present
        }
        demos = [f"{index.path.name}/{demo}" for index in indices for demo in index.demos]
        lengths = [length for index in indices for length in index.lengths]
        check_count(Path(self.place), self.demos, len(demos))
        return replace(
            first,
            path=Path(self.place),
            rate=next(iter(rates), None),
            demos=tuple(demos[: self.demos]),
            lengths=tuple(lengths[: self.demos]),
            available_keys=tuple(present),
            # What some files lack cannot be chosen.
            taken_by={key: found.pop() if len(found) == 1 else "" for key, found in options.items()},
            whole=self.demos in (None, len(demos)),
        )

    @override
    def steps(
        self,
        observations: Sequence[str] | None = None,
        images: Sequence[str] = (),
        *,
        actions: StoredActions = "delta",
        **options: Any,
    ) -> TensorDictBase:
        kinds = {}
        for file in self.files if actions != "stored" else ():
            index = file.index(observations, images)
            with file.reader(index) as reader:
                kinds[are_poses(index, reader)] = file  # low_dim_abs.hdf5 lies beside low_dim.hdf5
        if len(kinds) > 1:
            raise DatasetError(
                f"{kinds[True]}: actions are poses, and in {kinds[False]} deltas: leave one out"
            )
        return super().steps(observations, images, actions=actions, **options)

    @contextmanager
    @override
    def reader(self, index: DatasetIndex) -> Iterator[DemonstrationReader]:
        with ExitStack() as opened:
            yield _FolderReader(Path(self.place), opened)

    @override
    def contents(self, index: DatasetIndex) -> str:
        return digest_of(*(file_digest(file.path) for file in self.files))

    @override
    def origin(self, index: DatasetIndex) -> tuple[dict[str, Any] | None, np.ndarray | None]:
        first = self.files[0]
        return first.origin(first.index())


class _FolderReader(DemonstrationReader):
    """A reader that has one file open at a time."""

    def __init__(self, folder: Path, opened: ExitStack) -> None:
        self.folder, self.opened, self.file = folder, opened, ""
        self.reader: Any = None

    def at(self, demo: str) -> tuple[DemonstrationReader, str]:
        """Return the reader of the file with a demo, and the demo's name there."""
        file, _, name = demo.rpartition("/")
        if file != self.file:
            self.opened.close()
            opened = open_robomimic(self.folder / file)
            self.reader, self.file = RobomimicReader(self.opened.enter_context(opened)), file
        return self.reader, name

    def numbers(self, demo: str, key: str, out: np.ndarray, first: int = 0) -> None:
        """Read and check rows of the demo in its file."""
        reader, name = self.at(demo)
        reader.numbers(name, key, out, first)

    def images(self, demo: str, key: str) -> Iterator[Tensor]:
        """Yield the images of the demo in its file."""
        reader, name = self.at(demo)
        return reader.images(name, key)

    def name(self, demo: str, key: str) -> str:
        """Return the file of the demo, and its array."""
        reader, name = self.at(demo)
        return reader.name(name, key)
