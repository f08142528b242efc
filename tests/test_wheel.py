"""What is released installs into an empty environment, and runs there."""

from __future__ import annotations

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

from warmprior.training.saved import FORMAT

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
NAME = f"warmprior-{PROJECT['version']}"

pytestmark = pytest.mark.slow


def run(*command, cwd):
    """Run a command as if this process had not prepared anything for it."""
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    return subprocess.run(
        list(map(str, command)), cwd=cwd, env=clean, check=True, capture_output=True, text=True
    ).stdout


def build(source, out, *targets):
    chosen = [word for target in targets for word in ("-t", target)]
    run(sys.executable, "-m", "hatchling", "build", *chosen, "-d", out, cwd=source)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A wheel, and an sdist, of this checkout."""
    pytest.importorskip("hatchling")
    out = tmp_path_factory.mktemp("dist")
    build(ROOT, out, "sdist", "wheel")
    return out / f"{NAME}-py3-none-any.whl", out / f"{NAME}.tar.gz"


@pytest.fixture(scope="module")
def python(built, tmp_path_factory):
    """The interpreter of an environment that has the wheel; what it depends on is lent to it."""
    place = tmp_path_factory.mktemp("empty")
    venv.create(place, with_pip=False)
    python = place / "bin" / "python"
    options = ("--quiet", "--no-deps", "--no-index", "--disable-pip-version-check")
    run(sys.executable, "-m", "pip", "--python", python, "install", *options, built[0], cwd=place)
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
    assert set(needed) == {"torch", "tensordict", "torchrl", "safetensors", "psutil", "tqdm"}


def test_the_sdist_builds_the_same_wheel(built, tmp_path):
    with tarfile.open(built[1]) as archive:
        names = {name.removeprefix(f"{NAME}/") for name in archive.getnames()}
        archive.extractall(tmp_path, filter="data")
    wanted = "pyproject.toml README.md CHANGELOG.md LICENSE CITATION.cff CONTRIBUTING.md Makefile"
    assert set(wanted.split()) <= names
    assert {"constraints.txt", "docs/conf.py", "tests/conftest.py"} <= names
    assert {f"benchmarks/{path.name}" for path in ROOT.glob("benchmarks/*.py")} <= names
    built_here = re.compile(r"__pycache__|^docs/_build/|^docs/reference/api/|^runs/|\.venv")
    assert not [name for name in names if built_here.search(name)]
    build(tmp_path / NAME, tmp_path, "wheel")
    with zipfile.ZipFile(built[0]) as mine, zipfile.ZipFile(tmp_path / built[0].name) as again:
        assert {i.filename: i.CRC for i in mine.infolist()} == {i.filename: i.CRC for i in again.infolist()}


def test_the_wheel_runs_in_an_empty_environment_and_the_quickstart_with_it(python, tmp_path):
    printed = run(python, "-m", "warmprior", "--version", cwd=tmp_path)
    assert printed == f"warmprior {PROJECT['version']}\n"
    where = run(python, "-c", "import warmprior; print(warmprior.__file__)", cwd=tmp_path)
    assert Path(where.strip()).is_relative_to(python.parents[1])
    text = (ROOT / "docs" / "quickstart.md").read_text()
    code, *_ = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    (tmp_path / "quickstart.py").write_text(code)
    printed = run(python, "quickstart.py", cwd=tmp_path)
    assert [line.split(":")[0] for line in printed.splitlines()[:2]] == ["gaussian", "past"]
    printed = run(python, "-m", "warmprior", "info", "policy", cwd=tmp_path)
    assert "PastPrior(chunk_length=4" in printed
    assert f"warmprior {PROJECT['version']}, format {FORMAT}" in printed


def test_the_plugin_and_the_citation_have_the_same_version():
    plugin = ROOT / "plugins" / "lerobot_policy_warmprior" / "pyproject.toml"
    assert tomllib.loads(plugin.read_text())["project"]["version"] == PROJECT["version"]
    assert f"\nversion: {PROJECT['version']}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"## {PROJECT['version']}\n" in (ROOT / "CHANGELOG.md").read_text()
