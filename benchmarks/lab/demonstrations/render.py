"""Images for demonstrations, rendered from their simulator states."""

from __future__ import annotations

import json
from collections.abc import Sequence
from concurrent.futures import as_completed
from functools import partial
from pathlib import Path

import numpy as np
from tqdm import tqdm

from lab.io.workers import available_cores, working
from warmprior.checks import check_distinct, check_whole_numbers, given
from warmprior.data.checks import DatasetError
from warmprior.data.formats.hdf5 import RobomimicDemonstrations, open_robomimic
from warmprior.data.formats.hdf5_file import member, reading
from warmprior.data.image_check import StateRenderer, renderer_versions
from warmprior.data.index import DatasetIndex
from warmprior.envs.rendering import require_rendering
from warmprior.io.extras import require
from warmprior.io.files import cache_folder, check_writable, digest_of, exclusive, file_digest, write_atomic
from warmprior.io.machine import available_memory
from warmprior.options.data import IMAGE_SIZE


def render_demonstrations(
    path: str | Path,
    cameras: Sequence[str] | None = None,
    size: int = IMAGE_SIZE,
    *,
    demos: int | None = None,
    fast: bool = False,
    out: str | Path | None = None,
    workers: int | None = None,
) -> Path:
    """Add images to a robomimic file, rendered from the states that it holds.

    The result, whose path is returned, is a copy of the file in robomimic's layout, with
    ``obs/<camera>_image`` uint8 ``[N, size, size, 3]``, upright and compressed, in every demo, without
    ``next_obs``. Images of other cameras stay. The file is written atomically; until then finished demos are
    in a folder next to it, so that an interrupted call continues. The result does not depend on the number of
    workers.

    Args:
        path: a robomimic HDF5 file with states.
        cameras: names of the simulator's cameras; by default those of the task.
        size: side of the images in pixels.

    Keyword Args:
        demos: number of demonstrations to render and keep, from the first on; all if ``None``.
        fast: see :class:`~warmprior.envs.rendering.CameraRenderer`.
        out: file to write or replace, which may be ``path`` itself. ``None`` for the cache
            (``$WARMPRIOR_CACHE``, or ``~/.cache/warmprior`` if that is not set), from which a file rendered
            earlier from the same file is returned at once.
        workers: number of processes; ``None`` for one per available core.

    Raises:
        FileNotFoundError: if there is no such file.
        DatasetError: if the file has no states, states of another simulator, or states that are not finite.
        ValueError: if a camera is unknown, an option is out of range, or the file's images of other cameras
            were rendered in the other quality.
        RuntimeError: if no rendering backend works.
        OSError: if the disk is full; finished demos are kept.

    Examples:
        >>> from lab.demonstrations.render import render_demonstrations
        >>> path = render_demonstrations("square.hdf5", ["agentview"])  # doctest: +SKIP
        >>> path.name  # doctest: +SKIP
        'square_agentview84_1f2e3d4c.hdf5'
        >>> render_demonstrations("nowhere.hdf5", ["agentview"])
        Traceback (most recent call last):
            ...
        FileNotFoundError: nowhere.hdf5: no such file; check the path
    """
    demonstrations = RobomimicDemonstrations(path, demos=demos)
    path, index = Path(path), demonstrations.index()
    if cameras is None:
        cameras = index.task.cameras if index.task else ("agentview", "robot0_eye_in_hand")
    cameras = tuple(cameras)
    check_distinct("cameras to render", cameras)
    check_whole_numbers(size=size, **given(workers=workers))
    needed, free = 3 * size**2 * max(index.lengths) * len(cameras), available_memory()
    if needed > free:
        raise ValueError(
            f"size {size} is too large: the images of a demonstration need {needed / 1e9:.1f} GB of memory, "
            f"and {free / 1e9:.1f} GB are free"
        )
    kept = _rendered_before(demonstrations, index, cameras, fast)
    chosen = [] if demos is None else [demos]
    identity = digest_of(*renderer_versions(), file_digest(path), cameras, size, fast, *chosen)[:8]
    if out is None:
        names = "-".join(cameras) if len(cameras) < 3 else f"{len(cameras)}cameras"
        name = f"{path.stem}_{names}{size}{'fast' if fast else ''}_{identity}.hdf5"
        out = cache_folder() / "rendered" / name
        if out.exists():
            return out
    out = Path(out)
    if demos is not None and out.resolve() == path.resolve():
        raise ValueError(f"{out} would lose all but {demos} demonstrations: choose another out")
    parts = out.with_name(f"{out.name}.{identity}.parts")
    require_rendering()
    check_writable(out.parent)
    illustrator = _Illustrator(index, cameras, size, fast, parts)
    with exclusive(parts):
        missing = [demo for demo in index.demos if not illustrator.part(demo).exists()]
        workers = max(1, min(len(missing), workers or available_cores()))
        count = {"initial": len(index.demos) - len(missing), "total": len(index.demos)}
        bar = tqdm(desc=f"render {path.stem}", unit="demo", **count)
        with working(workers, illustrator) as call, bar:
            call(_Illustrator.check).result()  # before hours of rendering
            for future in as_completed([call(partial(_Illustrator.render, demo=demo)) for demo in missing]):
                future.result()
                bar.update()
        write_atomic(out, lambda temporary: _write(temporary, illustrator, kept))
        for demo in index.demos:
            illustrator.part(demo).unlink()
    parts.rmdir()
    return out


