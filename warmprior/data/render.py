"""Turns the simulator states of demonstrations into images."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import as_completed
from functools import cached_property, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from warmprior.data.hdf5 import member, open_robomimic, read_index, read_origin, reading
from warmprior.data.replay import DatasetError, DatasetIndex
from warmprior.envs.env_args import modernize_env_args
from warmprior.envs.rendering import CameraRenderer, require_rendering
from warmprior.envs.simulator import isolated_numpy_seed, make_simulator
from warmprior.io.extras import require
from warmprior.io.files import cache_folder, check_writable, digest_of, exclusive, file_digest, write_atomic
from warmprior.io.workers import available_cores, working

RENDERER_VERSION = 2
"""Part of every cached file's name; raised whenever the same states give other images."""

CLEARLY = 8.0
"""Mean difference of two images, of 255, from which on they show something else."""


def render_demonstrations(
    path: str | Path,
    cameras: Sequence[str] | None = None,
    size: int = 84,
    *,
    demos: int | None = None,
    fast: bool = False,
    out: str | Path | None = None,
    workers: int | None = None,
) -> Path:
    """Add images to a robomimic file, rendered from the states that it holds.

    The result, whose path is returned, is a copy of the file in robomimic's layout, with
    ``obs/<camera>_image`` uint8 ``[N, size, size, 3]``, upright and compressed, in every demo, without
    ``next_obs``. Images of other cameras stay. It appears when it is complete; finished demos lie in a folder
    next to it until then, from which an interrupted call continues. The number of workers changes nothing.

    Args:
        path: a robomimic HDF5 file with states.
        cameras: names of the simulator's cameras; by default those of the task.
        size: side of the images in pixels.

    Keyword Args:
        demos: how many to render and keep, the first ones by their numbers; all if ``None``.
        fast: see :class:`~warmprior.envs.rendering.CameraRenderer`.
        out: where to write, replacing what is there; may be ``path`` itself. ``None`` for the cache
            (``$WARMPRIOR_CACHE``, or ``~/.cache/warmprior`` if that is not set), from which a file rendered
            earlier from the same file is returned at once.
        workers: number of processes; ``None`` for one per available core.

    Raises:
        FileNotFoundError: if there is no such file.
        DatasetError: if it holds no states, those of another simulator, or some that are not finite.
        ValueError: if there is no such camera, an option is out of range, or images of other cameras in the
            file were rendered in the other quality.
        RuntimeError: if nothing here can render.
        OSError: if the disk is full; what is finished stays.

    Examples:
        >>> from warmprior.data import render_demonstrations
        >>> path = render_demonstrations("square.hdf5", ["agentview"])  # doctest: +SKIP
        >>> path.name  # doctest: +SKIP
        'square_agentview84_1f2e3d4c.hdf5'
        >>> render_demonstrations("nowhere.hdf5", ["agentview"])
        Traceback (most recent call last):
            ...
        FileNotFoundError: nowhere.hdf5: no such file; check the path, ...
    """
    path, index = Path(path), read_index(path, demos=demos)
    if cameras is None:
        cameras = index.task.cameras if index.task else ("agentview", "robot0_eye_in_hand")
    cameras = tuple(cameras)
    if not cameras or len(set(cameras)) < len(cameras):
        raise ValueError(f"name different cameras to render, got {list(cameras)}")
    for name, value in {"size": size, "workers": workers}.items():
        if value is not None and value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")
    kept = _rendered_before(path, index, cameras, fast)
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
            call(_Illustrator.check).result()  # before hours are spent
            for future in as_completed([call(partial(_Illustrator.render, demo=demo)) for demo in missing]):
                future.result()
                bar.update()
        write_atomic(out, lambda temporary: _write(temporary, illustrator, kept))
        for demo in index.demos:
            illustrator.part(demo).unlink()
    parts.rmdir()
    return out


def renderer_versions() -> tuple[int | str, ...]:
    """What the same states' images depend on, beside how they are asked for."""
    return RENDERER_VERSION, version("mujoco"), version("robosuite")


