import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "gallery.md").read_text()
DRAWS = re.compile(r"\b(?:plot_\w+|new_figure|draw)\(|from robomimic import run\b")


def _drawing() -> dict[str, str]:
    """Benchmarks that draw, and their source: not throughput.py, which times."""
    found = {script.name: script.read_text() for script in (ROOT / "benchmarks").glob("[!_]*.py")}
    return {name: source for name, source in found.items() if DRAWS.search(source)}


def _sections() -> dict[str, str]:
    parts = re.split(r"^## `(\w+\.py)`.*$", PAGE, flags=re.M)[1:]
    return dict(zip(parts[::2], parts[1::2], strict=True))


def test_every_section_is_of_a_benchmark_that_draws_with_a_command_and_a_picture():
    assert {"robomimic.py", "navigation1d.py"} <= set(_sections()) <= set(_drawing())
    for name, text in _sections().items():
        assert f"```console\npython benchmarks/{name}" in text
        assert "_static/" in text


def test_every_picture_of_the_gallery_is_shown():
    stored = {path.name for path in (ROOT / "docs" / "_static" / "gallery").iterdir()}
    assert stored == set(re.findall(r"_static/gallery/([\w.]+)", PAGE))
