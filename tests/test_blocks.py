"""The programs of the pages run as they stand; test_given_blocks.py has those that need something."""

import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.data.synthetic import write_robomimic_file
from warmprior import Prior

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md")), *sorted((DOCS / "notes").iterdir())]
GIVEN = re.compile(r"# Given: ([\w, ]+) \(.*\)\.\n")
TRAINED = "iterations=1_000"
"""Only the long programs have this; tests/test_quickstart.py shortens them."""


def _blocks() -> list[tuple[str, str]]:
    found = []
    for page in PAGES:
        texts = re.findall(r"^```python\n(.*?)^```$", page.read_text(), re.S | re.M)
        found += [(f"{page.name}-{number}", text) for number, text in enumerate(texts, 1)]
    return found


BLOCKS = _blocks()
PROGRAMS = [pytest.param(text, id=name) for name, text in BLOCKS if not GIVEN.match(text)]


@pytest.fixture
def files(tmp_path, monkeypatch):
    """A folder with the files that the pages name."""
    write_robomimic_file(tmp_path / "square.hdf5", masks={"train": [0, 1]})
    monkeypatch.chdir(tmp_path)
    # What other tests have defined would not be there in a fresh process.
    own = {n: kind for n, kind in Prior.classes.items() if kind.__module__.startswith(("warmprior.", "lab."))}
    monkeypatch.setattr(Prior, "classes", own)


@pytest.mark.filterwarnings("error:The env passed to Collector")
@pytest.mark.parametrize("text", [each for each in PROGRAMS if TRAINED not in each.values[0]])
def test_a_program_runs(files, text):
    exec(compile(text, "block", "exec"), {"__name__": "__main__"})


@pytest.mark.slow
@pytest.mark.parametrize("text", PROGRAMS)
def test_a_program_runs_in_a_fresh_process(files, text):
    subprocess.run([sys.executable, "-c", text], check=True)


COMMAND = re.compile(r"^(?:torchrun [^\n]*? )?(?:python )?(-m warmprior|benchmarks/\w+\.py)(.*)$", re.M)
WITH_SUBCOMMANDS = ("-m warmprior", "benchmarks/demonstrations.py")


def _options(command: str, capsys) -> set[str]:
    """The options that the help of a command lists."""
    path, *subcommand = command.removeprefix("-m ").split()
    module = "warmprior.__main__" if path == "warmprior" else Path(path).stem
    with pytest.raises(SystemExit):
        importlib.import_module(module).main([*subcommand, "--help"])
    return set(re.findall(r"(?<![\w-])--[\w.-]*\w", capsys.readouterr().out))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_have_the_options_that_pages_show(page, capsys):
    known: dict[str, set[str]] = {}
    for block in re.findall(r"^```console\n(.*?)^```$", page.read_text(), re.S | re.M):
        for command, rest in COMMAND.findall(block.replace("\\\n", " ")):
            words = rest.split("#")[0].split()
            if command in WITH_SUBCOMMANDS:
                command = f"{command} {words[0]}"
            if command not in known:
                known[command] = _options(command, capsys)
            options = {word.split("=")[0] for word in words if word.startswith("--")}
            assert options <= known[command], f"{page.name}: {command}{rest}"


def prose(text: str) -> str:
    """Return a page without blocks, tables, code, pictures, and the addresses of links."""
    text = re.sub(r"```.*?```|<!--.*?-->", "", text, flags=re.S)
    text = "\n".join(line for line in text.splitlines() if not line.lstrip().startswith("|"))
    return re.sub(r"`[^`]*`|!\[.*?\]\(.*?\)|\]\([^)]*\)", " ", text, flags=re.S)


@pytest.mark.parametrize("page", [ROOT / "README.md", *sorted(DOCS.glob("*.md"))], ids=lambda page: page.name)
def test_numbers_stand_in_tables(page):
    """Conclusions are sentences: of a hundred words outside of tables at most ten are numbers."""
    text = prose(page.read_text())
    words, numbers = re.findall(r"[A-Za-z][\w'-]*", text), re.findall(r"(?<![\w.])\d[\d,.]*%?(?!\w)", text)
    assert len(numbers) <= 0.1 * len(words)