class _Illustrator(StateRenderer):
    """Renders the demos of a file; the simulator is made in the worker process."""

    def __init__(
        self, index: DatasetIndex, cameras: tuple[str, ...], size: int, fast: bool, parts: Path
    ) -> None:
        super().__init__(index, (size, size), fast)
        self.cameras, self.parts = cameras, parts

    def part(self, demo: str) -> Path:
        """Return the temporary file of a finished demo's images."""
        return self.parts / f"{demo}.npz"

    def positions(self, demo: str) -> np.ndarray:
        """Return the positions of all joints before every action, ``[N, nq]``."""
        path, name = self.index.path, f"data/{demo}/states"
        with open_robomimic(path) as file:
            states = member(file, name, "dataset")
            if states is None:
                raise DatasetError(
                    f"{path}: data/{demo} has no states to render: record the file with states"
                )
            with reading(file, name):
                values = np.asarray(states[()])
        return self.joints(values, self.index.lengths[self.index.demos.index(demo)], f"{path}: {name}")

    def check(self) -> None:
        """Render one image of every camera."""
        for camera in self.cameras:
            self.renderer.render(camera, self.positions(self.index.demos[0])[0])

    def render(self, demo: str) -> None:
        """Render all images of a demo."""
        positions = self.positions(demo)
        images = {
            f"{camera}_image": np.stack([self.renderer.render(camera, q) for q in positions])
            for camera in self.cameras
        }

        def write(path: Path) -> None:
            with open(path, "wb") as file:
                np.savez_compressed(file, **images)  # type: ignore[arg-type]

        write_atomic(self.part(demo), write)


def _rendered_before(
    demonstrations: RobomimicDemonstrations, index: DatasetIndex, cameras: Sequence[str], fast: bool
) -> list[str]:
    """Return other cameras with images; raise ValueError if these have the other quality."""
    before, _ = demonstrations.origin(index)
    if before is None:
        return []
    kept = [c for c in index.cameras if c in before["cameras"] and c not in cameras]
    if kept and bool(before["fast"]) != fast:
        raise ValueError(
            f"{index.path}: its images of {', '.join(kept)} were rendered "
            f"{'in full quality' if fast else 'fast'}, and a file has one quality: "
            f"{'leave out' if fast else 'add'} --fast, or render all cameras "
            f"(--cameras {' '.join([*kept, *cameras])})"
        )
    return kept


def _write(path: Path, illustrator: _Illustrator, kept: Sequence[str]) -> None:
    """Write the file with the images of the demos, and its masks if no demo is left out."""
    h5py, (size, _), index = require("h5py", "sim"), illustrator.size, illustrator.index
    kwargs = {"camera_names": list(illustrator.cameras), "camera_heights": size, "camera_widths": size}
    env_args = index.env_args | {"env_kwargs": index.env_args["env_kwargs"] | kwargs}
    with open_robomimic(index.path) as source, h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs.update(source["data"].attrs)
        data.attrs["total"] = sum(index.lengths)
        data.attrs["env_args"] = json.dumps(env_args, indent=4)
        data.attrs["rendering"] = json.dumps(
            {"size": size, "cameras": [*kept, *illustrator.cameras], "fast": illustrator.fast}
        )
        for demo in index.demos:
            data.create_group(demo).attrs.update(source["data"][demo].attrs)
            for name in source["data"][demo]:
                if name != "next_obs":
                    source["data"][demo].copy(name, data[demo])
            with np.load(illustrator.part(demo), allow_pickle=False) as images:
                for name in images:
                    data[demo].require_group("obs").pop(name, None)
                    data[demo]["obs"].create_dataset(
                        name, data=images[name], chunks=(1, size, size, 3), compression="gzip"
                    )
        if "mask" in source and len(index.demos) == len(source["data"]):
            source.copy("mask", file)
