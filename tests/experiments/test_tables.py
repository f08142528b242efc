"""Tables in Markdown: which numbers end up in which cell."""

from __future__ import annotations

import pytest

from warmprior.diagnostics import probability_better

pytest.importorskip("tyro")

from tests.experiments.row_parts import FACTS, compared, row
from warmprior.experiments import (
    Row,
    flow_table,
    mean_cell,
    paper_success,
    success_cell,
    success_table,
    table,
)
from warmprior.experiments.results import played
from warmprior.experiments.tables import wins_and_losses


def lines(text, start="| Square-PH"):
    return [line for line in text.splitlines() if line.startswith(start)]


def test_table_shows_gains_marks_and_the_papers_row():
    text = success_table(compared(), top_k=1, source="scripted", notes=["- A note."])
    measured, better, paired, paper = lines(text)
    assert measured == (
        "| Square-PH, measured (scripted data) | 50.0 | **80.0** (+30.0*) | 50.0 (+0.0) |"
    )
    # Of all seeds' last checkpoints: 15, 24 and 15 of 30.
    chance = f"{probability_better(24, 30, 15, 30):.2f}"
    assert better == f"| Square-PH, probability of being better than Base | - | {chance} | 0.50 |"
    assert paired.endswith(" (probability) | - | 9 : 0 (1.00) | 1 : 1 (0.50) |")
    assert paper == "| Square-PH, paper (official data) | 83.6 | 86.6 (+3.0) | 87.3 (+3.7) |"
    head = "| Success rate (%) | NFE 1: Base | NFE 1: WP-Past | NFE 1: WP-Preview |"
    assert text.startswith(head)
    assert "H = 8; 3 seed(s); 10 episodes per cell; the best 1 of 2 checkpoints per seed" in text
    assert "compare gains within a row" in text and text.endswith("- A note.\n")
    assert "bound" not in text
    assert "compare gains within a row" not in success_table(compared(), top_k=1, source="official")


def test_gains_are_over_the_baseline_of_the_same_nfe():
    rows = [
        row(k, prior=prior, nfe=nfe)
        for prior, wins in (("gaussian", (2, 5)), ("past", (4, 5)))
        for nfe, k in zip((1, 9), wins, strict=True)
    ]
    text = success_table(rows, top_k=1, source="scripted")
    assert "| NFE 9: Base | NFE 9: WP-Past | NFE 1: Base | NFE 1: WP-Past |" in text
    # One seed has no spread: no gain is marked.
    assert lines(text)[0].endswith("| **50.0** | **50.0** (+0.0) | 20.0 | **40.0** (+20.0) |")
    assert "One seed has no spread: no gain is marked" in text


def test_policies_that_see_images_are_a_problem_of_their_own():
    """Not averaged with those that see the state, and beside the paper's row of images (Table 1)."""
    rows = [
        row(k, prior=prior, data="mh", **space)
        for space, wins in (({}, (2, 5)), ({"obs": "image"}, (6, 7)))
        for prior, k in zip(("gaussian", "past"), wins, strict=True)
    ]
    told = lines(success_table(rows, top_k=1, source="official"), "| Square-MH")
    assert "| Square-MH, measured (official data) | 20.0 | **50.0** (+30.0) |" in told
    images = [line for line in told if line.startswith("| Square-MH, image observations,")]
    assert images[0].endswith("measured (official data) | 60.0 | **70.0** (+10.0) |")
    papers = [line for line in told if "paper (official data)" in line]
    assert [line in images for line in papers] == [False, True]
    assert papers[0].endswith("| 65.9 | 70.1 (+4.2) |")
    assert papers[1].endswith("| 72.4 | 77.6 (+5.2) |")


