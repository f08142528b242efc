import functools
import gc
import multiprocessing
import os
import random
import subprocess
import sys
from pathlib import Path
from unittest.mock import patch

import pytest

collect_ignore = ["rows", "fuzz/generators.py", "fuzz/__main__.py"]  # parts of other runs, see there


def pytest_addoption(parser):
    parser.addoption("--shuffle", type=int, help="a seed: run the files, and the tests of each, in its order")


LONG = [
    *("benchmarks/test_tasks.py", "benchmarks/test_studies.py", "benchmarks/test_policies.py"),
    *("rl/test_training.py", "envs/test_robosuite.py", "benchmarks/test_prior_space_rl.py"),
    *("deploy/test_exported.py", "benchmarks/test_robomimic.py", "evaluation/test_evaluation.py"),
]
"""Files of tens of seconds, which start first: begun last, one of them would keep a single core busy."""

ALSO_OF_LEROBOT = [
    *("tests/test_given_blocks.py", "tests/data/test_convert.py", "tests/data/test_recorded_actions.py"),
    *("tests/data/test_image_sizes.py", "tests/tasks/test_task.py", "tests/tasks/test_recording.py"),
    *("tests/benchmarks/test_joint_targets.py", "tests/benchmarks/test_paper_facts.py"),
    *("tests/benchmarks/test_speed.py", "tests/modules/test_real_time_chunking.py"),
    *("tests/test_docs.py", "tests/test_main.py"),
]


def pytest_configure(config):
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False  # else those of most tests start first


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Let one process run all tests of LeRobot, whose import takes seconds; others are given out by file."""
    from xdist.scheduler import LoadFileScheduling

    class ByFile(LoadFileScheduling):
        def _split_scope(self, nodeid):
            file = super()._split_scope(nodeid)
            return "lerobot" if "lerobot" in file or file in ALSO_OF_LEROBOT else file

    return ByFile(config, log) if config.getoption("dist") == "loadfile" else None


def pytest_sessionstart(session):
    """Prepare a process that runs tests; one that hands them out to others need not import PyTorch."""
    if session.config.getoption("numprocesses", None):
        return
    import hypothesis
    import torch

    # The tests' tensors are small: a second thread gains nothing, and on a busy machine costs much. TorchRL
    # goes back to the number that it was imported with when an environment closes, and with more than one a
    # process forked after that would wait for threads that it lacks: so before it is imported.
    if "OMP_NUM_THREADS" not in os.environ:
        torch.set_num_threads(1)
    # Timings on a shared machine say nothing: no test fails for being slow once.
    hypothesis.settings.register_profile("shared-machine", deadline=None)
    hypothesis.settings.load_profile("shared-machine")


def pytest_collection_modifyitems(config, items):
    """Long files come first. Without a GPU the tests that need one are skipped, each by its name."""
    import torch

    places = {Path(__file__).parent / name: place for place, name in enumerate(LONG, -len(LONG))}
    if (seed := config.getoption("shuffle")) is not None:
        draw = random.Random(seed)
        draw.shuffle(items)
        places = {item.path: draw.random() for item in items}
    items.sort(key=lambda item: places.get(item.path, 0))
    for item in items:
        if item.get_closest_marker("cuda") and not torch.cuda.is_available():
            item.add_marker(pytest.mark.skip(reason="needs a GPU"))


@pytest.fixture(autouse=True, scope="module")
def forks_copy_little():
    """Let the garbage collectors of forks leave alone what was there: to look at it copies it."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True, scope="session")
def quick_simulators():
    """The model of a robot alone, which robosuite compiles anew for every simulator, is compiled once.

    Nor is all memory searched when one is closed.
    """
    if "robosuite.models.base" not in sys.modules:
        yield
        return
    from robosuite.models.base import MujocoXML

    compiled, get_model = {}, MujocoXML.get_model

    def once(model):
        text = model.get_xml()
        return compiled.get(text) or compiled.setdefault(text, get_model(model))

    with patch.object(MujocoXML, "get_model", once), patch("robosuite.utils.binding_utils.gc"):
        yield


@pytest.fixture(autouse=True, scope="session")
def own_cache(tmp_path_factory):
    """No test finds what an earlier run left in the user's cache, or leaves something there."""
    with patch.dict(os.environ, WARMPRIOR_CACHE=str(tmp_path_factory.mktemp("cache"))):
        yield


@pytest.fixture(autouse=True)
def renders_apart():
    """No test leaves behind a process of which forked workers could not render."""
    from warmprior.io.workers import start_method

    before = start_method()
    yield
    assert start_method() == before, "let what renders run in tests.processes.apart"


@pytest.fixture
def forked_workers(monkeypatch):
    """Workers of this machine know what was imported and patched here; fresh ones import for seconds."""
    loky = pytest.importorskip("loky")
    fork = {"context": multiprocessing.get_context("fork")}
    monkeypatch.setattr("loky.ProcessPoolExecutor", functools.partial(loky.ProcessPoolExecutor, **fork))


@pytest.fixture(scope="module")
def short_episodes():
    """Policies of a few iterations solve nothing: their episodes need not go to the time limit."""
    from warmprior.envs.robosuite_tasks import TaskSpec

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TaskSpec, "horizon", lambda spec, style: 40)
        yield


@pytest.fixture(scope="session")
def lift_demonstrations(tmp_path_factory):
    """Three scripted demonstrations of lift, generated once for all processes of a run; not to be changed."""
    pytest.importorskip("robosuite")
    from filelock import FileLock

    from lab.demonstrations.scripted.generate import generate_demonstrations
    from tests.processes import here

    folder = tmp_path_factory.getbasetemp()
    folder = folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder
    generate = "lab.demonstrations.scripted.generate"
    cache = patch.dict(os.environ, WARMPRIOR_CACHE=str(folder / "demonstrations"))
    with FileLock(folder / "demonstrations.lock"), patch(f"{generate}.working", here), cache:
        return generate_demonstrations("lift", n=3, workers=1)


CLUSTER = """
import ray
options = dict(num_cpus=2, include_dashboard=False, logging_level="ERROR")
cluster = ray.init(address="local", _node_ip_address="127.0.0.1", **options)
print("address", cluster.address_info["gcs_address"], flush=True)
input()
"""


@pytest.fixture(scope="session")
def ray_address():
    """A Ray cluster of two cores. Whoever connects to it cannot fork afterwards, and has to do it apart."""
    pytest.importorskip("ray")
    root = str(Path(__file__).parents[1])
    env = {**os.environ, "PYTHONPATH": root, "RAY_AUTH_MODE": "disabled"}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", CLUSTER], cwd=root, env=env, **pipes) as process:
        said = (line.split() for line in process.stdout)
        yield next(words[1] for words in said if words[:1] == ["address"])
        process.stdin.write("\n")
