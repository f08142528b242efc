import doctest
import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

import warmprior

DOCS = Path(__file__).parents[1] / "docs"
PACKAGES = sorted(m.name for m in pkgutil.iter_modules(warmprior.__path__) if m.ispkg)
SHOWN_ALONE = {
    "warmprior.saving.push_policy": "needs the hub",
    "warmprior.data.observe_recordings": "needs a recording",
    "warmprior.imagenet_weights": "downloads them",
    "warmprior.envs.rendering_backend": "differs between machines",
    "warmprior.envs.mimicgen.register_mimicgen": "needs a package that is not on the package index",
    "warmprior.lerobot.LeRobotActor": "needs a policy of LeRobot",
    "warmprior.lerobot.RelativeActions": "needs a policy of LeRobot",
    "warmprior.lerobot.WarmPriorAdapter": "needs a policy of LeRobot",
}
"""Whose examples do not run as tests, and why."""
ROLE = re.compile(r":(?:class|func|meth|attr|data):`~?([\w.]+)`")


def _public(package: str) -> set[str]:
    return set(getattr(importlib.import_module(f"warmprior.{package}"), "__all__", ()))


def _reference() -> list[str]:
    """What the reference lists, page by page."""
    entry = re.compile(r"^(?:   ~|\.\. py:data:: )(warmprior[\w.]+)$", re.M)
    return [n for page in (DOCS / "reference").glob("*.rst") for n in entry.findall(page.read_text())]


def test_reference_has_every_public_name_once_and_nothing_else():
    top = set(warmprior.__all__) - {"__version__"}
    public = {f"warmprior.{n}" if n in top else f"warmprior.{p}.{n}" for p in PACKAGES for n in _public(p)}
    listed = _reference()
    assert len(listed) == len(set(listed))
    assert public <= set(listed)
    # Beside them parts of the inside that the documentation speaks of, by where they are defined.
    for name in set(listed) - public:
        module, _, attribute = name.rpartition(".")
        assert not attribute.startswith("_")
        assert getattr(importlib.import_module(module), attribute).__module__ == module


def _object(name: str) -> object:
    module, _, attribute = name.rpartition(".")
    return getattr(importlib.import_module(module), attribute)


def _on_one_page() -> set[str]:
    """What the reference has as a whole module, without a page for each."""
    entry = re.compile(r"^\.\. automodule:: (warmprior[\w.]+)$", re.M)
    texts = (page.read_text() for page in (DOCS / "reference").glob("*.rst"))
    modules = [name for text in texts for name in entry.findall(text)]
    return {f"{m}.{n}" for m in modules for n in importlib.import_module(m).__all__}


def _has_docstring(described: object) -> bool:
    """Not a table or the name of a type, which are described on their page."""
    return inspect.isclass(described) or inspect.isroutine(described)


def _see_also(text: str) -> list[str]:
    """What the section of that name links to."""
    section = re.search(r"^See Also:\n((?:[ ]+.*\n?)+)", inspect.cleandoc(text), re.M)
    return ROLE.findall(section[1]) if section else []


def _runs(text: str) -> bool:
    """Whether an example is more than imports and what doctest skips."""
    found = doctest.DocTestParser().get_examples(text)
    kept = [part.source for part in found if not part.options.get(doctest.SKIP)]
    return any(not source.startswith(("import ", "from ")) for source in kept)


def test_every_class_and_function_has_an_example():
    described = {name: _object(name) for name in _reference()}
    texts = {n: found.__doc__ or "" for n, found in described.items() if _has_docstring(found)}
    assert [name for name, text in texts.items() if ">>> " not in text] == []
    assert {name for name, text in texts.items() if not _runs(text)} == set(SHOWN_ALONE)


MODULES = ["warmprior", *(module.name for module in pkgutil.walk_packages(warmprior.__path__, "warmprior."))]


@pytest.mark.parametrize("name", MODULES)
def test_examples_paste_into_a_fresh_interpreter(name, capsys):
    if name.startswith("warmprior.lerobot"):
        pytest.importorskip("lerobot")
    module, finder = importlib.import_module(name), doctest.DocTestFinder()
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS)
    for example in finder.find(module, globs={"__name__": name}):
        runner.run(example)
    assert runner.summarize().failed == 0, capsys.readouterr().out


def test_see_also_links_to_what_the_reference_has():
    listed = _reference()
    links = [(name, to) for name in listed for to in _see_also(_object(name).__doc__ or "")]
    assert links
    known = _on_one_page().union(listed)
    assert [link for link in links if link[1] not in known or link[0] == link[1]] == []


