"""Makes products and convolutions depend on the number of rows in their last bits.

Every processor does this in its own way: it takes other instructions for other sizes, which add up in another
order. What holds here holds on all of them. This folder is on the path of ``make test-ulp``; there torch
finds the entry point beside this file, in the tests' processes and in those that they start.
"""

import random
import warnings
from functools import cache

import torch
from torch import ops

KERNELS = torch.library.Library("aten", "IMPL")


@cache
def factors(rows, columns, dtype):
    """Numbers within two units in the last place of one: others for each column and number of rows."""
    drawn = random.Random(rows)
    units = [drawn.randint(-2, 2) for _ in range(columns)]
    return 1 + torch.finfo(dtype).eps * torch.tensor(units, dtype=dtype, device="cpu")


def changed(out, dim):
    # Sums are kept in single precision: with fewer digits there is seldom a difference.
    if out.dtype in (torch.float32, torch.float64) and out.numel():
        columns = out.shape[dim]
        factor = factors(out.numel() // columns, columns, out.dtype)
        out *= factor.reshape(-1, *[1] * (-1 - dim))
    return out


def into(product):
    """A product through its ``out``, whose kernel stays torch's."""

    def kernel(*args, **kwargs):
        *_, left, right = args
        out = left.new_empty(*left.shape[:-1], right.shape[-1])
        return changed(product.out(*args, **kwargs, out=out), -1)

    return kernel


def convolution(image, *args):
    out = ops.aten._convolution(image, *args, False, False, False, False)
    return changed(out, 1 - image.ndim)


@cache
def install():
    with warnings.catch_warnings(action="ignore"):  # that kernels are replaced
        for name in ("mm", "bmm", "addmm", "baddbmm"):
            KERNELS.impl(name, into(getattr(ops.aten, name)), "CPU")
        KERNELS.impl("convolution", convolution, "CPU")
