"""The paper's Table 1 on MimicGen: Stack, Coffee and Threading from images, ten demonstrations each.

python benchmarks/mimicgen_tasks.py                              # robosuite's Stack, scripted, from state
python benchmarks/mimicgen_tasks.py --download --preset paper --device cuda --out runs/mimicgen
python benchmarks/mimicgen_tasks.py --download --task coffee_d0 --style core --demonstrations 10
python benchmarks/mimicgen_tasks.py --resume --out runs/mimicgen # after an interruption

With --download or --dataset the tasks are MimicGen's own, stack_d0, coffee_d0 and threading_d0, and need its
package (docs/data.md). Its data have the licence CC BY-NC-SA 4.0. This script is not called mimicgen.py,
because Python would then import it in place of that package.
"""

from __future__ import annotations

import sys

from robomimic import run

from lab.options.command_line import script
from lab.options.options import Options, with_parts
from lab.options.presets import IMAGES, PRESETS, adapted

LARGE = ("paper", "much-ado")  # presets for a GPU, whose policies see images


def few(name: str, preset: Options) -> Options:
    """Return a preset with the paper's ten demonstrations, and a training run of suitable length."""
    large = name in LARGE
    return with_parts(
        with_parts(preset, **IMAGES[name]) if large else preset,
        data={"task": ("stack",), "demonstrations": (10,), "obs": "image" if large else "state"},
        training={"iterations": 50_000 if large else 5_000, "batch_size": 128},
    )


FEW = {name: few(name, preset) for name, preset in PRESETS.items()}


def adapt(preset: Options, typed: Options) -> Options:
    """Return the preset for MimicGen's own tasks if there is a file, else for robosuite's Stack."""
    chosen = adapted(preset, typed)
    if typed.data.generated:
        return chosen
    tasks = () if typed.data.dataset else ("stack_d0", "coffee_d0", "threading_d0")
    return with_parts(chosen, data={"task": tasks, "style": ("source",)})


@script("mimicgen_tasks.py", together=True)
def main(argv: list[str] | None) -> None:
    run(argv, FEW, "mimicgen", __doc__, adapt=adapt)


if __name__ == "__main__":
    sys.exit(main())
