"""Settings of the whole suite."""

from __future__ import annotations

import hypothesis
import pytest
import torch

from warmprior.io.workers import start_method

# The tests' tensors are small: a second thread gains nothing, and on a busy machine costs much.
torch.set_num_threads(1)

# Timings on a shared machine say nothing: no test fails for being slow once.
hypothesis.settings.register_profile("shared-machine", deadline=None)
hypothesis.settings.load_profile("shared-machine")


@pytest.fixture(autouse=True)
def renders_apart():
    """No test leaves behind a process of which forked workers could not render."""
    before = start_method()
    yield
    assert start_method() == before, "let what renders run in tests.processes.apart"
