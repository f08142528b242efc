"""The sentences of pages whose numbers come from rows, as the rows say them.

The tests look for each in its page. A sentence that is not there has older numbers, or other words.
"""

from __future__ import annotations

import numpy as np
from leaderboard import DOOR, standings
from pages import own_best
from pandas import DataFrame
from shared import CORRELATED, GAUSSIAN, PAST, PREVIEW, read, read_played

WARM = (PAST, PREVIEW, CORRELATED)
TEN, TWENTY_FIVE = "10: square, can and stack", "25: square, can and stack"
ONE_ARM, EIGHT = "150 or 300: six settings of one arm", "150 or 300: all eight settings"


def whole(number: float) -> int:
    """Return the number as tables round it."""
    return int(f"{number + 1e-6:.0f}")


def common(numbers: list[float]) -> int:
    """Return the one value that all numbers round to."""
    (value,) = {whole(number) for number in numbers}
    return value


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


def two_seeds_of(run: str, source: str) -> float:
    """Return the success of the first two seeds at three steps in percent."""
    rows = played(run, source, 3)
    return 100 * rows[rows["seed"] < 2]["success_rate"].mean()


def pair(run: str, source: str) -> str:
    """Return the episodes won and lost against the Gaussian source, over all NFE."""
    won = lost = 0
    for nfe in 9, 3, 1:
        both = [
            played(run, name, nfe).set_index("seed")["solved"].sort_index() for name in (source, GAUSSIAN)
        ]
        for outcomes, base in zip(*both, strict=True):
            won, lost = won + (outcomes > base).sum(), lost + (outcomes < base).sum()
    return f"{won} : {lost}"


def recorded(file: str, source: str, nfe: int, **chosen: object) -> float:
    """Return the mean success of a source over those rows of a CSV file that have the chosen values."""
    rows = read(file)
    for column, value in {"source": source, "nfe": nfe, **chosen}.items():
        rows = rows[rows[column] == value]
    return rows["success"].mean()


def gain(file: str, source: str, nfe: int, **chosen: object) -> float:
    """Return how many points a source is ahead of the Gaussian source in these rows."""
    return recorded(file, source, nfe, **chosen) - recorded(file, GAUSSIAN, nfe, **chosen)


