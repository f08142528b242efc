from __future__ import annotations

import importlib
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import warmprior

DOCS = Path(__file__).parents[1] / "docs"
PACKAGES = sorted(m.name for m in pkgutil.iter_modules(warmprior.__path__) if m.ispkg)


def _public(package: str) -> set[str]:
    return set(getattr(importlib.import_module(f"warmprior.{package}"), "__all__", ()))


@pytest.mark.parametrize("package", PACKAGES)
def test_every_package_has_a_reference_page(package):
    page = (DOCS / "reference" / f"{package}.rst").read_text()
    assert f".. automodule:: warmprior.{package}\n   :members:\n" in page
    assert f"\n{package}\n" in (DOCS / "reference" / "index.md").read_text()


def test_top_level_names_belong_to_a_package():
    known = set().union(*map(_public, PACKAGES))
    assert set(warmprior.__all__) - {"__version__"} <= known


@pytest.mark.slow
def test_docs_build_without_warnings_and_hold_every_public_name(tmp_path):
    pytest.importorskip("sphinx")
    from sphinx.util.inventory import InventoryFile

    subprocess.run(
        [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", str(DOCS), str(tmp_path)],
        check=True,
    )
    inventory = InventoryFile.loads((tmp_path / "objects.inv").read_bytes(), uri="")
    described = {
        name for kind, items in inventory.data.items() if kind.startswith("py:") for name in items
    }
    for package in PACKAGES:
        missing = {n for n in _public(package) if f"warmprior.{package}.{n}" not in described}
        assert not missing, f"warmprior.{package}"
