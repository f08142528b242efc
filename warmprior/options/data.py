"""Options of the data that policies see and give: images' size, and the kind of actions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Actions = Literal["delta", "absolute"]
"""Actions of a policy: pose deltas as robosuite's environments take them, or the poses that they target."""

Resize = Literal["squeeze", "pad"]

PLACES = (
    "a robomimic HDF5 file or a folder of them, lerobot:FOLDER or lerobot:USER/NAME of a LeRobotDataset, or "
    "minari:NAME"
)
"""The places of demonstrations, as help says them: one per format of ``warmprior.data.opening.FORMATS``."""

IMAGE_SIZE = 84
"""The default side of images in pixels, as in the paper (Table 3).

Without an image size, :meth:`~warmprior.data.Demonstrations.image_entries` takes it for images of several
shapes, or that are not square.
"""

IMAGE_SIZES = (8, 1024)
"""The least and largest side of images that policies see: a decision on larger ones takes gigabytes."""


@dataclass(frozen=True, kw_only=True)
class Resizing:
    """The options of images' size.

    Attributes:
        image_size: side in pixels to which images are resized; by default squares of one size stay as they
            are, and others are resized to 84.
        resize: how images that are not square become so: squeezed, or padded with black.
    """

    image_size: int | None = None
    resize: Resize = "squeeze"
