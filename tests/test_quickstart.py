"""The programs of README and quickstart run as they stand, and print what the pages say."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / page).read_text(), flags=re.DOTALL)


def test_the_programs_print_what_the_pages_say(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    first, parts = blocks("docs/quickstart.md", "python")
    scope: dict = {}
    exec(compile(first, "quickstart", "exec"), scope)
    found, (shown,) = capsys.readouterr().out.splitlines(), blocks("docs/quickstart.md", "text")
    # Sums differ between processors, and with them a run or two.
    said = [int(line.split()[1].rstrip("%")) for line in shown.splitlines()[:2]]
    rates = [int(line.split()[1].rstrip("%")) for line in found[:2]]
    assert abs(rates[0] - said[0]) <= 10
    assert abs(rates[1] - said[1]) <= 10
    assert found[2:] == shown.splitlines()[2:]
    assert (tmp_path / "policy" / "model.safetensors").exists()
    exec(compile(parts, "quickstart", "exec"), scope)
    assert scope["actor"].ode.nfe == 1


def test_the_readme_shows_the_beginning_of_the_quickstart():
    (mine,), theirs = blocks("README.md", "python"), blocks("docs/quickstart.md", "python")[0]
    assert theirs.startswith(mine)
    lines = blocks("docs/quickstart.md", "text")[0].splitlines()
    assert blocks("README.md", "text")[0].splitlines() == lines[:2]