def test_gains_are_over_the_first_source_wherever_it_is():
    rows = [
        row(k, prior=prior, nfe=nfe)
        for prior, wins in (
            ("regression", {1: 2}),
            ("gaussian", {9: 5, 1: 4}),
            ("past", {9: 7, 1: 9}),
        )
        for nfe, k in wins.items()
    ]
    text = success_table(rows, top_k=1, source="scripted")
    assert (
        "| NFE 9: Base | NFE 9: WP-Past | NFE 1: Regression | NFE 1: Base | NFE 1: WP-Past |"
        in text
    )
    # There is no regression at NFE 9, and so no gain.
    assert lines(text)[0].endswith("| 50.0 | **70.0** | 20.0 | 40.0 (+20.0) | **90.0** (+70.0) |")
    assert "the gain over Regression" in text


def test_a_gain_within_the_spread_of_the_seeds_is_not_marked():
    rows = [
        row(k, prior=prior, seed=seed)
        for prior, wins in (("gaussian", (2, 4)), ("past", (3, 5)))
        for seed, k in enumerate(wins)
    ]
    assert "**40.0** (+10.0) |" in lines(success_table(rows, top_k=1, source="file"))[0]


def test_a_gain_that_rounds_to_zero_has_no_minus():
    rows = [
        row(k, 50, prior=prior, seed=seed)
        for prior, wins in (("gaussian", (46, 46)), ("past", (45, 47)))  # equal but for rounding
        for seed, k in enumerate(wins)
    ]
    text = success_table(rows, top_k=1, source="scripted")
    assert "(+0.0)" in text and "-0.0" not in text


def test_table_shows_what_the_source_leaks():
    """Means over seeds of the last checkpoints, with a mark above the bound."""

    def leaking(old):
        leak = 9.0 if old["checkpoint"] == 50 else None
        told = {"source_leak": leak, "inner_step_ratio": None}
        if (old["prior"], old["checkpoint"]) == ("past", 100):
            told = {"source_leak": 0.2 + old["seed"] / 10, "inner_step_ratio": 1.5}
        return Row(old.facts, {**old.measures, **told})

    text = success_table([leaking(old) for old in compared()], top_k=1, source="scripted")
    assert "spread over draws of the source / data's (bound 1) | - | 0.30 | - |" in text
    assert "step inside chunks / data's (bound 1.3) | - | 1.50 (!) | - |" in text


def test_table_shows_how_far_the_actions_follow_the_memory():
    def following(old):
        if old["checkpoint"] == 50:
            return Row(old.facts, {**old.measures, "memory_gain": 9.0})
        gain = -0.0001 if old["prior"] == "gaussian" else 0.1 * old["seed"]
        return Row(old.facts, {**old.measures, "memory_gain": gain})

    text = success_table([following(old) for old in compared()], top_k=1, source="scripted")
    cells = "0.000 ± 0.000 | 0.100 ± 0.100 | 0.100 ± 0.100 |"
    assert f"memory gain (0: ignores what it did, 1: repeats it) | {cells}" in text
    assert "- Memory gain: how much of a shift" in text
    assert "Memory gain" not in success_table(compared(), top_k=1, source="scripted")


def with_outcomes(outcomes, **facts):
    return played(FACTS | facts, [c == "1" for c in outcomes])


def test_episodes_of_the_same_seeds_are_compared():
    """Pairs are of one training and one episode seed; what both or neither solve does not count."""
    base = [with_outcomes("1100", seed=0), with_outcomes("0000", seed=1)]
    mine = [
        with_outcomes("0111", prior="past", seed=0),
        with_outcomes("0011", prior="past", seed=1),
    ]
    text = success_table([*base, *mine], top_k=1, source=None)
    # 4 wins, 1 loss: (C(6,0) + ... + C(6,4)) / 2^6 = 57 / 64
    assert "only Base solves (probability) | - | 4 : 1 (0.89) |" in text
    assert wins_and_losses(mine[::-1], base[:1]) == (2, 1)
    assert wins_and_losses(mine, []) is None
    assert wins_and_losses([Row(FACTS, {"success_rate": 0.5})], base) is None


