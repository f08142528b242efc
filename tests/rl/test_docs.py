"""The example of prior-space reinforcement learning runs as it stands."""

from __future__ import annotations

import math
import re
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "prior_space_rl.md"


def test_example_runs(capsys):
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), flags=re.DOTALL)
    scope: dict = {}
    exec(compile(code, str(PAGE), "exec"), scope)
    rates = [float(line) for line in capsys.readouterr().out.split()]
    assert len(rates) == 2 and all(0 <= rate <= 1 for rate in rates)
    assert len(scope["buffer"]) == 8 * 16 + 128
    assert all(math.isfinite(float(p.detach().abs().max())) for p in scope["loss"].parameters())
