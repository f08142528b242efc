"""The tutorials, without running them: the build of the documentation does that."""

from __future__ import annotations

import ast
import importlib
import re
from pathlib import Path

import pytest

import warmprior

DOCS = Path(__file__).parents[1] / "docs"
SCRIPTS = sorted((DOCS / "tutorials").glob("*.py"))

pytestmark = pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)


def _imported(tree: ast.Module) -> list[tuple[str, str]]:
    """What a script takes from the library, as module and name."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            assert not any(alias.name.startswith("warmprior") for alias in node.names)
    nodes = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    return [
        (node.module, alias.name)
        for node in nodes
        if node.module and node.module.split(".")[0] == "warmprior"
        for alias in node.names
    ]


def _resolve(name: str) -> object:
    """What a full name such as ``warmprior.training.evaluate`` or ``warmprior.Prior.mean`` stands for."""
    first, *parts = name.split(".")
    found: object = importlib.import_module(first)
    place = first
    for part in parts:
        place += f".{part}"
        if not hasattr(found, part):
            importlib.import_module(place)
        found = getattr(found, part)
    return found


def test_script_is_found_by_the_gallery_and_has_a_numbered_title(script):
    number = re.fullmatch(r"plot_(\d+)_[a-z_]+", script.stem)
    assert number, "sphinx-gallery runs what is called plot_..., in the order of the numbers"
    title, rule, *told = (ast.get_docstring(ast.parse(script.read_text())) or "").splitlines()
    assert title.startswith(f"{number[1]}. ")
    assert rule == "=" * len(title)
    assert any(told), "the first lines become the text of the thumbnail"


def test_numbers_are_those_of_one_script_each(script):
    number = script.stem.split("_")[1]
    assert [other for other in SCRIPTS if other.stem.split("_")[1] == number] == [script]


def test_imports_are_public_names_that_exist(script):
    imported = _imported(ast.parse(script.read_text()))
    assert imported, "a tutorial shows the library"
    for module, name in imported:
        assert name in importlib.import_module(module).__all__, f"{module}.{name}"
        assert module == "warmprior" or name not in warmprior.__all__, f"{name}: from warmprior"


def test_names_in_the_text_exist(script):
    roles = re.findall(r":(?:class|func|meth|attr):`(?:[^`<]*<)?~?([\w.]+)>?`", script.read_text())
    assert roles
    for name in roles:
        _resolve(name)


def test_script_starts_from_a_seed_and_shows_a_figure(script):
    calls = [
        ast.unparse(node) for node in ast.walk(ast.parse(script.read_text())) if isinstance(node, ast.Call)
    ]
    assert "torch.manual_seed(0)" in calls
    assert "plt.show()" in calls
