"""The sentences of pages whose numbers come from rows, as the rows say them.

`tests/test_docs.py` looks for each in its page. A sentence that is not there has older numbers, or other
words.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial

import numpy as np
from leaderboard import LEARNED_L1, ONE_STEP, SCRIPTED, beside_source, paper_gain, standings
from pandas import DataFrame
from results import (
    CHOICES,
    GROUPS,
    LENGTHS,
    LIFT_AGENTS,
    LONG,
    SHORT,
    TEN,
    TWENTY_FIVE,
    WARM,
    all_lengths,
    outcomes_by_length,
)
from shared import CORRELATED, CVAE, GAUSSIAN, L1, PAST, PREVIEW, SOURCES, read_arms, read_cells, read_played


def whole(number: float) -> int:
    """Return the number as tables round it."""
    return int(f"{number + 1e-6:.0f}")


def span(numbers: list[float]) -> str:
    """Return ``lowest to highest``."""
    rounded = sorted(map(whole, numbers))
    return f"{rounded[0]} to {rounded[-1]}"


def played(run: str, source: str, nfe: int, noise: float = 1.0) -> DataFrame:
    """Return the rows of a source in a run."""
    rows = read_played(run)
    return rows[(rows["source"] == source) & (rows["nfe"] == nfe) & (rows["noise"] == noise)]


def solved(run: str, source: str, nfe: int, noise: float = 1.0) -> float:
    """Return the success of a source in percent, over all seeds."""
    return 100 * np.concatenate(list(played(run, source, nfe, noise)["solved"])).mean()


def falls(demonstrations: str, nfe: int) -> dict[str, str]:
    """Return the success of the Gaussian source and WP-Past after short and long training, as ``a to b``."""
    outcomes = outcomes_by_length(LENGTHS[demonstrations], PAST, nfe)
    return {s: " to ".join(str(whole(100 * solved.mean())) for solved in of) for s, of in outcomes.items()}


def spaced(rates: Iterable[float]) -> str:
    """Return three rates as a sentence has them, ``a / b / c``."""
    return " / ".join(str(whole(rate)) for rate in rates)


def mean(runs: Iterable[str], source: str, nfe: int) -> float:
    """Return the mean success of a source over the tasks of some runs, in percent."""
    rows = read_cells(runs)
    return rows[(rows["source"] == source) & (rows["nfe"] == nfe)]["success"].mean()


def gain(runs: Iterable[str], source: str, nfe: int) -> float:
    """Return how many points a source is ahead of the Gaussian source, on the mean of some runs' tasks."""
    return mean(runs, source, nfe) - mean(runs, GAUSSIAN, nfe)


def improved(arm: str) -> str:
    """Return the mean success of the policies of agents on lift, and of the agents in the end."""
    rates = read_arms(LIFT_AGENTS).query("arm == @arm").groupby("evaluated")["success_rate"].mean()
    return f"{whole(100 * rates.iloc[0])}% to {whole(100 * rates.iloc[-1])}%"


