import itertools
import json
import math
import re

import memory
import numpy as np
import pandas as pd
import pytest
from scipy import stats

from lab.io.errors import PartialFailure
from lab.options.command_line import parse, started
from lab.options.presets import PRESETS
from lab.reporting import report
from tests.benchmarks.script_parts import is_png
from tests.errors import missing, raises
from tests.paper_facts import SIGMA_SUCCESS, SUCCESS

FACTS = {"task": "square", "data": "ph", "prior": "gaussian", "options": "", "sigma": 1.0, "chunk": 8}
FACTS |= {"seed": 0, "iterations": 100, "checkpoint": 100, "nfe": 1, "temperature": 1.0}
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
    found = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]
    start = max(i for i, line in enumerate(found) if line[0] == "---") - 1
    return [dict(zip(found[start], line, strict=True)) for line in found[start + 2 :]]


def test_methods_and_settings_have_names_that_differ():
    rows = [
        row(guidance="rtc", task="tool_hang"),
        row(prior="past", options="correlation=0.5", actions="absolute", chunk=4),
        row(prior="past", sigma=1.0, guidance="rtc", obs="image"),
    ]
    found = report.labelled(pd.DataFrame(rows), "chunk")
    methods = ["RTC", "WP-Past, correlation=0.5, sigma 0.5", "RTC + WP-Past, sigma 1"]
    assert list(found["method"]) == methods
    settings = ["Tool-Hang-PH", "Square-PH, absolute actions", "Square-PH, image observations"]
    assert list(found["setting"]) == settings


def test_a_method_with_its_own_temperature_is_compared_at_the_same_number_of_steps():
    rows = [row(2, nfe=2), row(7, nfe=2, prior="mip", temperature=0.0)]
    beside = report.summary(pd.DataFrame(rows), 1).iloc[1]
    assert (beside["gain"], beside["won"], beside["lost"]) == (pytest.approx(0.5), 5, 0)


@pytest.mark.parametrize("top_k", [1, 2, 3])
def test_a_summary_is_what_scipy_and_counting_say(top_k):
    """All of a row is of the same checkpoints, and their episodes count once each."""
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
    found = report.summary(pd.DataFrame(rows), top_k).set_index(["data", "prior", "nfe"])
    assert len(found) == 8
    for (data, prior, nfe), record in found.iterrows():

        def solved(prior, data=data, nfe=nfe):
            """Return the mean outcome of each episode over the best checkpoints of a seed, ``[3, 6]``."""
            seeds = np.empty((3, 6))
            for seed, e in itertools.product(range(3), range(6)):
                texts = [episodes[prior, data, seed, c, nfe] for c in (100, 60, 30)]
                # Episodes of the other parity choose the checkpoints.
                best = sorted(texts, key=lambda text: -text[1 - e % 2 :: 2].count("1"))[:top_k]
                seeds[seed, e] = np.mean([int(text[e]) for text in best])
            return seeds

        mine, first = solved(prior), solved("gaussian")
        assert record["success"] == pytest.approx(mine.mean()) == record["successes"] / record["episodes"]
        assert record["success_std"] == pytest.approx(np.std(mine.mean(1), ddof=1))
        assert (record["seeds"], record["episodes"]) == (3, 18)
        # Student's interval: 12 trainings of 4 cells, whose spread is in units of each cell's variance.
        cells = [solved(p, d) for p in ("gaussian", "past") for d in ("ph", "mh")]
        effect = sum(6 * np.var(c.mean(1)) * 3 / np.var(c) for c in cells) / 8
        half = stats.t(8).ppf(0.975) * np.sqrt(effect * max(np.var(mine), 1 / 20) / 18)
        ends = np.clip([mine.mean() - half, mine.mean() + half], 0, 1)
        assert (record["success_low"], record["success_high"]) == pytest.approx(tuple(ends))
        if prior == "gaussian":
            assert record[["gain", "gain_low", "won", "lost"]].isna().all()
            continue
        spread = sum(np.std(part.mean(1), ddof=1) for part in (mine, first))
        assert record["gain"] == pytest.approx(mine.mean() - first.mean())
        assert record["one_sigma"] == (record["gain"] > spread)
        pairs = [solved("past", d) - solved("gaussian", d) for d in ("ph", "mh")]
        effect = sum(6 * np.var(c.mean(1)) * 3 / np.var(c) for c in pairs) / 4
        half = stats.t(4).ppf(0.975) * np.sqrt(effect * max(np.var(mine - first), 1 / 20) / 18)
        ends = record["gain"] - half, record["gain"] + half
        assert (record["gain_low"], record["gain_high"]) == pytest.approx(ends)
        assert record["gains"] == pytest.approx(list((mine - first).mean(1)))
        won, lost = (np.clip(sign * (mine - first), 0, 1).sum() for sign in (1, -1))
        assert (record["won"], record["lost"]) == pytest.approx((won, lost))
        assert record["gain"] * record["episodes"] == pytest.approx(won - lost)


