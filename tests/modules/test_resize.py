"""Images of any size at a policy's size, against Pillow's antialiased resizing."""

import numpy as np
import pytest
import torch

from warmprior.modules.resize import resized

image = pytest.importorskip("PIL.Image")


def frames(height, width, count=3):
    """Smooth and sharp structures, in which a resizing that is not antialiased is off by more than 10."""
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[:height, :width]
    stripes = 255 * ((rows // 3 + columns // 2) % 2)
    noise = rng.integers(0, 256, (count, height, width))
    return np.stack([noise, np.broadcast_to(stripes, noise.shape), 255 - noise], -1).astype(np.uint8)


def by_pillow(pictures, height, width):
    return np.stack([image.fromarray(p).resize((width, height), image.Resampling.BILINEAR) for p in pictures])


def first(pictures):
    return torch.from_numpy(pictures).permute(0, 3, 1, 2)


@pytest.mark.parametrize("shape", [(480, 640), (48, 85), (85, 48), (32, 32)])
def test_squeezed_as_by_pillow(shape):
    pictures = frames(*shape)
    found = resized(first(pictures), (84, 84))
    assert found.dtype == torch.uint8
    off = found.permute(0, 2, 3, 1).numpy().astype(int) - by_pillow(pictures, 84, 84)
    assert np.abs(off).max() <= 1
    alone = torch.stack([resized(picture.contiguous(), (84, 84)) for picture in first(pictures)])
    assert torch.equal(alone, found)
    stacked = resized(first(pictures)[None, :, None], (84, 84))
    assert torch.equal(stacked, found[None, :, None])


@pytest.mark.parametrize(("shape", "inner"), [((480, 640), (63, 84)), ((85, 48), (84, 47))])
def test_padded_around_what_pillow_gives(shape, inner):
    pictures = frames(*shape)
    found = resized(first(pictures), (84, 84), "pad").permute(0, 2, 3, 1).numpy().astype(int)
    expected = np.zeros((3, 84, 84, 3), int)
    top, left = (84 - inner[0]) // 2, (84 - inner[1]) // 2
    expected[:, top : top + inner[0], left : left + inner[1]] = by_pillow(pictures, *inner)
    assert np.abs(found - expected).max() <= 1
    assert not found[:, :top].any() and not found[:, :, :left].any()


def test_images_of_the_size_are_unchanged():
    pictures = first(frames(84, 84))
    for resize in ("squeeze", "pad"):
        assert torch.equal(resized(pictures, (84, 84), resize), pictures)
