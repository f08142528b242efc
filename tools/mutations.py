"""Thirty faults of one line, over all rooms: does the suite catch them?

python tools/mutations.py              # all, in a copy of the last commit; some minutes
python tools/mutations.py 3 7          # the third and the seventh

A fault is a line of the library and what replaces it, with the test files that must fail. Files are found by
the line, and tests by their names, so that rooms may move. Without a fault all of these tests must pass.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FAULTS = [  # (line, its replacement, names of test files)
    ('(history["steps"] + executed).clamp(max=remembered)', "executed.clamp(max=remembered)", "history"),
    ("line[..., low : low + remembered + length, :]", "line[..., : remembered + length, :]", "history"),
    (
        'warm = (history["steps"] >= self.chunk_length)',
        'warm = (history["steps"] > self.chunk_length)',
        "sampler sources_and_starts",
    ),
    ("& (position < self.chunk_length)", "& (position <= self.chunk_length)", "prior"),
    ("math.sqrt(1.0 - self.correlation), math.sqrt(", "1.0 - self.correlation, math.sqrt(", "prior"),
    ("time = begin + (step + sum(row)) * h", "time = begin + step * h", "ode"),
    ("return 1 - t, t, -one, one", "return 1 - t, t, one, one", "ode flow_matching preconditioning"),
    ("alpha * d_beta + d_alpha * beta, c)", "alpha * d_beta - d_alpha * beta, c)", "preconditioning"),
    ("total = weight.sum() * error.shape[-1]", "total = weight.sum()", "flow_matching"),
    ("alpha=self.gamma**i)", "alpha=self.gamma)", "chunk"),
    ("draw < self.probability", "draw > self.probability", "history window"),
    ("full = steps >= actions.shape[-2]", "full = steps > 0", "history observations"),
    ("torch.full_like(executed, self.delay)", "torch.full_like(executed, self.delay + 1)", "delay"),
    ("recent = old.narrow(time, 1, self.steps - 1)", "recent = old.narrow(time, 0, self.steps - 1)", "stack"),
    ("@ now[..., :3].mT", "@ now[..., :3]", "absolute_actions"),
    ("noise = anchor + residual.to(", "noise = anchor - residual.to(", "decoder"),
    ("torch.where(valid, mean, noise)", "torch.where(valid, mean, 0 * noise)", "anchor"),
    ("value = value - alpha * log_prob", "value = value + alpha * log_prob", "dsrl"),
    ("torch.where(constant, 1.0, half)", "half", "normalize"),
    ("return sorted(outcomes, key=lambda outcome: outcome.seed)", "return outcomes", "evaluation"),
    ("yield tallies[i].episode(seeds[episode])", "yield tallies[i].episode(seeds[i])", "evaluation"),
    ("last_epoch=iteration - 1)", "last_epoch=-1)", "behaviour_cloning_states behaviour_cloning"),
    (
        "if any(stored.get(part) != value for",
        "if any(stored.get(part) is None for",
        "behaviour_cloning_failures behaviour_cloning_states",
    ),
    ("values = np.asarray(observations)[:-1]", "values = np.asarray(observations)[1:]", "minari"),
    ("(block).permute(0, 3, 1, 2)", "(block).permute(0, 3, 2, 1)", "observe convert"),
    ("self._executed >= min(self.execute, self._end)", "self._executed >= self._end", "executor"),
    ("executed = first + begins.int().argmax(1)", "executed = begins.int().argmax(1)", "rollout"),
    ("boundary = together & (decision", "boundary = (decision", "smoothness"),
    ("variance(unbiased=True)[counted]", "variance(unbiased=False)[counted]", "source_leak"),
]


def sources(root: Path, line: str) -> list[Path]:
    """Return the files of the library that hold a line."""
    return [path for path in root.glob("warmprior/**/*.py") if line in path.read_text(encoding="utf-8")]


def tests_of(root: Path, names: str) -> list[str]:
    """Return the test files with these names; raise ValueError if there is none of a name."""
    found = {name: [str(path) for path in root.glob(f"tests/**/test_{name}.py")] for name in names.split()}
    if unknown := [name for name, paths in found.items() if not paths]:
        raise ValueError(f"there is no test_{unknown[0]}.py: name the file that checks the line")
    return sorted({path for paths in found.values() for path in paths})


def outcome(root: Path, tests: list[str]) -> int:
    """Return pytest's exit code for test files: 0 if they pass, 1 if a test fails."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
    places = [str(root / part) for part in ("", "benchmarks", "plugins/lerobot_policy_warmprior")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(places), "OMP_NUM_THREADS": "1"}
    ran = subprocess.run(command, cwd=root, env=environment, stdout=subprocess.PIPE, text=True)
    if ran.returncode not in (0, 1):  # no failed test: something of the machine or the script is wrong
        print(ran.stdout)
    return ran.returncode


def is_caught(root: Path, line: str, replacement: str, names: str) -> bool:
    """Return True if a test fails with the fault; raise ValueError if the line is not there once."""
    found = sources(root, line)
    if len(found) != 1:
        raise ValueError(f"{line!r} is in {len(found)} files: name a line that is in one")
    before = found[0].read_text(encoding="utf-8")
    tests = tests_of(root, names)
    if before.count(line) != 1:
        raise ValueError(
            f"{line!r} is {before.count(line)} times in {found[0]}: name a line that is there once"
        )
    found[0].write_text(before.replace(line, replacement), encoding="utf-8")
    try:
        return outcome(root, tests) == 1  # any other code is no failed test
    finally:
        found[0].write_text(before, encoding="utf-8")


def main(chosen: list[str]) -> int:
    """Try the faults; return 1 if one is not caught."""
    numbers = [int(number) - 1 for number in chosen] or range(len(FAULTS))
    missed = 0
    with tempfile.TemporaryDirectory() as folder:
        archive = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, check=True, capture_output=True)
        subprocess.run(["tar", "x", "-C", folder], input=archive.stdout, check=True)
        names = " ".join(FAULTS[number][2] for number in numbers)
        if code := outcome(Path(folder), tests_of(Path(folder), names)):
            raise RuntimeError(f"without a fault the tests end with code {code}: mend them first")
        for number in numbers:
            caught = is_caught(Path(folder), *FAULTS[number])
            missed += not caught
            print(f"{number + 1:2} {'caught' if caught else 'MISSED'}: {FAULTS[number][0]}", flush=True)
    return min(missed, 1)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
