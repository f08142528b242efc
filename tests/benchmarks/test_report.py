"""Tables of the benchmarks: which numbers end up in which cell."""

from __future__ import annotations

import itertools
import json
import math
import re

import numpy as np
import pandas as pd
import pytest
from scipy import integrate, stats

pytest.importorskip("tyro")

import report

from warmprior.io.script import PartialFailure

FACTS = {
    "task": "square",
    "data": "ph",
    "prior": "gaussian",
    "options": "",
    "sigma": 1.0,
    "chunk": 8,
    "seed": 0,
    "iterations": 100,
    "checkpoint": 100,
    "nfe": 1,
}
SIGMA = {"past": 0.5}


def row(won=5, episodes=10, **more):
    """An evaluation that solves the first episodes; what is not named is that of FACTS."""
    outcomes = won if isinstance(won, str) else "1" * won + "0" * (episodes - won)
    k, n = outcomes.count("1"), len(outcomes)
    counts = {"successes": k, "episodes": n, "success_rate": k / n, "outcomes": outcomes}
    more.setdefault("sigma", SIGMA.get(more.get("prior"), 1.0))
    made = FACTS | counts | more
    of_a_policy = ("task", "data", "obs", "prior", "options", "sigma", "chunk", "seed", "iterations")
    return {"policy": "-".join(str(made.get(name)) for name in of_a_policy)} | made


def compared():
    """Three seeds, two checkpoints; WP-Past is better by 30 points, and less spread than that."""
    wins = {"gaussian": (4, 5, 6), "past": (7, 8, 9), "preview": (5, 5, 5)}
    return pd.DataFrame(
        row(k, prior=prior, seed=seed, checkpoint=checkpoint)
        for prior, seeds in wins.items()
        for seed, solved in enumerate(seeds)
        for checkpoint, k in ((50, 0), (100, solved))
    )


def table(rows, top_k=1, **options):
    rows = rows if isinstance(rows, pd.DataFrame) else pd.DataFrame(rows)
    return report.success_report(report.summary(rows, top_k), top_k, **options)


def cells_of(text, start):
    """The cells of the line of a table that starts so."""
    (line,) = (line for line in text.splitlines() if line.startswith(f"| {start}"))
    return line.strip("| ").split(" | ")[1:]


def lines_of(text):
    """The lines of the last table of a text, by column."""
    found = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]
    start = max(i for i, line in enumerate(found) if line[0] == "---") - 1
    return [dict(zip(found[start], line, strict=True)) for line in found[start + 2 :]]


def test_rows_are_read_as_they_were_written(tmp_path):
    path = tmp_path / "results.jsonl"
    path.write_text('{"outcomes": "0011", "kappa": null}\n{"outcomes": "01"}\n')
    rows = report.read_rows(path)
    assert list(rows["outcomes"]) == ["0011", "01"] and rows["kappa"].isna().all()
    path.write_text("".join(json.dumps(one) + "\n" for one in compared().to_dict("records")))
    assert table(report.read_rows(path)) == table(compared())


@pytest.mark.parametrize("line", ['{"seed": 1', "[1]", "", "3"])
def test_a_damaged_line_is_named_with_what_to_do(tmp_path, line):
    path = tmp_path / "results.jsonl"
    path.write_text(f'{{"seed": 0}}\n{line}\n')
    with pytest.raises(ValueError, match=r"results.jsonl, line 2 .*remove that line.*--resume"):
        report.read_rows(path)


def test_methods_and_problems_have_names_that_differ():
    rows = pd.DataFrame(
        [
            row(),
            row(guidance="rtc", task="tool_hang"),
            row(prior="past", options="correlation=0.5", actions="absolute", chunk=4),
            row(prior="past", sigma=1.0, guidance="rtc", obs="image"),
        ]
    )
    assert list(report.labelled(rows, "chunk")["method"]) == [
        "Base",
        "RTC",
        "WP-Past, correlation=0.5, sigma 0.5",
        "RTC + WP-Past, sigma 1",
    ]
    named = report.labelled(rows)
    assert named["method"][0] == "Base, H 8" and named["method"][2].endswith("sigma 0.5, H 4")
    assert list(named["problem"]) == [
        "Square-PH",
        "Tool-Hang-PH",
        "Square-PH, absolute actions",
        "Square-PH, image observations",
    ]


