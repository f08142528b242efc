"""Everything that needs a GPU, in parts of a few minutes; a part that has written its row is skipped.

python benchmarks/gpu.py                              # parts without a row of this commit and these options
python benchmarks/gpu.py --part 0                     # the demonstrations, which need no GPU
python benchmarks/gpu.py --part 4 --prior gaussian past --minutes 15
python benchmarks/gpu.py --device cpu --smallest      # try this script without a GPU
"""

from __future__ import annotations

import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

from tqdm import tqdm

from lab.demonstrations.data_options import check_counts
from lab.io.errors import ERRORS, PartialFailure
from lab.io.machine import check_device, facts_of_machine
from lab.options.command_line import read, script
from lab.options.options import Options, check_given, with_parts
from lab.options.presets import PRESETS, adapted
from warmprior.checks import check_choice, check_positive
from warmprior.io.files import check_writable, write_atomic

if TYPE_CHECKING:
    from lab.running.policies import Cell, Policy
    from lab.speed.timing import Clock

ROOT = Path(__file__).parents[1]
PROBE, TINY_PROBE = 300, 6
"""Iterations of the short training that tells how many fit into the time, usually and with --smallest."""

BEFORE_PLAYING, ALONE = 0.75, 0.9
"""Share of a part's time for its trainings, if episodes follow and if not."""

DEMONSTRATIONS = {"state": 100, "image": 6}
"""Number of demonstrations to generate; with their images they take less than 60 MiB."""

SMALLEST: dict[str, dict[str, Any]] = {
    "data": {"demonstrations": (3,), "image_size": 32, "fast_rendering": True},
    "network": {"network": "chi_transformer,hidden_dim=48", "crop_size": 28},
    "training": {"batch_size": 4},
    "evaluation": {"episodes": 1},
}


