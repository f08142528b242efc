import importlib.util
from concurrent.futures import Future
from functools import partial

import numpy as np
import pytest

from tests.data.synthetic import write_robomimic_file

if not all(map(importlib.util.find_spec, ("robosuite", "tyro"))):
    collect_ignore_glob = ["test_*.py"]


class Inline:
    """An engine that computes in this process: fresh ones import for seconds, and know no patches."""

    def __init__(self, workers=1, device="cpu"):
        self.workers = 1

    def takes(self, job):
        return True

    def submit(self, job):
        from lab.running import jobs

        future = Future()
        future.set_result(jobs.call(job.function, job.args))
        return future

    def close(self, kill):
        pass


def blank(figure, path, **options):
    """Write one white pixel: to arrange and draw takes nearly all of a chart's time."""
    from matplotlib.image import imsave

    imsave(path, np.full((1, 1, 3), 255, np.uint8))


@pytest.fixture(scope="module", autouse=True)
def inline(request, short_episodes):
    """Jobs are computed here, charts are blank, and no video is made, unless a test asks for it.

    Flows are measured in few steps: what is looked at is what becomes of the numbers.
    """
    if request.path.name == "test_jobs.py":
        yield
        return
    from matplotlib.figure import Figure

    from lab.running import jobs, pictures
    from lab.running import policies as common

    with pytest.MonkeyPatch.context() as patch:
        local = jobs.Local
        patch.setattr(jobs, "Local", Inline)
        patch.setattr(pictures, "rendering_backend", lambda: None)
        places = ("lab.running.measuring.curvature", "lab.measures.straightness.curvature")
        places += ("warmprior.diagnostics.flow_paths",)  # which scripts import when they draw
        for place in places if request.path.name != "test_measures.py" else ():  # there they are compared
            module, name = place.rsplit(".", 1)
            measure = getattr(importlib.import_module(module), name)
            patch.setattr(place, partial(measure, n_steps=10))
        if request.path.name != "test_plots.py":  # there they are looked at
            patch.setattr(Figure, "savefig", blank)
        yield local
    for cached in (common.cached_task, common.prepared, common.simulator):
        cached.cache_clear()


@pytest.fixture(scope="session")
def dataset(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "lift.hdf5"
    write_robomimic_file(path, lengths=(30, 5, 40), task="lift")
    return path


@pytest.fixture(scope="session")
def validation(tmp_path_factory):
    path = tmp_path_factory.mktemp("held-out") / "val.hdf5"
    write_robomimic_file(path, lengths=(25, 30), task="lift", seed=1)
    return path
