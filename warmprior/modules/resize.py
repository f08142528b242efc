"""Images at the size that policies see: one function for reading, simulators and robots."""

from __future__ import annotations

from torch import Tensor, uint8
from torch.nn.functional import interpolate, pad

from warmprior.options.data import Resize


def resized(images: Tensor, size: tuple[int, int], resize: Resize = "squeeze") -> Tensor:
    """Return images at another size, bilinear and antialiased, uint8 ``[*B, 3, *size]``.

    On a GPU values differ by up to 1 from those on a CPU.

    Args:
        images: uint8 ``[*B, 3, h, w]``; those of the right size are returned as they are.
        size: height and width in pixels.
        resize: ``"squeeze"`` changes the ratio of the sides if needed; ``"pad"`` keeps it and adds black
            borders of equal width.

    Examples:
        >>> import torch
        >>> from warmprior.modules.resize import resized
        >>> camera = torch.full((2, 3, 480, 640), 9, dtype=torch.uint8)
        >>> resized(camera, (84, 84)).shape, resized(camera, (84, 84), "pad")[0, 0, [0, 42, 83], 0].tolist()
        (torch.Size([2, 3, 84, 84]), [0, 9, 0])
    """
    (height, width), inner = images.shape[-2:], size
    if resize == "pad":
        scale = min(size[0] / height, size[1] / width)
        inner = max(1, round(height * scale)), max(1, round(width * scale))
    if (height, width) != inner:
        flat = images.reshape(-1, *images.shape[-3:])
        flat = flat.float() if images.is_cuda else flat  # bytes can be resized on a CPU alone
        flat = interpolate(flat, inner, mode="bilinear", antialias=True).round().to(uint8)
        images = flat.reshape(*images.shape[:-2], *inner)
    top, left = ((whole - part) // 2 for whole, part in zip(size, inner, strict=True))
    return pad(images, (left, size[1] - inner[1] - left, top, size[0] - inner[0] - top))
