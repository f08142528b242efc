"""Tables in pages: the marked one of a page, and one per run whose rows it names."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from shared import GAUSSIAN, SOURCES, read_played, shown_sources

from lab.statistics import chosen_elsewhere

TABLE = re.compile(r"(?<=<!-- table -->\n).*?(?=<!-- end -->)", re.S)
"""This matches the marked table of a page."""

PLAYED = re.compile(r"(?<=<!-- rows )(\w+)( -->\n).*?(?=<!-- end -->)", re.S)
"""This matches the table of a run's rows in a page."""


def played_table(name: str) -> str:
    """Return success of a run in Markdown: percent, and episodes won and lost against the Gaussian source.

    There is a line per NFE and factor of the source's noise, and per NFE a line in which every source has its
    own best factor, chosen on other episodes, if the same episodes were played with every factor. Seeds are
    pooled.
    """
    rows = read_played(name)
    names = shown_sources(rows)
    text = ["| NFE | noise | " + " | ".join(SOURCES[source][0] for source in names) + " |"]
    text.append("|---" * (2 + len(names)) + "|")
    for nfe, part in rows.sort_values(["nfe", "noise"], ascending=False).groupby("nfe", sort=False):
        solved = {
            (noise, source): np.concatenate(list(group.sort_values("seed")["solved"]))
            for (noise, source), group in part.groupby(["noise", "source"], sort=False)
        }
        noises = list(dict.fromkeys(noise for noise, _ in solved))
        text += [
            _played_line(nfe, f"{n:g}", {s: solved[n, s] for s in names if (n, s) in solved}, names)
            for n in noises
        ]
        if len(noises) > 1:
            every = {s: [solved[n, s] for n in noises if (n, s) in solved] for s in names}
            full = {s: e for s, e in every.items() if len(e) == len(noises) and len({*map(len, e)}) == 1}
            if full:
                best = {s: chosen_elsewhere(np.stack(outcomes)) for s, outcomes in full.items()}
                text.append(_played_line(nfe, "own best", best, names))
    return "\n".join(text) + "\n"


def _played_line(nfe: int, noise: str, solved: Mapping[str, np.ndarray], names: list[str]) -> str:
    most, gaussian = max(outcomes.mean() for outcomes in solved.values()), solved.get(GAUSSIAN)
    entries = []
    for source in names:
        outcomes = solved.get(source)
        if outcomes is None:
            entries.append("")
            continue
        rate = f"{100 * outcomes.mean() + 1e-6:.0f}"
        rate = f"**{rate}**" if outcomes.mean() == most and len(solved) > 1 else rate
        if source != GAUSSIAN and gaussian is not None and len(outcomes) == len(gaussian):
            rate += f" ({(outcomes > gaussian).sum()} : {(outcomes < gaussian).sum()})"
        entries.append(rate)
    return f"| {nfe} | {noise} | " + " | ".join(entries) + " |"


def with_tables(page: str, text: str) -> str:
    """Return a page with its table, and the tables of the runs whose rows it names."""
    page = TABLE.sub(lambda _: text, page)
    return PLAYED.sub(lambda match: f"{match[1]}{match[2]}{played_table(match[1])}", page)


def write(pages: Mapping[Path, str]) -> None:
    """Write the tables into their pages."""
    for page, text in pages.items():
        page.write_text(with_tables(page.read_text(), text))
