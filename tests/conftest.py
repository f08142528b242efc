"""Settings of the whole suite."""

from __future__ import annotations

import hypothesis
import torch

# The tests' tensors are small: a second thread gains nothing, and on a busy machine costs much.
torch.set_num_threads(1)

# Timings on a shared machine say nothing: no test fails for being slow once.
hypothesis.settings.register_profile("shared-machine", deadline=None)
hypothesis.settings.load_profile("shared-machine")