def sentences() -> dict[str, list[str]]:
    """Return the sentences of each page."""
    board = standings().set_index(["source", "nfe"])
    few = [gain("means", s, 1, setting=name) for name in (TEN, TWENTY_FIVE) for s in (PAST, PREVIEW)]
    longer = {
        nfe: [solved("square_mh_80000", s, nfe) - solved("square_mh_80000", GAUSSIAN, nfe) for s in WARM]
        for nfe in (9, 1)
    }
    nine, one = ({s: whole(solved("square_mh_80000", s, nfe)) for s in (GAUSSIAN, *WARM)} for nfe in (9, 1))
    door = {nfe: {s: whole(solved("door_20000", s, nfe)) for s in (GAUSSIAN, *WARM)} for nfe in (9, 3, 1)}
    rows = read_played("door_20000")
    best = {
        nfe: {s: whole(100 * outcomes.mean()) for s, outcomes in own_best(rows[rows["nfe"] == nfe]).items()}
        for nfe in (9, 1)
    }
    loss = [100 * (1 - board.loc[s, 1]["mean"] / board.loc[s, 9]["mean"]) for s in (GAUSSIAN, *WARM)]
    pusht = {
        count: {s: solved(run, s, 9) for s in (GAUSSIAN, *WARM)}
        for count, run in ((50, "pusht_50"), (206, "pusht_206_45000"))
    }
    fifty = [whole(pusht[50][s]) for s in (PAST, CORRELATED, GAUSSIAN)]
    noise = played("sigma_square_mh", PAST, 1).set_index("sigma")["success_rate"] * 100
    at_80000 = {s: solved("pusht_206_80000", s, 9) for s in (GAUSSIAN, *WARM)}
    mip = board.loc["mip", 2]
    joints = [solved("joint_targets_10000", s, 3) for s in (GAUSSIAN, *WARM)]
    six = [-gain("one_step", s, 1, style="mh") for s in (PAST, PREVIEW)]
    ten = {
        nfe: [recorded("steps", s, nfe, demonstrations=10) for s in (GAUSSIAN, PAST, PREVIEW)]
        for nfe in (9, 1)
    }
    fall = {
        s: f"{whole(two_seeds_of('door_20000', s))} to {whole(two_seeds_of('door_80000', s))}"
        for s in (GAUSSIAN, PAST)
    }
    three, single = (recorded("steps", GAUSSIAN, nfe, demonstrations=25) for nfe in (3, 1))
    correlated = [gain("means", CORRELATED, 1, setting=name) for name in (ONE_ARM, EIGHT)]
    behind = [
        whole(-gain("steps", PREVIEW, 9, task="square", style=style, demonstrations=count))
        for style, count in (("ph", 150), ("mh", 300))
    ]
    return {
        "../README.md": [
            f"({whole(mip['mean'])}% on average)",
            f"WP-Past and WP-Preview succeed {span(few)} points more often",
            f"succeeds {whole(correlated[1])} points more often",
            f"succeed {span(longer[9])} points more often at nine steps and "
            f"{span([-n for n in longer[1]])} less often at one",
        ],
        "which_source.md": [
            f"{span(joints)}% at three steps",
            f"WP-Past and WP-Preview succeed {span(six)} points less often",
            f"{whole(three - single)} points more often at three",
            f"the Gaussian source falls from {fall[GAUSSIAN]}% at three steps, WP-Past from {fall[PAST]}",
            f"solve {span(ten[9])}% at nine steps, and {span(ten[1])}% at one",
            f"{span([-n for n in longer[1]])} less often at one",
            "at three steps "
            f"the Gaussian source succeeds in {door[3][GAUSSIAN]}% of the episodes "
            f"and correlated noise in {door[3][CORRELATED]}%",
            f"WP-Past and WP-Preview succeed {span(few)} points more often",
            f"the Gaussian source solves {whole(pusht[206][GAUSSIAN])}% at nine steps, "
            f"and warm sources {span([pusht[206][s] for s in WARM])}%",
            f"{whole(at_80000[GAUSSIAN])}%, and {span([at_80000[s] for s in WARM])} (one seed)",
            f"lead with {fifty[0]} and {fifty[1]}%, against the Gaussian source's {fifty[2]}",
            f"solves {whole(mip['Push-T, 206'])}% with 206",
            f"all warm sources succeed {span(longer[9])} points more",
            f"at one step sources solve {span(loss)}% fewer episodes than at nine",
        ],
        "leaderboard.md": [
            f"({best[9][GAUSSIAN]}%; WP-Past and WP-Preview {common([best[9][PAST], best[9][PREVIEW]])})",
            f"correlated noise solves {best[1][CORRELATED]}% and the Gaussian source {best[1][GAUSSIAN]}",
            f"({whole(mip[DOOR])} against {max(n for at in door.values() for n in at.values())}%)",
            f"it solves {whole(solved('pusht_50', 'mip-past', 2, 0))}%, and MIP {whole(mip['Push-T, 50'])}",
            f"over all steps WP-Past {pair('door_80000', PAST)})",
            f"with 206 ({pair('pusht_206_80000', PAST)}, one seed)",
        ],
        "results.md": [
            f"on average succeeds {span(correlated)} points more often",
            f"by {behind[0]} points with one operator, by {behind[1]} with six",
            f"at nine the Gaussian source solves {nine[GAUSSIAN]}%, WP-Past {nine[PAST]}, "
            f"WP-Preview and correlated noise {common([nine[PREVIEW], nine[CORRELATED]])}; at one step "
            f"they solve {one[GAUSSIAN]}, {one[PAST]}, {one[PREVIEW]} and {one[CORRELATED]}",
        ],
        "faq.md": [f"({whole(noise[0.1])}% at 0.1, {whole(noise[0])}% at 0)"],
    }
