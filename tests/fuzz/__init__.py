"""Damaged files by the hundred; results and options are those of the benchmarks, beside the package."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