def test_a_summary_is_what_scipy_and_counting_say():
    generator = np.random.default_rng(0)
    episodes = {
        key: "".join(generator.choice(["0", "1"], 6, p=[1 - p, p]))
        for (prior, p), *rest in itertools.product(
            (("gaussian", 0.4), ("past", 0.7)), ("ph", "mh"), range(3), (30, 60, 100), (9, 1)
        )
        for key in [(prior, *rest)]
    }
    names = ("prior", "data", "seed", "checkpoint", "nfe")
    rows = [row(text, **dict(zip(names, key, strict=True))) for key, text in episodes.items()]
    found = report.summary(pd.DataFrame(rows), 2).set_index(["data", "prior", "nfe"])
    assert len(found) == 8
    for (data, prior, nfe), record in found.iterrows():

        def rates(prior, data=data, nfe=nfe):
            seeds = [
                sorted(episodes[prior, data, s, c, nfe].count("1") / 6 for c in (30, 60, 100))
                for s in range(3)
            ]
            return [(seed[1] + seed[2]) / 2 for seed in seeds]

        last = [episodes[prior, data, s, 100, nfe] for s in range(3)]
        base = [episodes["gaussian", data, s, 100, nfe] for s in range(3)]
        k, b = (sum(text.count("1") for text in texts) for texts in (last, base))
        assert record["success"] == pytest.approx(np.mean(rates(prior)))
        assert record["success_std"] == pytest.approx(np.std(rates(prior), ddof=1))
        assert (record["seeds"], record["episodes"], record["successes"]) == (3, 18, k)
        ends = stats.beta(k + 1, 19 - k).ppf([0.025, 0.975])
        assert (record["low"], record["high"]) == pytest.approx(tuple(ends))
        if prior == "gaussian":
            assert record[["gain", "better", "won", "lost", "paired"]].isna().all()
            continue
        gain = np.mean(rates("past")) - np.mean(rates("gaussian"))
        spread = sum(np.std(rates(p), ddof=1) for p in ("past", "gaussian"))
        assert record["gain"] == pytest.approx(gain) and record["one_sigma"] == (gain > spread)
        mine, theirs = stats.beta(k + 1, 19 - k), stats.beta(b + 1, 19 - b)
        better = integrate.quad(lambda p, a=mine, b=theirs: a.pdf(p) * b.cdf(p), 0, 1)[0]
        assert record["better"] == pytest.approx(better)
        pairs = list(zip("".join(last), "".join(base), strict=True))
        won, lost = (sum(pair == (a, b) for pair in pairs) for a, b in (("1", "0"), ("0", "1")))
        assert (record["won"], record["lost"]) == (won, lost)
        assert record["paired"] == pytest.approx(stats.beta(won + 1, lost + 1).sf(0.5))


def test_measures_are_means_of_the_last_checkpoints_beside_the_baselines():
    measured = [
        {"kappa": 2.0, "boundary_jump": 0.6, "inner_jump": 0.2, "memory_gain": None},
        {"kappa": 1.0, "boundary_jump": 0.5, "inner_jump": None, "memory_gain": 0.1},
        {"kappa": 3.0, "boundary_jump": 0.7, "inner_jump": 0.3, "memory_gain": 0.3},
    ]
    rows = [
        row(prior="regression", checkpoint=50, kappa=99.0),
        row(prior="regression", **measured[0]),
    ]
    rows += [row(prior="past", nfe=9, seed=s, **m) for s, m in enumerate(measured[1:])]
    base, past = report.summary(pd.DataFrame(rows), 1).to_dict("records")
    assert base["kappa_ratio"] == 1.0 and math.isnan(base["memory_gain"])
    # The flow is compared although the baseline has no NFE 9; success is not.
    assert past["kappa_ratio"] == 1.0 and math.isnan(past["gain"])
    assert past["memory_gain"] == pytest.approx(0.2)
    assert past["memory_gain_std"] == pytest.approx(math.sqrt(0.02))
    assert base["boundary_jump"] == pytest.approx(0.6) == past["boundary_jump"]
    assert past["inner_jump"] == pytest.approx(0.3)  # of the seed that has one


def test_the_papers_numbers_stand_beside_the_same_experiment_alone():
    same = [row(prior="past", data="mh"), row(prior="past", data="mh", obs="image")]
    same.append(row(prior="past", data="mh", sigma=0.0))  # of the ablation
    others = [
        row(prior="past", data="mh", **more)
        for more in ({"sigma": 1.0}, {"options": "correlation=0.5"}, {"chunk": 4}, {"delay": 0})
    ]
    others += [row(prior="past", data="mh", actions="absolute"), row(prior="past", task="lift")]
    found = [report.summary(pd.DataFrame([one]), 1).iloc[0] for one in (*same, *others)]
    values = [one["paper"] for one in found]
    assert values[:3] == pytest.approx([0.701, 0.776, 0.05]) and np.isnan(values[3:]).all()
    assert found[0]["paper_gain"] == pytest.approx(0.701 - 0.659)  # Table 1: Base has 65.9