class _Illustrator:
    """Renders the demos of a file; its simulator is made in the worker that renders."""

    def __init__(
        self, index: DatasetIndex, cameras: tuple[str, ...], size: int, fast: bool, parts: Path
    ) -> None:
        self.index, self.cameras, self.parts = index, cameras, parts
        self.size, self.fast = size, fast

    @cached_property
    def renderer(self) -> CameraRenderer:
        env = make_simulator(modernize_env_args(self.index.env_args))
        placed = []
        with isolated_numpy_seed(0):
            for _ in range(2):
                env.reset()  # which hides the grippers' markers, too, that no episode shows
                model = env.sim.model._model
                placed.append(np.concatenate([model.body_pos, model.body_quat], -1))
        if not np.array_equal(*placed):
            raise DatasetError(
                f"{self.index.path}: {self.index.env_args['env_name']} moves fixtures at every reset, and "
                "states do not tell where to: its images cannot be rendered from them"
            )
        return CameraRenderer(model, self.size, self.size, fast=self.fast)

    def part(self, demo: str) -> Path:
        """Where the images of a finished demo wait for the others."""
        return self.parts / f"{demo}.npz"

    def positions(self, demo: str) -> np.ndarray:
        """Positions of all joints before every action, ``[N, nq]``."""
        path, name = self.index.path, f"data/{demo}/states"
        with open_robomimic(path) as file:
            states = member(file, name, "dataset")
            if states is None:
                raise DatasetError(f"{path}: data/{demo} has no states to render: record them")
            with reading(file, name):
                found = np.asarray(states[()])
        return self._joints(found, self.index.lengths[self.index.demos.index(demo)], f"{path}: {name}")

    def _joints(self, states: np.ndarray, steps: int, what: str) -> np.ndarray:
        """Positions of all joints, ``[steps, nq]``, in states of this simulator."""
        model = self.renderer.model
        expected = (steps, 1 + model.nq + model.nv)
        if states.shape != expected:
            raise DatasetError(
                f"{what} has shape {states.shape}, but the simulator of "
                f"{self.index.env_args['env_name']} has {expected}: its robots or objects are others here"
            )
        usable = np.isfinite(states).all(-1)
        if not usable.all():  # MuJoCo would show something all the same
            raise DatasetError(
                f"{what} has NaN or infinity in row {int(np.argmin(usable))}: record it again, or leave the "
                "demo out"
            )
        return states[:, 1 : 1 + model.nq]

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

    def compare(self, state: Sequence[float], images: Mapping[str, np.ndarray], advice: str) -> None:
        """Compare images of a state, by camera, with the simulator's."""
        name = self.index.path
        (joints,) = self._joints(np.array([state], np.float64), 1, f"{name}: the first state")
        for camera, image in images.items():
            shown = self.renderer.render(camera, joints).astype(np.float32)
            stored = image.astype(np.float32)
            views = {
                "show something else than the simulator": stored,
                "are upside down": stored[::-1],
                "have red and blue exchanged": stored[..., ::-1],
            }
            off = {name: float(np.abs(shown - image).mean()) for name, image in views.items()}
            (as_stored, *_), view = off.values(), min(off, key=lambda name: off[name])
            # Most of a scene may look alike upside down, and have little colour.
            other = as_stored > 1 and off[view] < as_stored / 2
            if other or as_stored > CLEARLY:
                view = view if other else next(iter(views))
                raise DatasetError(
                    f"{name}: the images of {camera} {view} ({as_stored:.0f} of 255 off on average). "
                    f"Policies would see other ones in evaluation: {advice}"
                )


def _rendered_before(path: Path, index: DatasetIndex, cameras: Sequence[str], fast: bool) -> list[str]:
    """Other cameras whose images are known to be of the quality that is asked for: one goes for a file."""
    before, _ = read_origin(path, index.demos[0])
    if before is None:
        return []
    kept = [c for c in index.cameras if c in before["cameras"] and c not in cameras]
    if kept and bool(before["fast"]) != fast:
        raise ValueError(
            f"{path}: its images of {', '.join(kept)} were rendered {'in full quality' if fast else 'fast'}, "
            f"and one quality goes for all: {'leave out' if fast else 'add'} --fast, or render all cameras "
            f"(--cameras {' '.join([*kept, *cameras])})"
        )
    return kept


def _write(path: Path, illustrator: _Illustrator, kept: Sequence[str]) -> None:
    """The file with the images of the demos, and with its masks if all of them are in it."""
    h5py, size, index = require("h5py", "sim"), illustrator.size, illustrator.index
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


def compare_first_images(
    index: DatasetIndex,
    images: Mapping[str, np.ndarray],
    state: Sequence[float] | None,
    rendering: Mapping[str, Any] | None,
    fast: bool,
    advice: str,
) -> None:
    """Compare images of one state, uint8 ``[size, size, 3]`` by camera, with what the simulator shows there.

    A ``DatasetError`` if they differ, or are of the other quality; a warning where there is no state.
    """
    path = index.path
    if rendering is not None and bool(rendering["fast"]) != fast:
        raise DatasetError(
            f"{path}: its images were rendered {'in full quality' if fast else 'fast'}, and in evaluation "
            f"they would not be: {'leave out' if fast else 'add'} --fast-rendering"
        )
    if state is None:
        warnings.warn(
            f"{path} holds no states: its images could not be compared with the simulator's", stacklevel=2
        )
        return
    illustrator = _Illustrator(index, tuple(images), index.image_size, fast, path)
    # In a process of its own: one that has rendered cannot fork others that do.
    with working(1, illustrator) as call:
        call(partial(_Illustrator.compare, state=state, images=images, advice=advice)).result()
