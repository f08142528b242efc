"""What is released installs into an empty environment, and runs there."""

import json
import os
import re
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

from tests.data.synthetic import write_robomimic_file
from warmprior.saving.policies import FORMAT

ROOT = Path(__file__).parents[1]
PLUGIN = ROOT / "plugins" / "lerobot_policy_warmprior"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
NAME = f"warmprior-{PROJECT['version']}"


def run(*command, cwd):
    """Run a command as if this process had not prepared anything for it."""
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    clean["HF_HUB_OFFLINE"] = "1"
    pipes = {"capture_output": True, "text": True}
    done = subprocess.run(list(map(str, command)), cwd=cwd, env=clean, check=False, **pipes)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def build(source, out, *targets):
    chosen = [word for target in targets for word in ("-t", target)]
    run(sys.executable, "-m", "hatchling", "build", *chosen, "-d", out, cwd=source)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    pytest.importorskip("hatchling")
    out = tmp_path_factory.mktemp("dist")
    build(ROOT, out, "sdist", "wheel")
    return out / f"{NAME}-py3-none-any.whl", out / f"{NAME}.tar.gz"


def install(python, wheel):
    options = ("--quiet", "--no-deps", "--no-index", "--disable-pip-version-check")
    run(sys.executable, "-m", "pip", "--python", python, "install", *options, wheel, cwd=wheel.parent)


@pytest.fixture(scope="module")
def python(built, tmp_path_factory):
    """The interpreter of an environment that has the wheel; what it depends on is lent to it."""
    place = tmp_path_factory.mktemp("empty")
    venv.create(place, with_pip=False)
    python = place / "bin" / "python"
    install(python, built[0])
    (own,) = place.glob("lib/python*/site-packages")
    # Plain paths: the .pth files in these folders, such as this checkout's, are not read.
    lent = [path for path in sys.path if path.endswith("site-packages")]
    (own / "lent.pth").write_text("\n".join(lent) + "\n")
    return python


def test_the_wheel_holds_the_package_and_nothing_else(built):
    with zipfile.ZipFile(built[0]) as wheel:
        names = set(wheel.namelist())
        metadata = wheel.read(f"{NAME}.dist-info/METADATA").decode()
    modules = {str(path.relative_to(ROOT)) for path in (ROOT / "warmprior").rglob("*.py")}
    info = {name for name in names if name.startswith(f"{NAME}.dist-info/")}
    assert names - info == modules | {"warmprior/py.typed"}
    assert f"{NAME}.dist-info/licenses/LICENSE" in info
    assert f"\nVersion: {PROJECT['version']}\n" in metadata
    needed = re.findall(r"^Requires-Dist: ([\w-]+)[^;\n]*$", metadata, re.M)
    others = {"cloudpickle", "safetensors", "filelock", "psutil", "tqdm", "tyro"}
    assert set(needed) == {"torch", "tensordict", "torchrl"} | others


def test_the_sdist_builds_the_same_wheel(built, tmp_path):
    with tarfile.open(built[1]) as archive:
        names = {name.removeprefix(f"{NAME}/") for name in archive.getnames()}
        archive.extractall(tmp_path, filter="data")
    built_here = re.compile(r"__pycache__|^docs/(_build|auto_tutorials|reference/api)/|^runs/|\.venv")
    wanted = "pyproject.toml README.md CHANGELOG.md LICENSE CITATION.cff CONTRIBUTING.md Makefile"
    assert set(wanted.split()) <= names
    assert {"constraints.txt", "docs/conf.py", "tests/conftest.py"} <= names
    assert {
        "benchmarks/lab/options/options.py",
        "benchmarks/lab/demonstrations/scripted/experts.py",
        "tests/lab/__init__.py",
    } <= names
    for folder in ("benchmarks", "docs", "tests", "plugins"):
        files = {path.relative_to(ROOT).as_posix() for path in (ROOT / folder).rglob("*.py")}
        assert {name for name in files if not built_here.search(name)} <= names
    assert not [name for name in names if built_here.search(name)]
    build(tmp_path / NAME, tmp_path, "wheel")
    with zipfile.ZipFile(built[0]) as mine, zipfile.ZipFile(tmp_path / built[0].name) as again:
        assert {i.filename: i.CRC for i in mine.infolist()} == {i.filename: i.CRC for i in again.infolist()}