def test_the_report_has_the_layout_of_table_1():
    text = table(compared(), source="scripted", notes=["A note."])
    assert text.startswith("| Success rate (%) | NFE 1: Base | NFE 1: WP-Past | NFE 1: WP-Preview |")
    assert cells_of(text, "Square-PH, measured (scr") == [
        "50.0",
        "**80.0** (+30.0*)",
        "50.0 (+0.0)",
    ]
    assert cells_of(text, "Square-PH, paper") == ["83.6", "86.6", "87.3"]
    counts = [(line["won"], line["lost"], line["paired"]) for line in lines_of(text)]
    assert counts == [("-", "-", "-"), ("9", "0", "1.00"), ("1", "1", "0.50")]
    assert "3 seeds with 10 episodes each, best 1 of 2 checkpoints per seed" in text
    assert "gains within a row" in text and "- A note.\n" in text
    assert "source_leak" not in text and "memory_gain" not in text  # nobody measured them
    assert "gains within a row" not in table(compared(), source="official")


def test_gains_are_over_the_first_method_of_the_same_nfe_and_problem():
    wins = (("regression", {1: 2}), ("gaussian", {9: 5, 1: 4}), ("past", {9: 7, 1: 9}))
    rows = [row(k, prior=p, nfe=nfe) for p, by_nfe in wins for nfe, k in by_nfe.items()]
    rows += [row(6, prior=p, obs="image") for p in ("regression", "past")]
    text = table(rows)
    line = ["50.0", "**70.0**", "20.0", "40.0 (+20.0)", "**90.0** (+70.0)"]
    assert cells_of(text, "Square-PH, measured") == line
    images = cells_of(text, "Square-PH, image observations, measured")
    assert images == ["-", "-", "**60.0**", "-", "**60.0** (+0.0)"]


def test_leaks_are_marked_above_their_bound_and_no_zero_has_a_minus():
    leaks = {"source_leak": 0.3, "inner_step_ratio": 1.5, "memory_gain": -0.0001}
    rows = [row(46, 50), row(45, 50, seed=1), row(45, 50, prior="past", **leaks)]
    text = table([*rows, row(46, 50, prior="past", seed=1, **leaks)])
    found = [[line[name] for name in leaks] for line in lines_of(text)]
    assert found == [["-"] * 3, ["0.30 ± 0.00", "1.50 ± 0.00 (!)", "0.000 ± 0.000"]]
    assert cells_of(text, "Square-PH, measured") == ["**91.0**", "**91.0** (+0.0)"]


@pytest.mark.parametrize("methods, nfes, tasks", [(1, 1, 1), (3, 3, 2), (15, 9, 2)])
def test_the_terminal_table_fits_and_says_first_what_came_out(methods, nfes, tasks):
    options = [f"correlation=0.{k},a_long_name_of_an_option_beyond_the_width=1" for k in range(methods - 1)]
    rows = [
        row(
            4 + (o != ""),
            prior="past" if o else "gaussian",
            options=o,
            nfe=nfe + 1,
            task=f"task{t}",
        )
        for o in ("", *options)
        for nfe in range(nfes)
        for t in range(tasks)
    ]
    text = report.terminal_table(report.summary(pd.DataFrame(rows), 1), 1)
    assert max(map(len, text.splitlines())) <= 120
    lines = text.splitlines()
    assert lines[0].startswith(f"{methods} method") and lines[3] == ""
    assert text.count("**50.0** (+10.0)") == tasks * nfes * (methods - 1)


def test_the_first_lines_name_the_best_methods_and_how_sure_that_is():
    rows = [row(k, prior=p, nfe=9) for p, k in (("gaussian", 6), ("past", 4), ("preview", 5))]
    lines = report.terminal_table(
        report.summary(pd.concat([compared(), pd.DataFrame(rows)], ignore_index=True), 1), 1
    )
    first, best, sure, *_ = lines.splitlines()
    assert first == (
        "3 methods on Square-PH: H = 8, 3 seeds with 10 episodes each, best 1 of 2 checkpoints per seed."
    )
    assert best == "Best success: Base 60.0% at NFE 9; WP-Past 80.0% at NFE 1."
    chances = [
        (np.random.beta(k + 1, n - k + 1, 200_000) > np.random.beta(b + 1, n - b + 1, 200_000)).mean()
        for k, b, n in ((5, 6, 10), (24, 15, 30))  # of the last checkpoints of all seeds
    ]
    said = re.fullmatch(
        r"Gain over Base and its probability: WP-Preview -10\.0%, (\S+) at NFE 9; "
        r"WP-Past \+30\.0%, (\S+) at NFE 1\.",
        sure,
    )
    assert [float(chance) for chance in said.groups()] == pytest.approx(chances, abs=0.01)


