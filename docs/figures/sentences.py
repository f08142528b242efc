"""The sentences of pages whose numbers come from rows, as the rows say them.

The tests look for each in its page. A sentence that is not there has older numbers, or other words.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from leaderboard import SCRIPTED, pairs, standings, trials
from pages import own_best
from pandas import DataFrame
from results import (
    CHOICES,
    GROUPS,
    LENGTHS,
    LONG,
    SHORT,
    TEN,
    TWENTY_FIVE,
    WARM,
    all_lengths,
    outcomes_by_length,
)
from shared import CORRELATED, CVAE, GAUSSIAN, PAST, PREVIEW, read_cells, read_played


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


def pair(runs: Iterable[str], source: str, *nfes: int, noise: float = 1.0) -> str:
    """Return the episodes won and lost against the Gaussian source, over runs and NFE (9, 3 and 1)."""
    won = lost = 0
    for run in runs:
        for nfe in nfes or (9, 3, 1):
            both = [
                played(run, name, nfe, noise).set_index(["task", "seed"])["solved"].sort_index()
                for name in (source, GAUSSIAN)
            ]
            for outcomes, base in zip(*both, strict=True):
                won, lost = won + (outcomes > base).sum(), lost + (outcomes < base).sum()
    return f"{won} : {lost}"


def in_words(pair_of_counts: str) -> str:
    """Return ``a : b`` or ``a:b`` as ``a won, b lost``."""
    won, lost = pair_of_counts.split(":")
    return f"{won.strip()} won, {lost.strip()} lost"


def spaced(rates: str) -> str:
    """Return ``a/b/c`` as a sentence has it, ``a / b / c``."""
    return rates.replace("/", " / ")


def mean(runs: Iterable[str], source: str, nfe: int) -> float:
    """Return the mean success of a source over the tasks of some runs, in percent."""
    rows = read_cells(runs)
    return rows[(rows["source"] == source) & (rows["nfe"] == nfe)]["success"].mean()


def gain(runs: Iterable[str], source: str, nfe: int) -> float:
    """Return how many points a source is ahead of the Gaussian source, on the mean of some runs' tasks."""
    return mean(runs, source, nfe) - mean(runs, GAUSSIAN, nfe)


def at_best_noise(source: str, nfe: int) -> str:
    """Return episodes won and lost against the Gaussian source on human data, with each one's best noise."""
    rows, won, lost = trials(own_noise=False).query("nfe == @nfe"), 0, 0
    for _, part in rows.groupby("set"):
        solved = own_best(part)
        won += (solved[source] > solved[GAUSSIAN]).sum()
        lost += (solved[source] < solved[GAUSSIAN]).sum()
    return f"{won} : {lost}"


def against(counts: Mapping[str, int]) -> str:
    """Return episodes won and lost as ``a : b``."""
    return f"{counts['won']} : {counts['lost']}"