@pytest.mark.slow
def test_the_wheel_runs_in_an_empty_environment_and_the_quickstart_with_it(python, tmp_path):
    printed = run(python, "-m", "warmprior", "--version", cwd=tmp_path)
    assert printed == f"warmprior {PROJECT['version']}\n"
    where = run(python, "-c", "import warmprior; print(warmprior.__file__)", cwd=tmp_path)
    assert Path(where.strip()).is_relative_to(python.parents[1])
    text = (ROOT / "docs" / "quickstart.md").read_text()
    code, said, *_ = re.findall(r"```(?:python|text)\n(.*?)```", text, flags=re.DOTALL)
    (tmp_path / "quickstart.py").write_text(code)
    printed = run(python, "quickstart.py", cwd=tmp_path)
    assert re.sub(r"\d+%", "%", printed) == re.sub(r"\d+%", "%", said)
    printed = run(python, "-m", "warmprior", "info", "policy", cwd=tmp_path)
    assert "PastPrior(chunk_length=4" in printed
    assert f"warmprior {PROJECT['version']}, format {FORMAT}" in printed


@pytest.mark.slow
def test_a_simulated_policy_trains_and_plays_with_the_wheel_alone(python, tmp_path):
    pytest.importorskip("robosuite")
    write_robomimic_file(tmp_path / "lift.hdf5", lengths=(30, 40), task="lift")
    words = "train lift.hdf5 --iterations 3 --batch-size 8 --checkpoints 1 --network mlp,hidden_dim=16"
    trained = run(python, "-m", "warmprior", *words.split(), cwd=tmp_path).splitlines()[-1]
    one = ["--episodes", "1", "--nfe", "1"]
    printed = run(python, "-m", "warmprior", "evaluate", trained, *one, cwd=tmp_path)
    assert re.search(r"^NFE 1: [01] of 1 episodes solved", printed, re.M)


WHERE = """
import lerobot_policy_warmprior as plugin, warmprior
from importlib.util import find_spec
print(warmprior.__file__, plugin.__file__, find_spec("lab"))
"""
TRAIN = """--policy.type=warm_flow --policy.prior=past,sigma=0.3 --policy.hidden_dim=24
--policy.num_layers=1 --policy.device=cpu --policy.push_to_hub=false --steps=2 --batch_size=4
--num_workers=0 --save_freq=2 --dataset.root=data --dataset.repo_id=local/tiny --output_dir=run"""
EVALUATE = """--policy.path=run/checkpoints/last/pretrained_model --policy.device=cpu
--eval.n_episodes=1 --eval.batch_size=1 --env.type=warmprior_robosuite --env.task=lift
--env.episode_length=20 --output_dir=evaluation"""


@pytest.mark.slow
def test_the_plugin_trains_and_plays_with_the_wheels_alone(python, tmp_path):
    for package in ("lerobot", "accelerate", "robosuite"):
        pytest.importorskip(package)
    from tests.data.lerobot_parts import write_lerobot

    build(PLUGIN, tmp_path / "dist", "wheel")
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    install(python, wheel)
    *files, lab = run(python, "-c", WHERE, cwd=tmp_path).split()
    assert all(Path(file).is_relative_to(python.parents[1]) for file in files)
    assert lab == "None"
    write_lerobot(tmp_path / "data", (12, 12, 12), resting=["action"])
    run(python, "-m", "lerobot.scripts.lerobot_train", *TRAIN.split(), cwd=tmp_path)
    run(python, "-m", "lerobot.scripts.lerobot_eval", *EVALUATE.split(), cwd=tmp_path)
    results = json.loads((tmp_path / "evaluation" / "eval_info.json").read_text())
    assert results["overall"]["n_episodes"] == 1