def test_a_first_method_that_failed_in_one_setting_stays_the_first():
    """No other takes its place: there is no gain where it is missing."""
    rows = [row(8, prior="past"), row(9, prior="preview")]  # the Gaussian source failed on square
    rows += [row(k, prior=prior, task="can") for prior, k in (("gaussian", 5), ("past", 8), ("preview", 2))]
    found = report.summary(pd.DataFrame(rows), 1)
    assert list(found["gain"].round(9).dropna()) == [0.3, -0.3] and found["gain"][:3].isna().all()
    assert found["won"].notna().tolist() == [False] * 3 + [True] * 2
    assert [len(gains) for gains in found["gains"]] == [0, 0, 0, 1, 1]
    for text in (report.headline(found, 1), report.terminal_table(found, 1), table(rows)):
        assert re.search("(ain over|with the) Gaussian source", text)
        assert not re.search("(ain over|with the) WP", text)


def test_a_gain_and_its_probabilities_are_of_the_same_checkpoints():
    """The last checkpoint of WP-Past is its worst, and its best ones lead."""
    rows = [row(k, checkpoint=c) for c, k in ((1, 4), (2, 4), (3, 4))]
    rows += [row(k, prior="past", checkpoint=c) for c, k in ((1, 9), (2, 9), (3, 1))]
    _, best = report.summary(pd.DataFrame(rows), 2).to_dict("records")
    _, every = report.summary(pd.DataFrame(rows), 3).to_dict("records")
    assert best["gain"] == pytest.approx(0.5) == best["gains"][0]
    assert every["gain"] == pytest.approx(19 / 30 - 0.4) == every["gains"][0]


def test_the_papers_numbers_stand_beside_the_same_experiment_alone():
    same = [row(prior="past", data="mh"), row(prior="past", data="mh", obs="image")]
    same.append(row(prior="past", data="mh", sigma=0.0))  # of the ablation
    changes = ({"sigma": 1.0}, {"options": "correlation=0.5"}, {"chunk": 4}, {"delay": 0})
    others = [row(prior="past", data="mh", **more) for more in changes]
    others += [row(prior="past", data="mh", actions="absolute"), row(prior="past", task="lift")]
    found = [report.summary(pd.DataFrame([one]), 1).iloc[0] for one in (*same, *others)]
    values = [one["paper"] for one in found]
    rates = [SUCCESS["square", "mh", obs][7] / 100 for obs in ("state", "image")]  # WP-Past at one step
    assert values[:3] == pytest.approx([*rates, SIGMA_SUCCESS["past", 0.0]]) and np.isnan(values[3:]).all()


def test_the_report_has_the_layout_of_table_1():
    text = table(compared(), source="scripted", notes=["A note."])
    columns = "NFE 1: Gaussian source | NFE 1: WP-Past | NFE 1: WP-Preview"
    found, _, *lines = text.splitlines()  # first what came out, and if it can be chance
    assert "WP-Past solves 30.0 points more" in found and "too few to judge" in found
    assert lines[0] == f"| Success rate (%) | {columns} |"
    assert cells_of(text, "Square-PH, measured (scr") == ["50.0", "**80.0** (+30.0*)", "50.0 (+0.0)"]
    assert cells_of(text, "Square-PH, paper") == [f"{rate}" for rate in SUCCESS["square", "ph", "state"][-3:]]

    def counts(text):
        return [(line["won"], line["lost"]) for line in lines_of(text)]

    assert counts(text) == [("-", "-"), ("9", "0"), ("1", "1")]
    # An episode that one of two checkpoints solves counts half.
    halves = pd.DataFrame([row("01"), row("11", prior="past"), row("01", prior="past", checkpoint=50)])
    assert counts(table(halves, 2))[1] == ("0.5", "0")
    assert "3 seeds with 10 episodes each, best 1 of 2 checkpoints per seed" in text
    other = table(compared().assign(task="can"), source="scripted")  # the paper has no row of it
    assert not missing(other, "Table 1", "transport", "docs/paper.md") and "official" not in other
    assert "- A note.\n" in text and "source_leak" not in text  # nobody measured it


