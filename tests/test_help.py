"""Help is printed without PyTorch, whose import takes seconds; it says what happens instead of a None."""

import importlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from lab.methods.methods import METHODS
from warmprior import modules
from warmprior.modules.prior import Prior

ROOT = Path(__file__).parents[1]
SCRIPTS = [path.stem for path in (ROOT / "benchmarks").glob("*.py")]
OF_DEMONSTRATIONS = ["generate", "download", "render"]
COMMANDS = ["info", "push", "evaluate", "train", "improve", "export", "convert", "observe"]
HELP = """
import contextlib, importlib, io, json, sys

class Without:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("torch", "tensordict", "torchrl"):
            raise ImportError(f"{name} is imported")

sys.meta_path.insert(0, Without())
texts = {}
for module, *argv in json.loads(sys.argv[1]):
    with contextlib.redirect_stdout(io.StringIO()) as said:
        try:
            importlib.import_module(module).main([*argv, "--help"])
        except SystemExit as stop:
            assert not stop.code, (module, stop.code)
    texts[" ".join([module, *argv])] = said.getvalue()
with contextlib.redirect_stderr(io.StringIO()) as said:
    try:
        importlib.import_module("card").main(["a run", "a folder"])
    except ImportError as error:
        said.write(str(error))
texts["start"] = said.getvalue()
json.dump(texts, sys.stdout)
"""


@pytest.fixture(scope="module")
def helps():
    """The help of every command, printed by one process that cannot import PyTorch."""
    commands = [["warmprior.__main__"], *(["warmprior.__main__", name] for name in COMMANDS)]
    commands += [*([name] for name in SCRIPTS), *(["demonstrations", name] for name in OF_DEMONSTRATIONS)]
    place = os.pathsep.join(map(str, (ROOT, ROOT / "benchmarks")))
    environment = {**os.environ, "PYTHONPATH": place, "COLUMNS": "80"}
    command = [sys.executable, "-c", HELP, json.dumps(commands)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_help_names_options_and_no_none(helps):
    assert [name for name, text in helps.items() if "usage: " not in text] == ["start"]
    found = {name: re.findall(r".*\bNone\b.*|.*\(default: \).*", text) for name, text in helps.items()}
    assert not {name: lines for name, lines in found.items() if lines}


def options_of(text):
    """The options in their order, with their help."""
    entries = [re.split(r"\boptions \W*\n", part)[0] for part in re.split(r"\n\W*(?=--[a-z])", text)[1:]]
    return {entry.split()[0].rstrip(","): entry for entry in entries}


def test_what_happens_without_an_option_is_said_once(helps):
    entries = {
        (name, option): each for name, text in helps.items() for option, each in options_of(text).items()
    }
    assert not [place for place, entry in entries.items() if len(re.findall(r"\bdefault\b", entry)) > 1]


def test_help_names_every_source_and_method(helps):
    """Help is written by hand, since the tables of both need PyTorch."""
    sources = {name for name, kind in Prior.classes.items() if getattr(modules, kind.__name__, None) is kind}
    for name, known in (("warmprior.__main__ train", sources), ("robomimic", set(METHODS))):
        said = re.findall(r"[\w-]+", options_of(helps[name])["--prior"])
        assert "past" in known and not known - set(said), name


@pytest.mark.parametrize("name", ["warmprior.__main__", "demonstrations"])
def test_without_a_command_the_help_is_shown(helps, name, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as stop:
        importlib.import_module(name).main([])
    assert not stop.value.code
    asked, shown = (text.partition("\n")[2] for text in (helps[name], capsys.readouterr().out))
    assert re.findall(r"\w+", asked) == re.findall(r"\w+", shown)  # the first line names the program


def test_what_takes_seconds_is_said_before_it_begins(helps):
    """All scripts read their options by the same function."""
    assert helps["start"].splitlines()[0] == "importing PyTorch"
    assert "torch is imported" in helps["start"]


def groups(text):
    """The titles of the boxes, whose frames depend on the terminal."""
    return re.findall(r"^\W*?(?:(\w+) )?options \W*$", text, re.M)


def test_what_everyone_sets_comes_first(helps):
    order = ["", "data", "source", "training", "evaluation", "run", "network"]
    data = list(options_of(helps["warmprior.__main__ train"]))
    assert data[0] == "--observations" and data.index("--images") < data.index("--image-size")
    assert groups(helps["warmprior.__main__ train"]) == order
    order[2] = "sources"
    for name in ("robomimic", "pusht", "joint_targets", "mimicgen_tasks", "chunking", "navigation1d"):
        assert groups(helps[name]) == order, name
        assert next(iter(options_of(helps[name]))) == "--preset", name


def test_a_reader_who_has_seen_enough_is_no_error():
    """The pipe is closed before anything is written to it."""
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "warmprior", "train", "--help"]
    done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True, cwd=ROOT, check=False)
    os.close(write)
    assert (done.returncode, done.stderr) == (141, "")
