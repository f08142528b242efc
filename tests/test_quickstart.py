"""The documentation's quickstart runs as it stands."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest

QUICKSTART = Path(__file__).parents[1] / "docs" / "quickstart.md"


def test_quickstart_runs_and_saves_a_policy(tmp_path, monkeypatch, capsys):
    pytest.importorskip("gymnasium")
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"```python\n(.*?)```", QUICKSTART.read_text(), flags=re.DOTALL)
    scope: dict = {}
    exec(compile(code, str(QUICKSTART), "exec"), scope)
    returns = [float(line) for line in capsys.readouterr().out.split()]
    assert len(returns) == 2
    # A pendulum that is damped costs at most what it costs hanging at rest: pi^2 per control step.
    assert all(math.isfinite(r) and -200 * math.pi**2 * 1.2 < r < 0 for r in returns)
    assert (tmp_path / "policy" / "model.safetensors").exists()
