"""The pages about robots, whose programs run as they stand in a fresh process."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
BLOCKS = [
    pytest.param(block, id=f"{page}-{number}")
    for page in ("your_robot", "real_time_chunking")
    for number, block in enumerate(
        re.findall(r"```python\n(.*?)```", (DOCS / f"{page}.md").read_text(), re.S)
    )
]


@pytest.mark.parametrize("block", BLOCKS)
def test_programs_run_as_they_stand(block, tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", block], capture_output=True, text=True, cwd=tmp_path, timeout=300
    )
    assert done.returncode == 0, done.stderr


def test_the_example_has_the_options_that_the_page_names():
    page = (DOCS / "your_robot.md").read_text()
    command = [sys.executable, str(DOCS.parent / "examples" / "robot_loop.py"), "--help"]
    listed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    (training,) = re.findall(r"python -m warmprior train (.*?)```", page, re.S)
    named = set(re.findall(r"(?:robot_loop\.py|`)\s*(--[a-z-]+)", page)) - {*training.split()}
    assert {"--camera", "--unplug"} <= named
    assert all(option in listed for option in named)
