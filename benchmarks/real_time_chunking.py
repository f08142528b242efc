"""The paper's comparison with Real-Time Chunking, in simulation: chunks that take effect late.

python benchmarks/real_time_chunking.py                     # square and the toy, one seed
python benchmarks/real_time_chunking.py --toy alone         # minutes
python benchmarks/real_time_chunking.py --task can stack --toy no --preset cpu
python benchmarks/real_time_chunking.py --resume            # after an interruption

While a chunk is computed, the one before is executed. Each source is played without and with the guidance of
Real-Time Chunking, with the same decisions per second at every delay. Policies that robomimic.py trained with
the same options are reused.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Literal

from lab.demonstrations.data_options import check_counts
from lab.options.command_line import parse, script, started
from lab.options.options import Options, check_given, check_single
from lab.options.presets import PRESETS, study
from warmprior.options.guidance import GuidanceOptions

if TYPE_CHECKING:
    from lab.methods.methods import Method
    from lab.running.policies import Cell

STUDY = "real-time-chunking"


@dataclass(frozen=True)
class DelayOptions(Options):
    """Options of a comparison under injected latency."""

    delay: tuple[int, ...] = (0, 2, 4)  # delays to evaluate, in control steps until a chunk takes effect
    execute: int | None = None  # actions executed per decision (default: H minus the largest delay)
    guidance: tuple[Literal["none", "rtc"], ...] = ("none", "rtc")  # no guidance, Real-Time Chunking, or both
    toy: Literal["beside", "alone", "no"] = "beside"  # play the toy in addition to the tasks, alone, or not
    rtc: GuidanceOptions = field(default_factory=GuidanceOptions)  # options of the guidance

    @property
    def name(self) -> str:
        if self.toy == "alone":
            return "navigation"
        return super().name + ("-navigation" if self.toy == "beside" else "")

    def check(self) -> None:
        from warmprior.transforms.delay import check_delay

        super().check()
        check_single(self, "chunk", "temperature")
        check_given(self, "delay", "guidance")
        check_counts(self, "execute")
        if self.toy != "no" and self.evaluation.play_on:
            raise ValueError("--play-on does not work on the toy: leave it out, or add --toy no")
        for delay in self.delay:
            check_delay(delay, delay)
        for method in self.sources.methods():
            cells = self.conditions(method)
            if not cells:
                raise ValueError(f"{method.name} is no flow to guide: leave it out, or add --guidance none")
            for cell in cells:
                delay, execute, length = cell.delay or 0, cell.execute or 1, method.prediction_length
                try:
                    if execute > method.chunk_length:
                        raise ValueError(f"need execute <= H = {method.chunk_length}")
                    check_delay(delay, execute, length)
                    if cell.guidance is not None:
                        cell.guidance.check_reach(delay, length - execute)
                except ValueError as error:
                    raise ValueError(
                        f"--delay {delay} with --execute {execute} and {method.name}, which predicts "
                        f"{length}: {error}"
                    ) from error

    def conditions(self, method: Method) -> list[Cell]:
        """Return the settings to play a method with: every delay, and every guidance that fits it."""
        from lab.running.policies import Cell
        from warmprior.modules.real_time_chunking import RealTimeChunking

        execute = self.execute or max(1, self.sources.chunk[0] - max(self.delay))
        guidances = {"none": None, "rtc": RealTimeChunking(**vars(self.rtc))}
        return [
            Cell(0, 0, delay, execute, guidances[name])
            for delay in sorted(set(self.delay))
            for name in dict.fromkeys(self.guidance)
            if name == "none" or method.is_flow
        ]


@script("real_time_chunking.py")
def main(argv: list[str] | None) -> None:
    """Train the policies, and play them at every delay."""
    # Nine network evaluations per chunk: guidance corrects step by step.
    presets = {
        name: study(DelayOptions, base, evaluation=replace(base.evaluation, nfe=(9,)))
        for name, base in PRESETS.items()
    }
    options = parse(presets, argv, STUDY, __doc__)
    from lab.reporting.plots import plot_bars
    from lab.reporting.report import counted, labelled, per_seed, table, write_report
    from lab.running.comparison import compare
    from lab.running.policies import policies_of

    with started(options, STUDY) as out:
        toy = [] if options.toy == "no" else [("navigation", "toy")]
        alone = options.toy == "alone"
        policies = policies_of(options, *toy, only=alone)
        rows, failures = compare(options, policies, options.conditions)
        seeds = per_seed(labelled(rows), options.evaluation.top_k)
        seeds = seeds.sort_values(["nfe", "delay"], ascending=[False, True], kind="stable")
        lines = {"success": "success rate", "boundary_jump": "jump where chunks take effect"}
        for nfe, seeds_at_nfe in seeds.groupby("nfe"):
            end = f"_nfe{nfe}.png" if seeds.nfe.nunique() > 1 else ".png"
            actions = seeds_at_nfe.execute.iloc[0]
            title = f"NFE {nfe}, {actions} actions per decision, {counted(len(options.seeds), 'seed')}"
            bars = seeds_at_nfe.assign(delay="delay " + seeds_at_nfe.delay.astype(str))
            plot_bars(bars, out / f"real_time_chunking{end}", title, "delay", lines)
        rtc_options = {f.name.replace("_", " "): getattr(options.rtc, f.name) for f in fields(options.rtc)}
        guidance = ", ".join(f"{name} {value}" for name, value in rtc_options.items() if value is not None)
        notes = [f"{seeds.execute.iloc[0]} actions per decision at every delay. RTC: {guidance}."]
        names = ["success", "boundary_jump", "inner_jump"]
        text = table(seeds, ["setting", "nfe", "delay", "method"], names, notes)
        write_report(out, text, text, rows, failures)


if __name__ == "__main__":
    sys.exit(main())
