"""The directive ``error-messages``: everything that the library says when it refuses or warns, by room."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from docutils import nodes
from docutils.parsers.rst import Directive

PACKAGE = Path(__file__).parents[1] / "warmprior"

VALUE = "…"
"""Stands for what a message fills in."""

KINDS = re.compile(r"^(\w+Error|\w*Failure|SystemExit|warn)$")
"""Calls that make an error or give a warning."""


class Message(NamedTuple):
    """What is raised or warned of, where, and in which words."""

    module: str
    kind: str
    text: str


def _name(function: ast.expr) -> str:
    return function.attr if isinstance(function, ast.Attribute) else ast.unparse(function)


def _pairs(target: ast.expr, value: ast.expr) -> Iterator[tuple[str, ast.expr]]:
    """Names and what an assignment gives them."""
    match target, value:
        case ast.Name(id=name), _:
            yield name, value
        case ast.Tuple(elts=targets), ast.Tuple(elts=values) if len(targets) == len(values):
            for one, its in zip(targets, values, strict=True):
                yield from _pairs(one, its)


def _assigned(scope: ast.AST) -> Iterator[tuple[str, ast.expr]]:
    """Names and what they are given in a scope, by ``=`` or one after another by loops over literals."""
    for node in ast.walk(scope):
        match node:
            case ast.Assign(targets=[target], value=value):
                yield from _pairs(target, value)
            case ast.For(target=target, iter=ast.Tuple(elts=values) | ast.List(elts=values)):
                for value in values:
                    yield from _pairs(target, value)
            case ast.For(
                target=ast.Tuple(elts=[target, _]),
                iter=ast.Call(func=ast.Attribute(value=ast.Dict(keys=values), attr="items")),
            ):
                for value in filter(None, values):
                    yield from _pairs(target, value)


def _text(expression: ast.expr, known: Mapping[str, list[ast.expr]]) -> str:
    match expression:
        case ast.Constant(value=str(text)):
            return text
        case ast.JoinedStr(values=parts):
            return "".join(_text(part, known) for part in parts)
        case ast.FormattedValue(value=value, conversion=-1, format_spec=None):
            return _text(value, known)
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            return _text(left, known) + _text(right, known)
        case ast.IfExp(body=body, orelse=orelse):
            return _choice(body, orelse, known=known)
        case ast.Name(id=name) if name in known:
            rest = {other: values for other, values in known.items() if other != name}
            return _choice(*known[name], known=rest)
    return VALUE


def _choice(*expressions: ast.expr, known: Mapping[str, list[ast.expr]]) -> str:
    """What may stand there, or that it is a value."""
    texts = list(dict.fromkeys(_text(expression, known) for expression in expressions))
    return " / ".join(filter(None, texts)) if all(t != VALUE for t in texts) else VALUE


def messages() -> Iterator[Message]:
    """All that are written where an error is made or a warning given, in the order of the code."""
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        module = ".".join(part for part in parts if part != "__init__")
        body = ast.parse(path.read_text()).body
        constants = dict(
            pair for node in body if isinstance(node, ast.Assign) for pair in _assigned(node)
        )
        for statement in body:
            for scope in statement.body if isinstance(statement, ast.ClassDef) else [statement]:
                own: dict[str, list[ast.expr]] = {}
                for name, value in _assigned(scope):
                    own.setdefault(name, []).append(value)
                known = {name: [value] for name, value in constants.items()} | own
                for node in ast.walk(scope):
                    if not (isinstance(node, ast.Call) and node.args):
                        continue
                    kind = KINDS.search(_name(node.func))
                    text = " ".join(_text(node.args[0], known).split()).replace(2 * VALUE, VALUE)
                    if kind and any(letter.isalpha() for letter in text):
                        yield Message(module, "warning" if kind[0] == "warn" else kind[0], text)


class ErrorMessages(Directive):
    """A section for each room, with a line for each message."""

    def run(self) -> list[nodes.Node]:
        """Write them."""
        for path in (__file__, *PACKAGE.rglob("*.py")):
            self.state.document.settings.env.note_dependency(str(path))
        rooms: dict[str, list[Message]] = {}
        for message in messages():
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
