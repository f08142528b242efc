import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "gallery.md").read_text()
FILES = ROOT / "docs" / "_static" / "gallery"
DRAWS = re.compile(r"\b(?:plot_\w+|new_figure|draw)\(|from robomimic import run\b")


def _drawing() -> dict[str, str]:
    """Benchmarks that draw, and their source: not throughput.py, which times."""
    found = {script.name: script.read_text() for script in (ROOT / "benchmarks").glob("[!_]*.py")}
    return {name: source for name, source in found.items() if DRAWS.search(source)}


def _sections() -> dict[str, str]:
    parts = re.split(r"^## `(\w+\.py)`.*$", PAGE, flags=re.M)[1:]
    return dict(zip(parts[::2], parts[1::2], strict=True))


def _pictures() -> list[tuple[str, str]]:
    """Text and path of every picture of the page."""
    return re.findall(r"!\[([^\]]*)\]\(([^)\s]+)\)", PAGE)


def _shown() -> set[str]:
    return {*(path for _, path in _pictures()), *re.findall(r'(?:src|href)="([^"#]+)', PAGE)}


def test_every_benchmark_that_draws_has_a_section_with_a_command_and_a_picture():
    assert set(_sections()) == set(_drawing())
    for name, text in _sections().items():
        assert f"```console\npython benchmarks/{name}" in text
        assert "_static/" in text


def test_everything_shown_exists_and_everything_kept_is_shown():
    assert all((ROOT / "docs" / path).is_file() for path in _shown())
    kept = {f"_static/gallery/{path.name}" for path in FILES.iterdir()}
    assert kept == {path for path in _shown() if path.startswith("_static/gallery/")}
