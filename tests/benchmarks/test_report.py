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
    return FACTS | counts | more


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
    return report.success_report(report.summary(rows, top_k), **options)


def cells_of(text, start):
    """The cells of the line of a table that starts so."""
    (line,) = (line for line in text.splitlines() if line.startswith(f"| {start}"))
    return line.strip("| ").split(" | ")[1:]


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
    assert list(report.labelled(rows, chunks=False)["method"]) == [
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
    assert base["jump_ratio"] == pytest.approx(3.0)
    assert past["jump_ratio"] == pytest.approx(0.6 / 0.3)


def test_the_papers_numbers_stand_beside_the_same_experiment_alone():
    same = [row(prior="past", data="mh"), row(prior="past", data="mh", obs="image")]
    others = [
        row(prior="past", data="mh", **more)
        for more in ({"sigma": 1.0}, {"options": "correlation=0.5"}, {"chunk": 4})
    ]
    others += [row(prior="past", data="mh", actions="absolute"), row(prior="past", task="lift")]
    values = [report.summary(pd.DataFrame([one]), 1)["paper"][0] for one in (*same, *others)]
    assert values[:2] == pytest.approx([0.701, 0.776]) and np.isnan(values[2:]).all()


def test_the_report_has_the_layout_of_table_1():
    text = table(compared(), source="scripted", notes=["A note."])
    assert text.startswith("| Success rate (%) | NFE 1: Base | NFE 1: WP-Past | NFE 1: WP-Preview |")
    assert cells_of(text, "Square-PH, measured (scr") == [
        "50.0",
        "**80.0** (+30.0*)",
        "50.0 (+0.0)",
    ]
    assert cells_of(text, "Square-PH, episodes") == ["-", "9 : 0 (1.00)", "1 : 1 (0.50)"]
    assert cells_of(text, "Square-PH, paper") == ["83.6", "86.6 (+3.0)", "87.3 (+3.7)"]
    assert "3 seeds with 10 episodes each, best 1 of 2 checkpoints per seed" in text
    assert "gains within a row" in text and text.endswith("- A note.\n")
    assert "bound" not in text and "Memory" not in text
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
    assert cells_of(text, "Square-PH, spread") == ["-", "0.30"]
    assert cells_of(text, "Square-PH, step") == ["-", "1.50 (!)"]
    assert cells_of(text, "Square-PH, memory") == ["-", "0.000 ± 0.000"]
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
    text = report.terminal_table(report.summary(pd.DataFrame(rows), 1))
    assert max(map(len, text.splitlines())) <= 120
    lines = text.splitlines()
    assert lines[0].startswith(f"{methods} method") and lines[3] == ""
    assert text.count(">50.0 (+10.0)") == tasks * nfes * (methods - 1)


def test_the_first_lines_name_the_best_methods_and_how_sure_that_is():
    rows = [row(k, prior=p, nfe=9) for p, k in (("gaussian", 6), ("past", 4), ("preview", 5))]
    lines = report.terminal_table(report.summary(pd.concat([compared(), pd.DataFrame(rows)]), 1))
    first, best, sure, *_ = lines.splitlines()
    assert first == (
        "3 methods on Square-PH: H = 8, 3 seeds with 10 episodes each, best 1 of 2 checkpoints per seed."
    )
    assert best == (
        "Best success (%): at NFE 9 Base 60.0 (WP-Preview -10.0); at NFE 1 WP-Past 80.0 (+30.0 over Base)."
    )
    chances = [
        (np.random.beta(k + 1, n - k + 1, 200_000) > np.random.beta(b + 1, n - b + 1, 200_000)).mean()
        for k, b, n in ((5, 6, 10), (24, 15, 30))  # of the last checkpoints of all seeds
    ]
    said = re.fullmatch(
        r"Probability of beating Base: (\S+) for WP-Preview at NFE 9; (\S+) for WP-Past at NFE 1\.",
        sure,
    )
    assert [float(chance) for chance in said.groups()] == pytest.approx(chances, abs=0.01)


def test_a_report_is_written_before_what_is_missing_is_an_error(tmp_path, capsys):
    summary = report.summary(compared(), 1)
    with pytest.raises(PartialFailure, match=r"1 failed.*: past, seed 1: no memory"):
        report.write_report(tmp_path, "short", "# full\n", summary, ["past, seed 1: no memory"])
    assert (tmp_path / "report.md").read_text() == "# full\n\nMissing:\n\n- past, seed 1: no memory\n"
    written = pd.read_csv(tmp_path / "results.csv")
    assert list(written["success"]) == pytest.approx([0.5, 0.8, 0.5])
    shown = capsys.readouterr().out
    assert "short\n" in shown and "no memory" in shown and str(tmp_path) in shown
    report.write_report(tmp_path, "short", "full")
    assert (tmp_path / "report.md").read_text() == "full\n"


# Studies


def curved(prior="gaussian", mean="training", seed=0, **more):
    facts = {
        "policy": prior,
        "prior": prior,
        "options": "",
        "sigma": SIGMA.get(prior, 1.0),
        "chunk": 8,
    }
    names = ("ratio", "ratio_executed", "ratio_relative", "ratio_one_step")
    ends = {name + end: 1.0 for name in names for end in ("", "_low", "_high")}
    facts |= {"seed": seed, "mean": mean, "observations": 1000, "bound_executed": 8.0}
    return facts | ends | more


def test_sigma_table_takes_the_mean_of_the_training_where_there_is_no_other():
    rows = pd.DataFrame([row(5), row(6, prior="past"), row(8, prior="past", seed=1)])
    past = [curved("past", m, ratio_executed=r) for m, r in (("training", 0.5), ("deployed", 0.7))]
    text = report.sigma_table(rows, pd.DataFrame([curved(), *past]), 1)
    assert cells_of(text, "Base, sigma 1") == ["50.0", "1.000", "1.000", "1.000", "8.00", "8.00"]
    assert cells_of(text, "WP-Past, sigma 0.5")[:3] == ["70.0 ± 14.1", "0.500", "0.700"]


def test_chunk_and_budget_tables_have_a_line_per_length():
    jumps = {"boundary_jump": 0.25, "action_error": 0.01}
    rows = pd.DataFrame([row(k, chunk=h, nfe=n, **jumps) for h, n, k in ((8, 1, 5), (1, 1, 6), (8, 9, 7))])
    text = report.chunk_table(rows, 1)
    assert text.startswith("|  | NFE 1: Base | NFE 9: Base |")
    assert cells_of(text, "H = 8, success") == ["50.0", "70.0"]
    assert cells_of(text, "H = 1, jump") == ["0.250", "-"]
    rows = pd.DataFrame([row(k, iterations=n, checkpoint=n, **jumps) for n, k in ((90, 9), (100, 8))])
    text = report.budget_table(rows, 1)
    assert (cells_of(text, "90"), cells_of(text, "100")) == (["90.0 (0.0100)"], ["80.0 (0.0100)"])


def test_curvature_table_has_the_layout_of_table_2():
    past = {"ratio": 0.625, "ratio_low": 0.5, "ratio_high": 0.75, "ratio_one_step": None}
    rows = [curved(seed=s) for s in (0, 1, None)]
    rows += [curved("past", m, s, **past) for m in ("training", "deployed") for s in (0, 1, None)]
    rows = pd.DataFrame(rows)
    text = report.curvature_table(rows, {"task": "square", "data": "mh"}, "a test")
    assert cells_of(text, "Square-MH, whole prediction, deployed") == [
        "1.000",
        "0.625 [0.500, 0.750]",
    ]
    assert cells_of(text, "Square-MH, error of one Euler step, executed H, tr")[1] == "no motion"
    assert cells_of(text, "Square-MH, paper") == ["1.000", "0.705"]
    assert "1,000 observations of a test, averaged over 2 training seeds" in text
    for facts in ({"task": "square", "data": "mh", "obs": "image"}, {"task": "lift", "data": "ph"}):
        assert "paper (" not in report.curvature_table(rows, facts, "a test")
    assert "paper (" not in report.curvature_table(rows[3:], {"task": "square", "data": "mh"}, "")


def test_navigation_table_has_the_curvature_at_the_largest_nfe():
    judged = {"switch_rate": 0.5, "collision_rate": 0.25}
    rows = [
        row(nfe=9, **judged),
        row(nfe=9, seed=1, **judged | {"switch_rate": None}),
        row(**judged),
    ]
    flows = [curved(seed=s, kappa_executed=k, task=None) for s, k in ((0, 1.0), (1, 2.0))]
    text = report.navigation_table(pd.DataFrame(rows), pd.DataFrame(flows), ["A note."])
    nine, one = cells_of(text, "Base, NFE 9"), cells_of(text, "Base, NFE 1")
    assert nine[:3] == ["0.500 (1 not finite)", "-", "0.250 ± 0.000"]
    assert (nine[6], one[6], one[0]) == ("1.500 ± 0.707", "-", "0.500")


def test_delay_table_has_a_line_per_delay_and_a_column_per_guidance():
    jumps = {"boundary_jump": 0.5, "inner_jump": None, "execute": 4, "nfe": 9}
    rows = pd.DataFrame(
        row(3 + d + (g == "rtc"), delay=d, guidance=g, **jumps) for d in (2, 0) for g in ("none", "rtc")
    )
    text = report.delay_table(rows, 1, "max weight 5")
    lines = text.splitlines()
    assert lines[0] == "|  | Base | RTC |" and lines[2].startswith("| square ph, NFE 9, delay 0, succ")
    assert cells_of(text, "square ph, NFE 9, delay 2, success") == ["50.0", "60.0"]
    assert "step inside |" not in text and "- RTC: max weight 5." in text
    assert cells_of(table(rows), "Square-PH, delay 2, measured") == ["50.0", "**60.0** (+10.0)"]


def test_agent_table_has_the_last_evaluation_of_every_seed():
    points = [("base", 0, (0.2, 0.4)), ("greedy", 90, (0.1, 0.1)), ("greedy", 200, (0.6, 1.0))]
    agents = pd.DataFrame(
        row(prior="past", algorithm="dsrl-na", delta=0.5, evaluation=e, environment_steps=n, seed=s)
        | {"success_rate": rate}
        for e, n, rates in points
        for s, rate in enumerate(rates)
    )
    text = report.agent_table(agents)
    line = ["0.5", "200", "30.0 ± 14.1", "80.0 ± 28.3", "-"]
    assert cells_of(text, "DSRL-NA, WP-Past (2 seeds)") == line


def test_lines_without_any_cell_are_left_out():
    rows = pd.DataFrame({"a": ["0", "1"], "b": ["x", "y"], "kappa": [None, 1.0]})
    frame = report.cells(rows, "a", "b", {"": report.mean_cell("kappa", ".1f")})
    assert report.markdown(frame, "h") == "| h | x | y |\n|---|---|---|\n| 1 | - | 1.0 |\n"
