"""Settings of the whole suite."""

from __future__ import annotations

import torch

# The tests' tensors are small: a second thread gains nothing, and on a busy machine costs much.
torch.set_num_threads(1)
