"""The paper's Table 1 on MimicGen: ten demonstrations of Stack, Coffee and Threading, from images.

python benchmarks/mimicgen_tasks.py                              # robosuite's Stack, scripted, from state
python benchmarks/mimicgen_tasks.py --download --preset paper --device cuda --out runs/mimicgen
python benchmarks/mimicgen_tasks.py --download --task coffee_d0 --data core --demonstrations 10
python benchmarks/mimicgen_tasks.py --resume --out runs/mimicgen # after an interruption

With --download or --dataset the tasks are MimicGen's own, stack_d0, coffee_d0 and threading_d0, and need its
package (docs/data.md). Its data have the licence CC BY-NC-SA 4.0. (A script called mimicgen.py would be in
the way of that package: Python looks for modules beside a script first.)
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from warmprior.experiments import PRESETS, DataOptions, Recipe, comparison_preset, study_success
from warmprior.io.script import run_script


def few(preset: Recipe, iterations: int, **data: Any) -> Recipe:
    """A preset for ten demonstrations, the paper's number."""
    return replace(
        preset,
        data=DataOptions(task=("stack",), demonstrations=(10,), **data),
        training=replace(preset.training, iterations=iterations, batch_size=128),
    )


FEW = {
    "quick": few(PRESETS["quick"], 5_000),
    "cpu": few(PRESETS["cpu"], 5_000),
    "paper": few(PRESETS["paper"], 50_000, obs="image"),
}


def preset(asked: Recipe) -> Recipe:
    """That of what is asked for: without a file robosuite's Stack, which has a scripted expert."""
    chosen = comparison_preset(asked, FEW)
    if asked.data.generated:
        return chosen
    tasks = () if asked.data.dataset else ("stack_d0", "coffee_d0", "threading_d0")
    return replace(chosen, data=replace(chosen.data, task=tasks, data=("source",)))


def main(argv: Sequence[str] | None = None) -> int:
    options = {"study": "mimicgen", "description": __doc__, "preset": preset}
    script = partial(study_success, FEW, argv, **options)
    return run_script(script, "mimicgen_tasks.py", together=True)


if __name__ == "__main__":
    sys.exit(main())
