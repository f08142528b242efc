"""The paper's Table 1: Gaussian source, WP-Past and WP-Preview on robomimic's tasks.

python benchmarks/robomimic.py                                   # a first table within minutes
python benchmarks/robomimic.py --task can stack --style ph mh --preset cpu
python benchmarks/robomimic.py --obs image                       # lift from two cameras
python benchmarks/robomimic.py --download --preset paper --device cuda --out runs/paper
torchrun --nproc-per-node 2 benchmarks/robomimic.py --preset paper --device cuda    # on two GPUs
python benchmarks/robomimic.py --resume --out runs/paper         # after an interruption
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

from lab.options.command_line import parse, script, started
from lab.options.options import Options
from lab.options.presets import PRESETS, WHY_QUICK
from lab.running.phases import Phases


def run(
    argv: list[str] | None, presets: Mapping[str, Options], study: str, doc: str | None, **parsing: Any
) -> None:
    """Run the whole benchmark: options, data, training and playing, table and pictures."""
    phases = Phases()
    options = parse(presets, argv, study, doc, **parsing)
    from lab.reporting.report import success_report, summary, terminal_table, unlike, write_report
    from lab.running.comparison import compare
    from lab.running.pictures import draw, films
    from lab.running.policies import policies_of

    phases.end("imports and options")
    with started(options, study) as out:
        # Demonstrations are generated, downloaded, or read from --dataset. There is a policy per task, method
        # and seed. Policies of a task differ in the source alone (lab/methods/methods.py); `train`
        # in lab/running/policies.py gives it to the loss.
        policies = policies_of(options)
        phases.end("demonstrations")

        # A row per policy, checkpoint and NFE: the policy, how it was played, and the result.
        rows, failures = compare(options, policies, films=films(options, policies))
        phases.end("training and playing")

        # The table, then the pictures.
        top_k = options.evaluation.top_k
        results = summary(rows, top_k)
        source = policies[0].task().facts.get("source")
        notes = [*unlike(options, presets["paper"]), f"Time before the pictures: {phases}."]
        if options.data == PRESETS["quick"].data:
            notes.insert(0, WHY_QUICK)
        full = success_report(results, top_k, notes, source)
        try:
            write_report(out, terminal_table(results, top_k), full, results, failures)
        finally:
            draw(options, policies, rows)  # drawn even if some policies are missing


@script("robomimic.py", together=True)
def main(argv: list[str] | None) -> None:
    run(argv, PRESETS, "robomimic", __doc__)


if __name__ == "__main__":
    sys.exit(main())
