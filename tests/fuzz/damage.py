"""Ways to damage files."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.fuzz.sandbox import Outcome

Case = tuple[str, Callable[[], Outcome], str]
"""This holds how a file was damaged, the load to attempt, and what its error has to name."""

ODD_VALUES: tuple[Any, ...] = (
    *(None, True, 0, -1, 3, 10**5, 10**9, 10**30, 0.5, -0.5, 1e308, float("nan"), float("inf")),
    *("", "x", "9", [], [1, 2], {}, {"name": "past"}, [[[[]]]]),
)


def damage(path: Path, rng: np.random.Generator) -> str:
    """Change the bytes of a file; returns how."""
    content = bytearray(path.read_bytes())
    size = len(content)
    how = str(rng.choice(["flip", "flip", "flip", "head", "cut", "append", "zero", "shuffle"]))
    # Half of the flips hit the beginning, where headers and metadata are.
    end = size if rng.random() < 0.5 else max(1, min(size, 4096))
    if how == "flip":
        for place in rng.integers(end, size=int(rng.integers(1, 9))):
            content[place] ^= 1 << int(rng.integers(8))
    elif how == "head":
        place = int(rng.integers(min(16, size)))
        content[place] = int(rng.integers(256))
    elif how == "cut":
        del content[int(rng.integers(size)) :]
    elif how == "append":
        content += rng.bytes(int(rng.integers(1, 5000)))
    else:
        start = int(rng.integers(end))
        length = int(rng.integers(1, 2000))
        block = content[start : start + length]
        new = bytes(len(block)) if how == "zero" else rng.bytes(len(block))
        content[start : start + length] = new
    path.write_bytes(content)
    return how


def odd_json(value: Any, rng: np.random.Generator) -> str:
    """Replace, remove or add one entry somewhere in parsed JSON, in place; returns where."""
    places: list[tuple[Any, Any]] = []

    def walk(node: Any) -> None:
        items = node.items() if isinstance(node, dict) else enumerate(node)
        for key, child in items:
            places.append((node, key))
            if isinstance(child, dict | list):
                walk(child)

    walk(value)
    node, key = places[int(rng.integers(len(places)))]
    if rng.random() < 0.2:
        del node[key]
        return f"no {key}"
    new = ODD_VALUES[int(rng.integers(len(ODD_VALUES)))]
    node[key] = new
    return f"{key} = {new!r}"


def damage_content(path: Path, rng: np.random.Generator) -> str:
    """Damage a file, or, where it is JSON, mostly one of its entries; returns how."""
    if path.suffix != ".json" or rng.random() >= 0.7:
        return damage(path, rng)
    content = json.loads(path.read_text())
    how = odd_json(content, rng)
    path.write_text(json.dumps(content))
    return how


def damaged_copy(whole: Path, case: Path, rng: np.random.Generator) -> str:
    """Copy a file into another folder, and damage it there; returns how."""
    case.mkdir(exist_ok=True)
    (case / whole.name).write_bytes(whole.read_bytes())
    return damage(case / whole.name, rng)
