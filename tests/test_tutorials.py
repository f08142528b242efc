"""The tutorials, without running them: the build of the documentation does that."""

import ast
import importlib
from pathlib import Path

import pytest

import warmprior

DOCS = Path(__file__).parents[1] / "docs"
SCRIPTS = sorted((DOCS / "tutorials").glob("*.py"))

pytestmark = pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)


def _imported(tree: ast.Module) -> list[tuple[str, str]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            assert not any(alias.name.startswith("warmprior") for alias in node.names)
    nodes = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    ours = [node for node in nodes if node.module and node.module.split(".")[0] == "warmprior"]
    return [(node.module, alias.name) for node in ours for alias in node.names]


def test_imports_are_public_names_that_exist(script):
    imported = _imported(ast.parse(script.read_text()))
    assert imported, "a tutorial shows the library"
    for module, name in imported:
        assert name in importlib.import_module(module).__all__, f"{module}.{name}"
        assert module == "warmprior" or name not in warmprior.__all__, f"{name}: from warmprior"
