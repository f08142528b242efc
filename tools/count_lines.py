"""Count code lines: without blanks, comments and docstrings, and how many of them check.

python tools/count_lines.py            # warmprior and tests
python tools/count_lines.py warmprior/data benchmarks

Checks are raise statements with the conditions that lead to them, and functions named check_* and their
calls.
"""

from __future__ import annotations

import ast
import io
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

LAYOUT = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def lines_of(node: ast.AST) -> set[int]:
    """Return the line numbers of a node."""
    return set(range(node.lineno, node.end_lineno + 1))  # type: ignore[attr-defined]


def docstrings(tree: ast.Module) -> set[int]:
    """Return the lines of docstrings, and of strings that stand alone below a constant."""
    found: set[int] = set()
    for node in ast.walk(tree):
        for statement in getattr(node, "body", None) or [] if isinstance(node, DOCUMENTED) else []:
            value = getattr(statement, "value", None)
            if isinstance(statement, ast.Expr) and isinstance(getattr(value, "value", None), str):
                found |= lines_of(statement)
    return found


def checks(tree: ast.Module) -> set[int]:
    """Return the lines of checks."""
    found: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            name = node.name
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
            name = getattr(node.value.func, "id", getattr(node.value.func, "attr", ""))
        else:
            name = ""
        if isinstance(node, ast.Raise) or name.lstrip("_").startswith("check_"):
            found |= lines_of(node)
        # The condition of an `if` that only raises.
        if isinstance(node, ast.If) and any(isinstance(part, ast.Raise) for part in node.body):
            found |= set(range(node.lineno, node.body[0].lineno))
    return found


def count(path: Path) -> tuple[int, int]:
    """Return the code lines of a file, and how many of them check."""
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    code: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in LAYOUT:
            code |= set(range(token.start[0], token.end[0] + 1))
    code -= docstrings(tree)
    return len(code), len(code & checks(tree))


def files(place: Path) -> Iterator[Path]:
    """Yield the Python files at a place."""
    yield from sorted(place.rglob("*.py")) if place.is_dir() else [place]


def main(places: list[str]) -> None:
    """Print the counts of each place."""
    for place in places or ["warmprior", "benchmarks", "plugins", "tests"]:
        code, check = map(sum, zip(*map(count, files(Path(place))), strict=True))
        print(f"{place:24} {code:6,} code lines, {check:5,} of them checks ({check / code:.1%})")


if __name__ == "__main__":
    main(sys.argv[1:])