def test_measures_are_of_the_chosen_checkpoints_beside_the_baseline():
    rows = [row(prior="regression", checkpoint=n, kappa=k) for n, k in ((50, 99.0), (100, 2.0))]
    measured = {"nfe": 9, "source_leak": 0.3, "inner_step_ratio": 1.5}
    for seed, kappa in enumerate((1.0, 3.0)):
        rows.append(row(prior="past", seed=seed, kappa=kappa, memory_gain=kappa / 10, **measured))
    base, past = report.summary(pd.DataFrame(rows), 1).to_dict("records")
    assert base["kappa_ratio"] == 1.0 and math.isnan(base["memory_gain"])
    # The flow is compared although the baseline has no NFE 9; success is not.
    assert past["kappa_ratio"] == 1.0 and math.isnan(past["gain"])
    assert (past["memory_gain"], past["memory_gain_std"]) == pytest.approx((0.2, math.sqrt(0.02)))
    # A leak is marked above its bound.
    assert [line["inner_step_ratio"] for line in lines_of(table(rows))] == ["-", "1.50 ± 0.00 (!)"]


def test_the_terminal_table_fits_and_says_first_what_came_out():
    rows = [row(k, prior=p, nfe=9) for p, k in (("gaussian", 6), ("past", 4), ("preview", 5))]
    found = report.summary(pd.concat([compared(), pd.DataFrame(rows)], ignore_index=True), 1)
    *sure, best, facts = report.headline(found, 1).splitlines()
    assert report.terminal_table(found, 1).startswith("\n".join([*sure, best, facts, ""]))
    ends = [line for width in range(30, 121) for line in report.headline(found, 1, width).splitlines()]
    assert not [line for line in ends if line.endswith("-")]  # WP-Past stays one word
    assert facts.endswith("H = 8, 3 seeds with 10 episodes each, best 1 of 2 checkpoints per seed.")
    assert best == "Best success: Gaussian source 60.0% at NFE 9; WP-Past 80.0% at NFE 1."
    sure = " ".join(" ".join(sure).split())
    said = re.findall(r"(\S+) solves (\S+) points (more|fewer) at NFE (\d) \((\d trainings?)", sure)
    preview, past = ("WP-Preview", "10.0", "fewer", "9", "1 training"), ("WP-Past", "30.0", "more", "1")
    assert said == [preview, (*past, "3 trainings")] and "p =" not in sure
    # Together the trainings of two settings are enough: all six gain, which happens by chance in 2 of 64.
    both = pd.concat([compared(), compared().assign(task="can", policy=lambda rows: rows.policy + "-can")])
    sure = " ".join(report.headline(report.summary(both, 1), 1).split())
    assert "WP-Past solves 30.0 points more at NFE 1 (p = 0.031, 6 trainings)" in sure
    lost = report.summary(
        pd.DataFrame([row(0, prior=p, nfe=n) for p in ("gaussian", "past") for n in (9, 1)]), 1
    )
    assert not missing(report.headline(lost, 1), "No method solves") and "Best" not in report.headline(
        lost, 1
    )
    names = [f"correlation=0.{k},a_long_name_of_an_option_beyond_the_width=1" for k in range(14)]
    rows = [row(prior="past", options=o, nfe=n, task=t) for o in names for n in range(1, 10) for t in "ab"]
    text = report.terminal_table(report.summary(pd.DataFrame(rows), 1), 1)
    assert max(map(len, text.splitlines())) <= 120 and text.count(" (+0.0)") == 2 * 9 * 13


def test_a_report_is_written_before_what_is_missing_is_an_error(tmp_path, capsys):
    summary = report.summary(compared(), 1)
    with raises(PartialFailure, "1", "past, seed 1: no memory"):
        report.write_report(tmp_path, "short", "# full\n", summary, ["past, seed 1: no memory"])
    text = (tmp_path / "report.md").read_text()
    assert text.startswith("# full\n\nMissing:\n\n- past, seed 1: no memory\n\nColumns")
    # Every column is defined once.
    assert text.count("\n- `") == len(summary.columns)
    assert "- `success_std`: success: standard deviation over training seeds\n" in text
    written = pd.read_csv(tmp_path / "results.csv")
    assert list(written["success"]) == pytest.approx([0.5, 0.8, 0.5])
    shown = capsys.readouterr().out
    assert "short\n" in shown and "no memory" in shown and str(tmp_path) in shown