@dataclass(frozen=True)
class GpuOptions:
    """Options of this script: the parts to run, their policies, and their time."""

    # parts to run (default: all): 0 demonstrations, 1 tests, 2 ratios, 3 speed, 4 training from states, 5
    # training from images
    part: tuple[int, ...] = ()
    minutes: float | None = None  # time limit of a part in minutes (default: 3 to 7.5)
    preset: str = "paper"  # preset of robomimic.py for network and recipe of parts 4 and 5
    prior: tuple[str, ...] = ("past",)  # methods of parts 4 and 5, which share the time
    episodes: int = 20  # evaluation episodes of part 4, per method and NFE
    device: str = "cuda"  # device of networks and data, such as cuda
    smallest: bool = False  # run tiny training runs on lift, to try this script
    out: Path = Path("runs/gpu")  # output folder; also the cache unless $WARMPRIOR_CACHE is set
    commit: str | None = None  # name of this version of the code (default: git describe)

    def check(self) -> None:
        for number in self.part:
            check_choice("--part", str(number), map(str, PARTS))
        if self.minutes is not None:
            check_positive(**{"--minutes": self.minutes})
        check_choice("--preset", self.preset, PRESETS)
        check_given(self, "prior")
        check_counts(self, "episodes")

    @property
    def probe(self) -> int:
        return TINY_PROBE if self.smallest else PROBE

    def policies(self, obs: str, iterations: int = 1, first: bool = False) -> tuple[Options, list[Policy]]:
        """Return the preset's policies for a number of iterations; encoders start from random weights."""
        from lab.running.policies import policies_of

        changes: dict[str, Any] = {
            "data": {"obs": obs, "demonstrations": (DEMONSTRATIONS[obs],)},
            "network": {"encoder": "resnet18"},
            "training": {"iterations": iterations, "checkpoints": 1, "log_every": max(1, self.probe // 3)},
            "sources": {"prior": self.prior[:1] if first else self.prior},
            "evaluation": {"seeds": 1, "episodes": self.episodes},
            "preset": self.preset,
            "run": {"device": self.device, "out": self.out / obs / "run"},
        }
        changes["run"]["compile"] = self.device != "cpu"
        options = adapted(PRESETS[self.preset], with_parts(PRESETS[self.preset], **changes))
        options = with_parts(options, **changes)
        if self.smallest:
            options = with_parts(options, **SMALLEST)
        place = ("lift", "ph") if self.smallest else ("square", "mh")
        return options, policies_of(options, place, only=True)


def inputs(o: GpuOptions, seconds: float) -> dict[str, Any]:
    """Read or make the demonstrations of parts 4 and 5."""
    facts_by_obs = {obs: o.policies(obs)[1][0].task().facts for obs in DEMONSTRATIONS}
    kept = ("demonstrations", "steps")
    return {obs: {name: facts[name] for name in kept} for obs, facts in facts_by_obs.items()}


def tests(o: GpuOptions, seconds: float) -> dict[str, Any]:
    """Run the tests that are marked `cuda`."""
    # Only their files: collecting the others takes a minute, and packages that this machine may lack.
    files = [path for path in (ROOT / "tests").rglob("test_*.py") if "pytest.mark.cuda" in path.read_text()]
    report = (o.out / "tests.xml").absolute()
    command = [sys.executable, "-m", "pytest", "-q", "-m", "cuda", f"--junitxml={report}", *map(str, files)]
    try:
        code = subprocess.run(command, cwd=ROOT, timeout=seconds, check=False).returncode
    except subprocess.TimeoutExpired:
        raise PartialFailure(f"the tests take more than {seconds / 60:g} minutes: raise --minutes") from None
    if code not in (0, 1):  # all passed, or some failed
        raise PartialFailure(f"the tests did not run: pytest ended with code {code}; its output is above")
    cases = list(ElementTree.parse(report).iter("testcase"))
    failed = [case.get("name") for case in cases if {"failure", "error"} & {part.tag for part in case}]
    skipped = sum(case.find("skipped") is not None for case in cases)
    return {"passed": len(cases) - skipped - len(failed), "skipped": skipped, "failed": failed}


def clock(o: GpuOptions) -> Clock:
    from lab.speed.timing import Clock

    return Clock(1 if o.smallest else 11, tqdm(desc="rounds", leave=False, disable=None))


def ratios(o: GpuOptions, seconds: float) -> dict[str, Any]:
    """Measure the library over bare torch: as throughput.py does."""
    from lab.speed.training import cuda_train_step_over_network

    return {"cuda_train_step_over_network": cuda_train_step_over_network(clock(o))}


def speed(o: GpuOptions, seconds: float) -> dict[str, Any]:
    """Measure training steps per second of the paper's transformer: `cuda_steps_per_second`."""
    from lab.speed.training import small_network, steps_per_second

    tiny: dict[str, Any] = {"network": small_network, "batch": 4} if o.smallest else {}
    return steps_per_second(clock(o), o.device, **tiny) or {}


def train_for(o: GpuOptions, seconds: float, obs: str) -> tuple[Options, list[Policy]]:
    """Train a policy per method, for as many iterations as fit, by the speed of a short training."""
    from lab.running.comparison import train_all

    begun = time.monotonic()
    shutil.rmtree(o.out / obs, ignore_errors=True)  # logs of an interrupted part would mislead
    options, probes = o.policies(obs, o.probe, first=True)
    starts = time.monotonic()
    train_all(options, probes)
    rate = iterations_per_second(probes[0])
    starting = time.monotonic() - starts - o.probe / rate  # seconds to start a process and to compile
    left = seconds - (time.monotonic() - begun)
    fit = 0 if o.smallest and o.minutes is None else int(rate * (left / len(o.prior) - starting))
    options, policies = o.policies(obs, max(o.probe, fit))
    train_all(options, policies)
    return options, policies


def iterations_per_second(policy: Policy) -> float:
    """Return the median over the training's log, without its first entry, in which it compiles."""
    path = policy.run.folder / "logs" / policy.name / "scalars/train/iterations_per_second.csv"
    return statistics.median(float(line.split(",")[1]) for line in path.read_text().splitlines()[1:])


def training_facts(policy: Policy) -> dict[str, Any]:
    """Return the speed and losses of a training, with the policy's facts."""
    (_, first), *_, (_, last) = policy.losses
    measures = {"iterations_per_second": iterations_per_second(policy), "first_loss": first, "loss": last}
    return {**policy.facts, "batch_size": policy.training.batch_size, **measures}


def states(o: GpuOptions, seconds: float) -> dict[str, Any]:
    """Train from states, and play episodes."""
    from lab.running.comparison import EPISODES_PER_JOB
    from lab.running.jobs import Jobs
    from lab.running.measuring import row
    from lab.running.policies import Cell, play

    options, policies = train_for(o, BEFORE_PLAYING * seconds, "state")
    last = policies[0].training.iterations
    cells: dict[tuple[Policy, Cell], list[Any]] = {
        (p, Cell(last, nfe, temperature=temperature)): []
        for p in policies
        for nfe in p.method.nfes(options.evaluation.nfe)
        for temperature in p.method.temperatures(options.evaluation.temperature)
    }
    jobs_per_cell = range(0, options.evaluation.episodes, EPISODES_PER_JOB)
    with Jobs(options.run) as jobs:
        for ((policy, cell), episodes), i in product(cells.items(), jobs_per_cell):
            seeds_of_job = options.evaluation.starts(policy.training.seed)[i : i + EPISODES_PER_JOB]
            work = play, policy, cell, options.evaluation, seeds_of_job
            jobs.submit(f"play {policy}, {cell}, from {seeds_of_job[0]}", *work, then=episodes.extend)
        if failures := jobs.wait():
            raise PartialFailure("; ".join(f"{name}: {why}" for name, why in failures.items()))
    kept = ("prior", "nfe", "temperature", "episodes", "successes", "mean_steps")
    rows = (row(policy, cell, episodes, {}) for (policy, cell), episodes in cells.items())
    played = [{name: each[name] for name in kept} for each in rows]
    return {"trained": [training_facts(policy) for policy in policies], "played": played}


def images(o: GpuOptions, seconds: float) -> dict[str, Any]:
    """Train from the images of two cameras."""
    return {"trained": [training_facts(policy) for policy in train_for(o, ALONE * seconds, "image")[1]]}


PARTS = dict(
    enumerate([(inputs, 7.5), (tests, 4.0), (ratios, 3.0), (speed, 3.0), (states, 7.5), (images, 5.0)])
)
"""By number: the function, and its time limit in minutes."""


def commit_of_sources() -> str:
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        return subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError) as error:
        raise ValueError("this is no git checkout: name the version of the code with --commit") from error


@script("gpu.py", hint="the same command continues")
def main(argv: list[str] | None) -> None:
    o = read(GpuOptions(), sys.argv[1:] if argv is None else argv, __doc__)
    from lab.reporting.rows import read_lines

    o.check()
    parts = sorted(set(o.part or PARTS))
    if parts != [0]:
        check_device(o.device)
    check_writable(o.out)
    os.environ.setdefault("WARMPRIOR_CACHE", str((o.out / "inputs").absolute()))
    recorded = {name: value for name, value in asdict(o).items() if name not in ("part", "out", "commit")}
    identity = {"commit": o.commit or commit_of_sources(), "options": json.loads(json.dumps(recorded))}
    path, failures = o.out / "parts.jsonl", []
    rows = read_lines(path) if path.exists() else []
    for number in parts:
        work, minutes = PARTS[number]
        key, name = {"part": number, **identity}, f"part {number}, {work.__name__}"
        has_row = any(key.items() <= row.items() for row in rows)
        done = has_row and not identity["commit"].endswith("-dirty")
        print(f"{name}: done before" if done else name, flush=True)
        if done:
            continue
        begun = time.monotonic()
        try:
            results = work(o, 60 * (o.minutes or minutes))
        except ERRORS as error:  # the other parts go on
            failures.append(f"{name}: {error}")
            print(f"FAILED {failures[-1]}", flush=True)
            continue
        facts = {"seconds": time.monotonic() - begun, **facts_of_machine()}
        rows.append({**key, **facts, "results": results})
        text = "".join(json.dumps(row) + "\n" for row in rows)
        write_atomic(path, partial(Path.write_text, data=text))
        print(json.dumps(results), flush=True)
    print(f"Rows: {path}")
    if failures:
        raise PartialFailure("; ".join(failures))


if __name__ == "__main__":
    sys.exit(main())
