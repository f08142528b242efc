"""Tables in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

__all__ = ["markdown_table"]


def markdown_table(
    head: Sequence[str], rows: Iterable[Sequence[str]], notes: Iterable[str] = ()
) -> str:
    r"""A table, and what there is to say about it.

    Args:
        head: of the columns.
        rows: of cells, one per column.
        notes: lines below the table.

    Raises:
        ValueError: if a row has another number of cells than the head.

    Examples:
        >>> print(markdown_table(["H", "success"], [["8", "97.0"]], ["In percent."]))
        | H | success |
        |---|---|
        | 8 | 97.0 |
        <BLANKLINE>
        In percent.
        <BLANKLINE>
    """
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for row in rows:
        if len(row) != len(head):
            raise ValueError(f"a row of {len(row)} cells in a table of {len(head)}: {row}")
        lines.append(f"| {' | '.join(row)} |")
    notes = list(notes)
    return "\n".join([*lines, "", *notes] if notes else lines) + "\n"