def test_errors_that_troubleshooting_quotes_exist():
    code = [*(DOCS.parent / "warmprior").rglob("*.py"), *(DOCS.parent / "benchmarks").rglob("*.py")]
    # Literals that stand side by side are one text, and "N" stands for a number that is filled in.
    source = re.sub(r'"\s+f?"', "", "".join(path.read_text() for path in code))
    bold = re.findall(r"\*\*(.*?)\*\*", (DOCS / "troubleshooting.md").read_text(), re.S)
    quoted = [part for text in bold for part in re.findall(r'"(.*?)"', text)]
    assert len(quoted) > 3
    for words in quoted:
        pattern = r" \{.*?\} ".join(re.escape(part) for part in words.split(" N "))
        assert re.search(pattern, source), words


def test_both_sides_of_the_diff_run(capsys):
    (diff,) = re.findall(r"```diff\n(.*?)```", (DOCS / "torchrl.md").read_text(), re.S)
    for side in "-+":
        kept = [line[1:] for line in diff.splitlines() if line[:1] in ("", " ", side)]
        exec(compile("\n".join(kept), "torchrl.md", "exec"), {})
    before, after = capsys.readouterr().out.splitlines()
    assert before == after == "torch.Size([10])"
    assert len(re.findall(r"^\+(?!from |import )", diff, re.M)) == 5


def test_tables_and_pictures_of_pages_are_those_of_the_stored_rows(monkeypatch):
    monkeypatch.syspath_prepend(DOCS / "figures")
    names = ("results", "leaderboard", "tables", "shared")
    results, leaderboard, tables, shared = map(importlib.import_module, names)
    marked = results.tables() | leaderboard.tables()
    texts = {page: page.read_text() for page in marked}
    for page, table in marked.items():
        assert tables.with_tables(texts[page], table) == texts[page]
    text = "".join(texts.values())
    played = {name for _, name, _ in tables.PLAYED.findall(text)}
    assert played == {path.stem for path in shared.DATA.iterdir()}
    shown = set(re.findall(r"_static/results/(\w+)\.svg\)", text))
    assert shown == {path.stem for path in shared.OUT.iterdir()}
    for page, sentences in importlib.import_module("sentences").sentences().items():
        words = " ".join(re.sub(r"\]\(.*?\)", "", (DOCS / page).read_text().replace("[", "")).split())
        assert [sentence for sentence in sentences if sentence not in words] == [], page


def _cells(table: str) -> list[list[str]]:
    """The cells of the lines of a Markdown table, without its head."""
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in table.splitlines()[2:]]


def test_every_case_of_the_readme_has_its_rows(monkeypatch):
    monkeypatch.syspath_prepend(DOCS / "figures")
    results, leaderboard, shared = map(importlib.import_module, ("results", "leaderboard", "shared"))
    cases, backed = (
        _cells(re.search(rf"^\| {head} \|.*?(?=^$|\Z)", page.read_text(), re.M | re.S)[0])
        for head, page in (("your case", DOCS.parent / "README.md"), ("the README's case", results.PAGE))
    )
    assert [case for case, *_ in cases] == [case for case, *_ in backed]
    names = {name for _, rows, _ in backed for name in re.findall(r"`([\w./]+)`", rows)}
    files = {name for name in names if "/" in name}
    assert [name for name in files if not (DOCS.parent / name).is_file()] == []
    assert names - files <= {path.stem for path in shared.DATA.iterdir()}
    by_length = {run for runs in results.LENGTHS.values() for run in runs}
    few = {*results.GROUPS[results.TEN], *results.GROUPS[results.TWENTY_FIVE]}
    human = {runs[0] for _, runs in leaderboard.HUMAN.values()}
    assert by_length | few | human <= names


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    pytest.importorskip("sphinx")
    out = tmp_path_factory.mktemp("docs")
    # Tutorials that ran before run again: what they use may have changed.
    run_all = ["-D", "sphinx_gallery_conf.run_stale_examples=True"]
    words = ["-W", "--keep-going", "-q", *run_all, "-d", str(tmp_path_factory.mktemp("doctrees"))]
    subprocess.run([sys.executable, "-m", "sphinx", *words, str(DOCS), str(out)], check=True)
    return out


@pytest.mark.slow
def test_built_docs_hold_every_public_name(built):
    from sphinx.util.inventory import InventoryFile

    inventory = InventoryFile.loads((built / "objects.inv").read_bytes(), uri="")
    described = {name for kind, items in inventory.data.items() if kind.startswith("py:") for name in items}
    assert set(_reference()) <= described


@pytest.mark.slow
def test_built_docs_are_small_and_hold_the_videos(built):
    assert sum(path.stat().st_size for path in built.rglob("*") if path.is_file()) < 30_000_000
    notebooks = {path.stem for path in (built / "_downloads").rglob("*.ipynb")}
    assert notebooks == {path.stem for path in (DOCS / "tutorials").glob("plot_*.py")}
    videos = re.findall(r'<video[^>]* src="([^"#]+)', (built / "gallery.html").read_text())
    assert videos and all((built / video).is_file() for video in videos)