def test_a_table_has_the_mean_and_deviation_of_every_group_in_the_order_of_the_rows():
    rows = [row(nfe=9, switch_rate=0.5, collision_rate=0.25), row(nfe=9, seed=1, collision_rate=0.35)]
    rows = report.labelled(pd.DataFrame([*rows, row(switch_rate=0.5, collision_rate=0.1)]))
    names = ["success_rate", "switch_rate", "collision_rate", "jerk"]
    nine, one = lines_of(report.table(rows, ["method", "nfe"], names, ["A note."]))
    assert list(nine) == ["method", "nfe", *names[:3]]  # nobody has a jerk
    expected = ["9", "50.0% ± 0.0%", "0.500 (1 not finite)", "0.300 ± 0.071"]  # 0.1 / sqrt(2)
    assert list(nine.values()) == ["Gaussian source", *expected]
    assert list(one.values()) == ["Gaussian source", "1", "50.0%", "0.500", "0.100"]


def test_a_training_is_shown_by_its_best_checkpoints():
    """The even episodes choose the checkpoint of the odd ones, and the other way round."""
    outcomes = {50: "1111111110", 100: "1010101010", 150: "0101010111"}
    rows = [row(text, checkpoint=n, iterations=150, boundary_jump=n / 100) for n, text in outcomes.items()]
    (found,) = report.per_seed(pd.DataFrame(rows), 1).to_dict("records")
    # Even episodes: 5, 5 and 1 solved, and the later of two equals is taken. Odd ones: 4, 0 and 5.
    assert found["solved"].tolist() == [int(outcomes[150 if e % 2 == 0 else 100][e]) for e in range(10)]
    assert found["checkpoints"] == 3 and found["boundary_jump"] == pytest.approx((1.0 + 1.5) / 2)
    assert found["success"] == found["success_rate"] == pytest.approx(0.1)
    (found,) = report.per_seed(pd.DataFrame(rows), 2).to_dict("records")
    assert found["boundary_jump"] == pytest.approx(((0.5 + 1.0) + (0.5 + 1.5)) / 4)


def test_gains_of_all_runs_stand_beside_what_is_remembered(tmp_path, capsys):
    """A success is that of the run's own --top-k, and trainings of other lengths have their own lines."""
    one = [row(5, memory_gain=0.0), row(8, prior="past", memory_gain=0.25)]
    one.append(row(6, prior="past", checkpoint=50, memory_gain=None))
    one += [row(2, iterations=200), row(9, prior="past", iterations=200, memory_gain=0.5)]
    # The first method has no gain, and what was not measured no point.
    two = [row(5, task="can", memory_gain=0.0), row(8, task="can", prior="past", memory_gain=None)]
    for name, rows in (("one", one), ("two", two)):
        with started(parse(PRESETS, ["--out", str(tmp_path / name), "--top-k", "2"], "robomimic", None), ""):
            pass
        (tmp_path / name / "results.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    argv = [str(tmp_path / name) for name in ("one", "two")]
    assert memory.main([*argv, "--out", str(tmp_path / "a.png")]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    starts = [line.partition(" [")[0] for line in lines[2:]]  # before the interval
    assert starts == [
        "| Square-PH | 100 | 1 | 1 | WP-Past | 0.250 | +20.0%",  # the mean of 8 and 6 of 10, minus 5
        "| Square-PH | 200 | 1 | 1 | WP-Past | 0.500 | +70.0%",
    ]
    assert is_png(tmp_path / "a.png")
    # Two runs of a setting may differ in anything, so their gains are not averaged.
    (tmp_path / "two" / "results.jsonl").write_text("".join(json.dumps(row) + "\n" for row in one[3:]))
    assert memory.main([*argv, "--out", str(tmp_path / "a.png")]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| Square")]
    assert [line.split(" | ")[1:3] for line in lines] == [
        [argv[0], "100"],
        [argv[0], "200"],
        [argv[1], "200"],
    ]
    assert memory.main([str(tmp_path / "none")]) == 2
    assert capsys.readouterr().err.endswith("results.jsonl: no such file\n")
    (tmp_path / "one" / "results.jsonl").write_text('{"task": "navigation"}\n')
    assert memory.main(argv) == 2
    said = capsys.readouterr().err
    assert all(word in said for word in ("one/results.jsonl, line 1", "policy", "outcomes", "robomimic.py"))


def test_a_temperature_is_a_column_and_compares_with_its_own():
    rows = [row(5, temperature=1.0), row(2, temperature=0.5)]
    rows += [row(6, prior="past", temperature=1.0), row(9, prior="past", temperature=0.5)]
    found = report.summary(pd.DataFrame(rows), 1).set_index(["prior", "temperature"])
    assert found.loc[("past", 1.0), "gain"] == pytest.approx(0.1)
    assert found.loc[("past", 0.5), "gain"] == pytest.approx(0.7)
    text = table(pd.DataFrame(rows))
    assert "NFE 1, noise x 1: Gaussian source" in text and "NFE 1, noise x 0.5: WP-Past" in text
