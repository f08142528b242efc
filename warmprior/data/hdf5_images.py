"""Images of robomimic's HDF5 layout: uint8, upright, ``[N, h, w, 3]`` per demo and camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch import Tensor

from warmprior.data.hdf5_members import DatasetError, member, names, reading

if TYPE_CHECKING:
    import h5py

__all__ = ["image_size", "read_images"]

_BLOCK_BYTES = 2**24


def image_size(path: Path, demo: h5py.Group, keys: Sequence[str], steps: int) -> int:
    """Side in pixels of a demo's images, after checking that they are what they should be."""
    name, sizes = demo.name[1:], {}
    for key in keys:
        images = member(demo, f"obs/{key}", "dataset")
        if images is None:
            known = ", ".join(k for k in names(demo["obs"]) if k.endswith("_image")) or "none"
            raise DatasetError(
                f"{path}: {name} has no images {key!r}; it has {known}. Choose other cameras, or render "
                f"them: python -m warmprior render {path} --cameras {key.removesuffix('_image')}"
            )
        shape: tuple[int, ...] = images.shape or ()
        what = f"{path}: {name}/obs/{key} has shape {shape} and type {images.dtype}"
        if images.dtype != "uint8" or len(shape) != 4 or shape[-1] != 3:
            raise DatasetError(
                f"{what}; images are uint8 [steps, height, width, 3]. Render them anew: python -m warmprior "
                "render"
            )
        if shape[0] != steps:
            raise DatasetError(f"{what}, but actions has {steps} rows. Render the file anew")
        if shape[1] != shape[2]:
            raise DatasetError(f"{what}; only square images can be used. Render them anew")
        sizes[key] = shape[1]
    if len(set(sizes.values())) > 1:
        listed = ", ".join(f"{key} {size}" for key, size in sizes.items())
        raise DatasetError(f"{path}: {name} has images of several sizes: {listed}. Render them anew")
    return next(iter(sizes.values()))


def read_images(file: h5py.File, demo: str, key: str, out: Tensor) -> None:
    """Read the images of a demo into uint8 ``[steps, 3, size, size]``, channels first, block by block."""
    name = f"data/{demo}/obs/{key}"
    images: Any = member(file, name, "dataset")
    rows = max(1, _BLOCK_BYTES // max(1, out[0].numel()))
    target = out.numpy()
    for start in range(0, len(out), rows):
        with reading(file, name):
            target[start : start + rows] = images[start : start + rows].transpose(0, 3, 1, 2)
