"""``make fuzz``: damage files by the hundred, and see that none is believed.

Every outcome is one of: loaded equal to the undamaged file; loaded as any reader would find it (where
the damage is a change that the format cannot tell from a choice); refused with an error that names the
file; or a failure, which is listed. The exit code is 1 if there is any.
"""

import argparse
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
import torch

from tests.fuzz.generators import SUBJECTS
from tests.fuzz.sandbox import LIMIT_BYTES, LIMIT_SECONDS, attempt


def main() -> int:
    parser = argparse.ArgumentParser(prog="make fuzz", description=__doc__.split("\n\n")[0])
    parser.add_argument("--cases", type=int, default=300, help="per kind of file")
    parser.add_argument("--seed", type=int, default=0, help="of the first case")
    args = parser.parse_args()
    torch.set_num_threads(1)  # forked processes inherit no other threads
    warnings.simplefilter("ignore")
    failures = 0
    print("| files | cases | equal | as stored | refused | failures | seconds |")
    print("|---|---|---|---|---|---|---|")
    for subject in SUBJECTS:
        started, counts = time.monotonic(), Counter()
        with tempfile.TemporaryDirectory(prefix="warmprior-fuzz-") as folder:
            subject.make(Path(folder))
            for seed in range(args.seed, args.seed + args.cases):
                how, load, names = subject.mutate(Path(folder), np.random.default_rng(seed))
                outcome = attempt(load, names)
                counts["failures" if outcome.failed else outcome.kind] += 1
                if outcome.failed:
                    place = f"{subject.name}, seed {seed} ({how})"
                    print(f"{place}: {outcome.kind}: {outcome.detail}", file=sys.stderr)
        cells = [counts[kind] for kind in ("equal", "as stored", "refused", "failures")]
        row = [subject.name, args.cases, *cells, f"{time.monotonic() - started:.0f}"]
        print("| " + " | ".join(map(str, row)) + " |", flush=True)
        failures += counts["failures"]
    print(f"\nNo case may take {LIMIT_SECONDS:.0f} s or {LIMIT_BYTES / 2**30:.0f} GiB.")
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
