"""The directive ``error-messages``: everything that the library says when it refuses or warns, by room."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from docutils import nodes
from docutils.parsers.rst import Directive

PACKAGE = Path(__file__).parents[1] / "warmprior"

VALUE = "…"
"""Stands for what a message fills in."""


class Message(NamedTuple):
    """What is raised or warned of, where, and in which words."""

    module: str
    kind: str
    text: str


def _text(expression: ast.expr) -> str:
    match expression:
        case ast.Constant(value=str(text)):
            return text
        case ast.JoinedStr(values=parts):
            return "".join(map(_text, parts))
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            return _text(left) + _text(right)
        case ast.IfExp(body=body, orelse=orelse):
            return f"{_text(body)} / {_text(orelse)}"
    return VALUE


def _name(function: ast.expr) -> str:
    return function.attr if isinstance(function, ast.Attribute) else ast.unparse(function)


def messages() -> Iterator[Message]:
    """All that are written where they are raised, in the order of the code."""
    for path in sorted(PACKAGE.rglob("*.py")):
        module = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
        for node in ast.walk(ast.parse(path.read_text())):
            call = node.exc if isinstance(node, ast.Raise) else node
            if not isinstance(call, ast.Call) or not call.args:
                continue
            kind = _name(call.func)
            if isinstance(node, ast.Raise) or kind == "warn":
                text = " ".join(_text(call.args[0]).split())
                if any(letter.isalpha() for letter in text):
                    yield Message(module, "warning" if kind == "warn" else kind, text)


class ErrorMessages(Directive):
    """A section for each room, with a line for each message."""

    def run(self) -> list[nodes.Node]:
        """Write them."""
        self.state.document.settings.env.note_dependency(__file__)
        rooms: dict[str, list[Message]] = {}
        for message in messages():
            self.state.document.settings.env.note_dependency(
                str(PACKAGE.parent.joinpath(*message.module.split(".")).with_suffix(".py"))
            )
            rooms.setdefault(".".join(message.module.split(".")[:2]), []).append(message)
        return [self._section(room, said) for room, said in rooms.items()]

    def _section(self, room: str, said: list[Message]) -> nodes.section:
        section = nodes.section("", nodes.title("", room), ids=[nodes.make_id(f"errors-{room}")])
        items = nodes.bullet_list()
        for message in said:
            line = nodes.paragraph()
            line += nodes.Text(message.text)
            line += nodes.Text(" (")
            line += nodes.literal("", message.kind)
            if message.module != room:
                line += nodes.Text(", ")
                line += nodes.literal("", message.module)
            line += nodes.Text(")")
            items += nodes.list_item("", line)
        section += items
        return section


def setup(app: Any) -> None:
    """Add the directive."""
    app.add_directive("error-messages", ErrorMessages)
