"""The paper's Table 1: Gaussian source, WP-Past and WP-Preview on Robomimic tasks.

python benchmarks/robomimic.py                                   # a first table within 15 minutes
python benchmarks/robomimic.py --task can stack --data ph mh --preset cpu
python benchmarks/robomimic.py --obs image                       # lift from two cameras
python benchmarks/robomimic.py --download --preset paper --device cuda --out runs/paper
torchrun --nproc-per-node 2 benchmarks/robomimic.py --preset paper --device cuda    # on two GPUs
python benchmarks/robomimic.py --resume --out runs/paper         # after an interruption
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import partial

from warmprior.experiments import PRESETS, comparison_preset, study_success
from warmprior.io.script import run_script


def main(argv: Sequence[str] | None = None) -> int:
    options = {"study": "robomimic", "description": __doc__, "preset": comparison_preset}
    script = partial(study_success, PRESETS, argv, **options)
    return run_script(script, "robomimic.py", together=True)


if __name__ == "__main__":
    sys.exit(main())
