"""The programs of README and quickstart run as they stand, and print what the pages say."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / page).read_text(), flags=re.DOTALL)


@pytest.mark.filterwarnings("error:The env passed to Collector")
@pytest.mark.parametrize("iterations", [20, pytest.param(1_000, marks=pytest.mark.slow)])
def test_the_programs_print_what_the_pages_say(tmp_path, monkeypatch, capsys, iterations):
    monkeypatch.chdir(tmp_path)
    first, parts = blocks("docs/quickstart.md", "python")
    assert all(first.count(part) == 1 for part in ("iterations=1_000", "batch_size=[256]", "rollout(100,"))
    if iterations < 1_000:
        first = first.replace("1_000", str(iterations)).replace("[256]", "[8]").replace("(100,", "(20,")
    scope: dict = {}
    exec(compile(first, "quickstart", "exec"), scope)
    assert not scope["runs"]["vla_action", "chunk"].requires_grad
    found, (shown,) = capsys.readouterr().out.splitlines(), blocks("docs/quickstart.md", "text")
    lines = shown.splitlines()
    assert [re.split(r" \d+% ", line) for line in found] == [re.split(r" \d+% ", line) for line in lines]
    if iterations == 1_000:
        # Sums differ between processors, and with them a run or two.
        said, rates = ([int(n) for n in re.findall(r"(\d+)% ", "\n".join(part))] for part in (lines, found))
        assert len(said) == 2 and max(abs(one - other) for one, other in zip(said, rates, strict=True)) <= 10
    assert (tmp_path / "policy" / "model.safetensors").exists()
    exec(compile(parts, "quickstart", "exec"), scope)
    assert scope["actor"].sampling.nfe == 1


def test_the_readme_shows_the_beginning_of_the_quickstart():
    (mine,), theirs = blocks("README.md", "python"), blocks("docs/quickstart.md", "python")[0]
    assert theirs.startswith(mine)
    (said,) = re.findall(r"# gaussian: (\d+)%, past: (\d+)%", mine)
    assert list(said) == re.findall(r": (\d+)% ", blocks("docs/quickstart.md", "text")[0])