def sentences() -> dict[str, list[str]]:
    """Return the sentences of each page."""
    board = standings().set_index(["source", "nfe"])
    few = [gain(GROUPS[name], s, 1) for name in (TEN, TWENTY_FIVE) for s in (PAST, PREVIEW)]
    short = [-gain(SHORT, s, 1) for s in (PAST, PREVIEW)]
    long, better = (all_lengths(PAST, choose) for choose in CHOICES.values())
    lengths = read_cells((SHORT[-1], LONG[-1]), common_seeds=True).query("nfe == 1")
    transport = [
        whole(lengths[(lengths["run"] == runs[-1]) & (lengths["source"] == s)]["success"].mean())
        for runs in (SHORT, LONG)
        for s in (GAUSSIAN, PAST)
    ]
    loss = [100 * (1 - board.loc[s, 1]["mean"] / board.loc[s, 9]["mean"]) for s in (GAUSSIAN, *WARM)]
    pusht = {
        count: {s: solved(run, s, 9) for s in (GAUSSIAN, *WARM)}
        for count, run in ((50, "pusht_50"), (206, "pusht_206_45000"))
    }
    fifty = [whole(pusht[50][s]) for s in (PAST, CORRELATED, GAUSSIAN)]
    fifty_long = [whole(solved("pusht_50_80000", s, 9)) for s in (PAST, CORRELATED, GAUSSIAN)]
    noise = played("sigma_square_mh", PAST, 1).set_index("sigma")["success_rate"] * 100
    at_80000 = {s: solved("pusht_206_80000", s, 9) for s in (GAUSSIAN, *WARM)}
    half = {s: solved("pusht_206_80000", s, 9, 0.5) for s in (GAUSSIAN, PAST)}
    half_pair = pair(["pusht_206_80000"], PAST, 9, noise=0.5)
    half_short = whole(solved("pusht_206_45000", GAUSSIAN, 9, 0.5))
    mip = board.loc["mip", 2]
    joints = [solved("joint_targets_10000", s, 3) for s in (GAUSSIAN, *WARM)]
    fall = falls("door, 25 human", 3)
    best_mean = {s: whole(board.loc[s, 9]["best noise"]) for s in (GAUSSIAN, PAST)}
    (won, lost), mip_pair, mip_beside_past, past_once = (
        frame.loc[setting]
        for frame, setting in (
            (pairs(), (PAST, 9)),
            (pairs(), ("mip", 2)),
            (pairs(baseline=PAST), ("mip", 2)),
            (pairs(SCRIPTED), (PAST, 1)),
        )
    )
    learned_at_best = {n: at_best_noise(CVAE, n) for n in (9, 3, 1)}
    one_loss = {
        s: {n: whole(board.loc[f"{s},l1", n]["mean"]) for n in (9, 1)} for s in (GAUSSIAN, CORRELATED)
    }
    squared = {n: whole(board.loc[GAUSSIAN, n]["mean"]) for n in (9, 1)}
    gained = {n: against(pairs().loc[f"{GAUSSIAN},l1", n]) for n in (9, 1)}
    beside_one_loss = pairs(baseline=f"{GAUSSIAN},l1").loc[f"{CORRELATED},l1", 9]
    past_one_loss = whole(board.loc[f"{PAST},l1", 9]["mean"])
    learned = {nfe: whole(board.loc[CVAE, nfe]["mean"]) for nfe in (9, 1)}
    learned_pairs = pairs().loc[CVAE]
    trainings = pairs(by=("source", "nfe", "set", "seed")).loc[CVAE, 9]
    ahead, later = (trainings["won"] > trainings["lost"]).sum(), trainings.query("seed > 0").sum()
    return {
        "../README.md": [
            f"the Gaussian source solves {one_loss[GAUSSIAN][9]}%, WP-Past {past_one_loss} and WP-Past with "
            f"correlated noise {one_loss[CORRELATED][9]}",
            f"without a source, which solves {whole(mip['mean'])}%",
            f"the decoder of a CVAE, solves most, {learned[9]}% ({in_words(against(learned_pairs.loc[9]))})",
            f"solves {whole(board.loc[PAST, 9]['mean'])}% of the episodes and the Gaussian source "
            f"{whole(board.loc[GAUSSIAN, 9]['mean'])} ({won} won, {lost} lost)",
            f"({best_mean[PAST]} and {best_mean[GAUSSIAN]}%)",
            f"WP-Past and WP-Preview succeed {span(few)} points more often at one step",
            f"(WP-Past with 25: {in_words(pair(GROUPS[TWENTY_FIVE], PAST, 1))})",
            f"{span(short)} points less often at one step after 10,000 iterations",
            f"it solves {spaced(long[0])}% at nine, three",
            f"the Gaussian source {spaced(long[1])} ({in_words(long[2].split(', ')[0])} at nine)",
            f"{spaced(better[0])} and {spaced(better[1])}, within chance",
            f"{whole(half[PAST])}% with half of the noise at nine steps, and {whole(half[GAUSSIAN])} "
            f"({in_words(half_pair)}), or {half_short} after shorter training",
        ],
        "which_source.md": [
            f"after 80,000, two seeds, {fifty_long[0]} and {fifty_long[1]} against {fifty_long[2]}",
            f"{span(joints)}% at three steps",
            f"WP-Past and WP-Preview succeed {span(short)} points less often",
            f"the Gaussian source falls from {fall[GAUSSIAN]}% at three steps, WP-Past from {fall[PAST]}",
            f"WP-Past and WP-Preview succeed {span(few)} points more often",
            f"the Gaussian source solves {whole(pusht[206][GAUSSIAN])}% at nine steps, "
            f"warm sources {span([pusht[206][s] for s in WARM])}%",
            f"{whole(at_80000[GAUSSIAN])}%, and {span([at_80000[s] for s in WARM])} (with half the "
            f"noise WP-Past has {whole(half[PAST])}, the Gaussian source {whole(half[GAUSSIAN])})",
            f"lead with {fifty[0]} and {fifty[1]}%, against the Gaussian source's {fifty[2]}",
            f"the decoder of a CVAE solves most ({learned[9]}% at nine steps",
            f"the Gaussian source then solves {transport[2]}% at one step in place of {transport[0]}, "
            f"and WP-Past {transport[3]} in place of {transport[1]}",
            f"at one step sources solve {span(loss)}% fewer episodes than at nine",
        ],
        "leaderboard.md": [
            f"the decoder of a CVAE solves {learned[9]}% at nine steps, the Gaussian source {squared[9]} "
            f"({one_loss[GAUSSIAN][9]} with an L1 loss), WP-Past {whole(board.loc[PAST, 9]['mean'])} "
            f"and MIP {whole(mip['mean'])}",
            f"at nine steps ({against(learned_pairs.loc[9])}, in {ahead} of {len(trainings)} trainings) "
            f"and at one ({against(learned_pairs.loc[1])}), also with each one's best noise "
            f"({learned_at_best[9]}, {learned_at_best[3]} and {learned_at_best[1]} at nine, three and one), "
            f"and level with MIP ({against(pairs(baseline='mip').loc[CVAE, 9])})",
            f"the first had led, and lead too ({against(later)})",
            f"from {squared[1]} to {one_loss[GAUSSIAN][1]}% at one step "
            f"({gained[1]}) and to {one_loss[GAUSSIAN][9]} at nine ({gained[9]})",
            f"correlated noise solves {one_loss[CORRELATED][9]}% at nine ({against(beside_one_loss)})",
            f"ahead of the Gaussian source at nine steps ({against(mip_pair)}), "
            f"and of WP-Past within chance ({against(mip_beside_past)})",
            f"ahead of the Gaussian source ({against(past_once)}, two-sided",
            f"WP-Past solves {best_mean[PAST]}% and the Gaussian source {best_mean[GAUSSIAN]} "
            f"({at_best_noise(PAST, 9)})",
        ],
        "results.md": [
            f"on transport at nine ({pair([LONG[-1]], PREVIEW, 9)})",
        ],
        "faq.md": [
            f"({whole(noise[0.1])}% at 0.1, {whole(noise[0])}% at 0), and 1 solved more: {whole(noise[1])}%, "
            f"against {whole(noise[0.5])} at 0.5"
        ],
    }