def test_flows_compare_with_the_first_sources_of_their_problem():
    def flowing(kappa, bound, **facts):
        return Row(FACTS | facts, {"success_rate": 1.0, "kappa": kappa, "bound": bound})

    rows = [
        flowing(kappa * scale, bound, task=task, prior=prior, nfe=nfe, seed=seed)
        for task, scale in (("square", 1.0), ("stack", 10.0))
        for prior, kappa, bound in (("gaussian", 2.0, 8.0), ("past", 1.0, None))
        for seed in (0, 1)
        for nfe in (9, 1)
    ]
    text = flow_table(rows)
    assert text.count("curvature / Base's | 1.00 | 0.50 |") == 2
    assert "Stack-PH, bound of the branching cost / Base's | 1.00 | - |" in text
    assert "per squared" not in text  # nobody measured it


@pytest.mark.parametrize("nfes", [(9, 1), (1, 9)])
@pytest.mark.parametrize("last", ["nfe", "prior"])
def test_flows_are_those_of_the_largest_nfe_in_whatever_order(nfes, last):
    def flowing(kappa, **facts):
        facts = FACTS | facts
        moved = last if facts["nfe"] == 9 else "prior"  # rows of one policy may differ in this, too
        facts[moved] = facts.pop(moved)
        return Row(facts, {"success_rate": 1.0, "kappa": kappa})

    kappas = {"gaussian": {9: 2.0, 1: 5.0}, "past": {9: 1.0, 1: 7.0}}
    rows = [flowing(kappas[prior][nfe], prior=prior, nfe=nfe) for prior in kappas for nfe in nfes]
    assert "curvature / Base's | 1.00 | 0.50 |" in flow_table(rows)


def test_jumps_between_chunks_are_relative_to_the_steps_inside():
    told = [row(5, measures={"boundary_jump": 0.6, "inner_jump": j}) for j in (0.2,)]
    assert "jump between chunks / step inside | 3.00 |" in success_table(told, top_k=1, source=None)


def test_policies_of_several_sigmas_have_columns_of_their_own():
    rows = [row(5), *(row(k, prior="past", sigma=s) for k, s in ((6, 0.5), (7, 1.0)))]
    text = success_table(rows, top_k=1, source="scripted")
    assert "| NFE 1: Base | NFE 1: WP-Past, sigma 0.5 | NFE 1: WP-Past, sigma 1 |" in text
    assert "| 50.0 | 60.0 (+10.0) | **70.0** (+20.0) |" in lines(text)[0]


def test_a_cell_tells_mean_spread_and_what_is_missing():
    rows = [Row({"seed": i}, {"kappa": k}) for i, k in enumerate((0.25, 0.75, None))]
    cell = mean_cell("kappa", ".3f")
    assert cell(rows[:2]) == "0.500 ± 0.354"
    assert cell(rows[1:]) == "0.750 (1 not finite)"
    assert cell(rows[2:]) is None and mean_cell("speed", ".3f")(rows) is None
    assert mean_cell("kappa", ".1f", 100)(rows[:1]) == "25.0"
    seeds = [row(4, seed=0), row(6, seed=1)]
    assert success_cell(1)(seeds) == "50.0 ± 14.1" and success_cell(1)(seeds[:1]) == "40.0"


def test_lines_without_any_cell_are_left_out():
    rows = [Row({"a": i, "b": i}, {"kappa": i or None}) for i in range(2)]
    index, columns = (lambda row: f"a {row['a']}"), (lambda row: f"b {row['b']}")
    text = table(rows, index, columns, {"": mean_cell("kappa", ".1f")}, head="h")
    assert text == "| h | b 0 | b 1 |\n|---|---|---|\n| a 1 | - | 1.0 |\n"


def test_paper_numbers_cover_table_1():
    assert paper_success("transport", "mh", "preview", 3) == 30.4
    assert paper_success("lift", "ph", "past", 1) is None
    assert paper_success("square", "ph", "regression", 1) is None
    assert paper_success("square", "ph", "past", 1, chunk=4) is None