def test_a_report_is_written_before_what_is_missing_is_an_error(tmp_path, capsys):
    summary = report.summary(compared(), 1)
    with pytest.raises(PartialFailure, match=r"1 failed.*: past, seed 1: no memory"):
        report.write_report(tmp_path, "short", "# full\n", summary, ["past, seed 1: no memory"])
    text = (tmp_path / "report.md").read_text()
    assert text.startswith("# full\n\nMissing:\n\n- past, seed 1: no memory\n\nColumns")
    assert "- `won`: episodes that this method solves" in text
    written = pd.read_csv(tmp_path / "results.csv")
    assert list(written["success"]) == pytest.approx([0.5, 0.8, 0.5])
    shown = capsys.readouterr().out
    assert "short\n" in shown and "no memory" in shown and str(tmp_path) in shown
    report.write_report(tmp_path, "short", "full", summary)
    assert "Missing" not in (tmp_path / "report.md").read_text()


def curved(prior="gaussian", mean="training", seed=0, **more):
    """A row of curvature.jsonl."""
    facts = {"policy": prior, "prior": prior, "options": "", "sigma": SIGMA.get(prior, 1.0), "chunk": 8}
    names = ("ratio", "ratio_executed", "ratio_relative", "ratio_one_step")
    ends = {name + end: 1.0 for name in names for end in ("", "_low", "_high")}
    facts |= {"seed": seed, "mean": mean, "observations": 1000, "bound_executed": 8.0}
    return facts | ends | more


def test_a_table_has_the_mean_and_deviation_of_every_group_in_the_order_of_the_rows():
    rows = [row(nfe=9, switch_rate=0.5, collision_rate=0.25), row(nfe=9, seed=1, collision_rate=0.35)]
    rows = report.labelled(pd.DataFrame([*rows, row(switch_rate=0.5, collision_rate=0.1)]))
    names = ["success_rate", "switch_rate", "collision_rate", "jerk"]
    nine, one = lines_of(report.table(rows, ["method", "nfe"], names, ["A note."]))
    assert list(nine) == ["method", "nfe", *names[:3]]  # nobody has a jerk
    assert list(nine.values()) == [
        *("Base", "9", "50.0% ± 0.0%", "0.500 (1 not finite)", "0.300 ± 0.071")  # 0.1 / sqrt(2)
    ]
    assert list(one.values()) == ["Base", "1", "50.0%", "0.500", "0.100"]
    with pytest.raises(KeyError, match="no column is called 'nonsense'"):
        report.table(rows.assign(nonsense=1.0), ["method"], ["nonsense"])


def test_a_table_of_ratios_has_their_intervals_and_averages_over_seeds_where_there_are_some():
    past = {"ratio": 0.625, "ratio_low": 0.5, "ratio_high": 0.75, "ratio_one_step": None}
    rows = pd.DataFrame([*(curved(seed=s) for s in (0, 1, None)), curved("past", seed=None, **past)])
    averages = report.labelled(report.pooled(rows))
    base, mine = lines_of(report.table(averages, ["mean", "method"], ["ratio", "ratio_one_step"]))
    assert (mine["mean"], mine["method"], mine["ratio"]) == ("training", "WP-Past", "0.625 [0.500, 0.750]")
    assert mine["ratio_one_step"] == "-" and base["ratio"] == "1.000 [1.000, 1.000]"
    assert len(report.pooled(rows[:1])) == 1  # a single seed has no average


def test_a_training_counts_by_its_last_checkpoint_and_succeeds_by_its_best_ones():
    rates = {50: 9, 100: 3, 150: 6}
    rows = pd.DataFrame(
        row(k, checkpoint=n, iterations=150, boundary_jump=n / 100, nfe=nfe)
        for nfe in (9, 1)
        for n, k in rates.items()
    )
    found = report.per_seed(rows, 2)
    assert list(found["nfe"]) == [9, 1] and list(found["checkpoint"]) == [150, 150]
    assert list(found["success"]) == pytest.approx([(9 + 6) / 20] * 2)
    assert list(found["success_rate"]) == [0.6, 0.6] and list(found["boundary_jump"]) == [1.5, 1.5]


def test_delays_are_places_of_their_own():
    rows = pd.DataFrame(
        row(3 + d + (g == "rtc"), delay=d, guidance=g) for d in (2, 0) for g in ("none", "rtc")
    )
    assert cells_of(table(rows), "Square-PH, delay 2, measured") == ["50.0", "**60.0** (+10.0)"]
    assert cells_of(table(rows), "Square-PH, delay 0, measured") == ["30.0", "**40.0** (+10.0)"]