def sentences() -> dict[str, list[str]]:
    """Return the sentences of each page."""
    board = standings().set_index(["source", "nfe"])
    rates = {setting: whole(mean) for setting, mean in board["mean"].items()}
    few = [gain(GROUPS[name], s, 1) for name in (TEN, TWENTY_FIVE) for s in (PAST, PREVIEW)]
    short = [-gain(SHORT, s, 1) for s in (PAST, PREVIEW)]
    long, correlated_long = (all_lengths(source, CHOICES["long training"]) for source in (PAST, CORRELATED))
    long_rates, default_rates = (
        [spaced(c.rates[k] for c in of) for k in (0, 1)] for of in (long, correlated_long)
    )
    default_chances = ", ".join(comparison.chance for comparison in correlated_long)
    lengths = read_cells((SHORT[-1], LONG[-1]), common_seeds=True).query("nfe == 1")
    transport = [
        whole(lengths[(lengths["run"] == runs[-1]) & (lengths["source"] == s)]["success"].mean())
        for runs in (SHORT, LONG)
        for s in (GAUSSIAN, PAST)
    ]
    fewer, fewer_l1 = (
        [100 * (1 - board.loc[s, 1]["mean"] / board.loc[s, 9]["mean"]) for s in sources]
        for sources in ((GAUSSIAN, *WARM), [f"{s}{L1}" for s in (GAUSSIAN, PAST, CORRELATED)])
    )
    pusht = {
        count: {s: solved(run, s, 9) for s in (GAUSSIAN, *WARM)}
        for count, run in ((50, "pusht_50"), (206, "pusht_206_45000"))
    }
    fifty = [whole(pusht[50][s]) for s in (PAST, CORRELATED, GAUSSIAN)]
    noise = played("sigma_square_mh", PAST, 1).set_index("sigma")["success_rate"] * 100
    past, preview_once, mip = (beside_source(*s) for s in ((PAST, 9), (PREVIEW, 1), ("mip", 2)))
    cvae_l1 = partial(beside_source, f"{CVAE}{L1}", baseline=f"{GAUSSIAN}{L1}", sets=LEARNED_L1)
    with_l1, with_l1_at_best = ({n: cvae_l1(n, own_noise=own) for n in (9, 1)} for own in (True, False))
    at_best = {n: beside_source(CVAE, n, own_noise=False) for n in (9, 3, 1)}
    past_once = beside_source(PAST, 1, sets=SCRIPTED)
    one_step = {n: beside_source(PAST, n, sets=ONE_STEP) for n in (9, 1)}
    once_at_best = beside_source(PAST, 1, sets=ONE_STEP, own_noise=False)
    seen_once = {n: f"{whole(of.rates[0])}% against {whole(of.rates[1])}%" for n, of in one_step.items()}
    learned = {n: beside_source(CVAE, n) for n in (9, 1)}
    learned_mip = {n: beside_source(CVAE, n, "mip") for n in (9, 1)}
    absolute = beside_source(f"{GAUSSIAN}{L1}", 9)
    agents = (
        f"WP-Past's agent rises from {improved(f'DSRL-NA, {SOURCES[PAST][0]}')}, "
        f"the Gaussian source's from {improved(f'DSRL-NA, {SOURCES[GAUSSIAN][0]}')}"
    )
    paper = {s: " / ".join(f"{paper_gain(s, nfe):.1f}" for nfe in (9, 3, 1)) for s in (PAST, PREVIEW)}
    return {
        "../README.md": [
            f"with WP-Past**: {rates[PAST, 9]}% against {rates[GAUSSIAN, 9]}% at NFE 9 "
            f"({past.chance}), and, if policies see one observation in place of two, {seen_once[1]} at NFE 1 "
            f"({one_step[1].chance})",
            f"{span(few)} points more with WP-Past and WP-Preview ({past_once.chance} for the largest gain)",
            f"{span(short)} points less at NFE 1 after short training",
            f"with WP-Past**: {long_rates[0]}% against {long_rates[1]}%",
            f"after 80,000 iterations**: {default_rates[0]}% against {default_rates[1]}% ({default_chances})",
            f"(the decoder of a CVAE) solves {rates[CVAE, 9]}% of episodes at NFE 9 ({learned[9].chance} "
            "against the Gaussian source)",
            f"MIP (a regression) {rates['mip', 2]}% at NFE 2 ({mip.chance})",
            f"with an L1 loss {rates[f'{GAUSSIAN}{L1}', 9]}% at NFE 9 ({absolute.chance})",
            agents,
            f"{paper[PAST]} points more with WP-Past, and {paper[PREVIEW]} with WP-Preview",
        ],
        "which_source.md": [
            f"WP-Past and WP-Preview score {span(few)} points higher at NFE 1 on average, which may be "
            f"due to chance (WP-Past with 25: {past_once.chance})",
            f"WP-Past solves {fifty[0]}% of episodes, correlated noise {fifty[1]}%, "
            f"and the Gaussian source {fifty[2]}%",
            f"WP-Past and WP-Preview score {span(short)} points lower at NFE 1",
            f"the Gaussian source then solves {transport[2]}% of episodes at NFE 1 "
            f"(up from {transport[0]}%), and WP-Past {transport[3]}% (up from {transport[1]}%)",
            f"at NFE 1 policies solve {span(fewer)}% fewer episodes than at NFE 9 on average (leaderboard), "
            f"or {span(fewer_l1)}% with an L1 loss",
        ],
        "leaderboard.md": [
            f"the decoder of a CVAE solves {rates[CVAE, 9]}% of episodes at NFE 9 and the Gaussian source "
            f"{rates[GAUSSIAN, 9]}%. WP-Past solves {rates[PAST, 9]}%, and MIP {rates['mip', 2]}% at NFE 2",
            f"WP-Past scores {past.gain:.0f} points higher at NFE 9 ({past.in_trainings}, {past.chance})",
            f"It solves {whole(one_step[1].rates[0])}% of episodes and the Gaussian source "
            f"{whole(one_step[1].rates[1])}% ({one_step[1].in_trainings}, {one_step[1].chance}); at NFE 9 "
            "its lead may be due to chance",
            f"WP-Preview solves fewer episodes at NFE 1 ({preview_once.in_trainings}, {preview_once.chance})",
            f"With each source at its best noise it leads at NFE 3 and 1 ({at_best[3].chance} each), "
            f"but not clearly at NFE 9 ({at_best[9].chance})",
            f"leads at NFE 9 ({whole(with_l1[9].rates[0])}% against {whole(with_l1[9].rates[1])}%, "
            f"{with_l1[9].chance}), but not with each at its best noise ({with_l1_at_best[9].chance})",
            f"may be due to chance at NFE 9 ({learned_mip[9].chance}) and NFE 1 ({learned_mip[1].chance})",
        ],
        "results.md": [
            f"With 25, WP-Past is {past_once.gain:.0f} points ahead ({past_once.in_trainings}, "
            f"{past_once.chance})",
        ],
        "notes/evidence.md": [
            f"it solves {seen_once[1]} ({one_step[1].in_trainings}, {one_step[1].chance})",
            f"at NFE 9 {seen_once[9]} (",
            f"{whole(once_at_best.rates[0])}% against {whole(once_at_best.rates[1])}% "
            f"({once_at_best.in_trainings}, {once_at_best.chance})",
            *(
                f"at NFE {nfe} it solves {whole(of.rates[0])}% against {whole(of.rates[1])}% "
                f"({of.in_trainings}, {of.chance})"
                for of_all in (with_l1, with_l1_at_best)
                for nfe, of in of_all.items()
            ),
        ],
        "prior_space_rl.md": [agents],
        "faq.md": [
            f"({whole(noise[0.1])}% at 0.1, {whole(noise[0])}% at 0), "
            f"and `sigma=1` solved more: {whole(noise[1])}%, against {whole(noise[0.5])}% at 0.5"
        ],
    }
