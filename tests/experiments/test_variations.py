"""Options beside the paper's recipe: what is refused, continued, played and told of them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

pytest.importorskip("tyro")

from tests.experiments.comparison_parts import METHODS, TRAINING, comparison, rows_of
from warmprior.experiments import (
    PRESETS,
    EvaluationOptions,
    parse,
    started,
)
from warmprior.experiments.success_study import success_notes

VARIED = ["--times", "u-shaped", "--objective", "l1", "--self-distillation", "0.5"]


def read(*argv, presets=PRESETS, **options):
    return parse(presets, [*map(str, argv)], study="a-study", **options)


def test_a_continued_run_has_its_options(tmp_path):
    def begin(recipe):
        with started(recipe, "a-study") as out:
            (out / "results.json").write_text("{}")

    plain, later = ["--out", tmp_path / "plain"], ["--out", tmp_path / "later"]
    begin(read(*plain))
    begin(read(*VARIED, "--grid", "dense-jump", *later))
    assert read("--resume", *plain).training.times == "uniform"
    again = read("--resume", *later)
    assert again.training.self_distillation == 0.5 and again.evaluation.grid == "dense-jump"
    assert read("--resume", *VARIED, *later) == again
    with pytest.raises(ValueError, match=r"was started with --times uniform: leave"):
        read("--resume", "--times", "u-shaped", *plain)
    with pytest.raises(ValueError, match=r"was started with --grid dense-jump: leave"):
        read("--resume", "--grid", "uniform", *later)


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ("--self-distillation -1", "self_distillation must be a finite weight >= 0, got -1"),
        ("--grid sparse", "unknown grid 'sparse'; choose one of uniform, dense-jump"),
        ("--grid dense-jump:2", r"the jump of a grid must start in \(0, 1\), got 'dense-jump:2'"),
        ("--grid dense-jump --nfe 1", "--grid has no effect at NFE 1"),
        ("--grid dense-jump --prior regression", "--grid has no effect at NFE 1"),
        (
            "--times u-shaped --prior regression",
            "--times has no effect on regression, trained at t = 0",
        ),
        ("--objective l1 --prior past regression --nfe 1", "leave out regression"),
        ("--self-distillation 1 --prior regression --nfe 1", "leave out regression"),
    ],
)
def test_what_cannot_work_is_refused_before_any_work(argv, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        read(*argv.split(), "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_unknown_names_are_told_with_the_choices(tmp_path, capsys):
    for name in ("times", "objective"):
        with pytest.raises(SystemExit):
            read(f"--{name}", "nobodys", "--out", tmp_path / "out")
    told = capsys.readouterr().err
    assert "u-shaped" in told and "l1" in told


def test_options_without_effect_are_refused(tmp_path):
    """In either direction: also the default, where a preset has another."""
    given = ["--grid", "dense-jump", "--out", tmp_path / "out"]
    with pytest.raises(ValueError, match="makes no use of it: leave out --grid"):
        read(*given, unused=("grid",))
    presets = {"quick": replace(PRESETS["quick"], evaluation=EvaluationOptions(grid="dense-jump"))}
    with pytest.raises(ValueError, match="makes no use of it: leave out --grid"):
        read("--grid", "uniform", "--out", tmp_path / "out", presets=presets, unused=("grid",))


def test_one_flow_makes_use_of_them(tmp_path):
    argv = ["--prior", "regression", "past", "--times", "u-shaped", "--grid", "dense-jump"]
    recipe = read(*argv, "--out", tmp_path / "out")
    assert (recipe.training.times, recipe.evaluation.grid) == ("u-shaped", "dense-jump")


def test_policies_are_played_and_measured_on_the_grid(tmp_path):
    """One step is the same on each; more are not, on the same policies."""
    rows = {}
    for i, grid in enumerate(("uniform", "dense-jump:0.9")):
        compared = comparison(tmp_path / str(i), 1, methods=METHODS[1:2], seeds=1, grid=grid)
        compared.run()
        player = compared.player(compared.contestants[0])
        assert player.ode.grid == grid
        rows[grid] = [row for row in rows_of(tmp_path / str(i)) if row["checkpoint"] == 20]
    uniform, jump = ({row["nfe"]: row for row in found} for found in rows.values())
    played = ("outcomes", "mean_steps", "boundary_jump", "inner_jump", "source_leak")
    assert all(uniform[1][measure] == jump[1][measure] for measure in played)
    for measure in ("boundary_jump", "source_leak"):
        assert uniform[3][measure] != jump[3][measure]
    with pytest.raises(ValueError, match="belongs to another recipe"):
        comparison(tmp_path / "1", 1, methods=METHODS[1:2], seeds=1, resume=True)


def test_tables_name_them(tmp_path):
    plain, varied = (
        success_notes(read(*argv, "--out", tmp_path / "out"), PRESETS["paper"])
        for argv in (("--preset", "paper"), (*VARIED, "--grid", "dense-jump"))
    )
    assert not [line for line in plain if "Beside the paper" in line]
    told = (
        "- Beside the paper, for all sources: --times u-shaped, --objective l1, --weighting standardised, "
        "--self-distillation 0.5, --grid dense-jump."
    )
    assert told in varied


def test_every_source_learns_with_all_of_them(tmp_path):
    training = replace(TRAINING, times="u-shaped", objective="l1", self_distillation=0.5)
    compared = comparison(tmp_path, 1, training=training, seeds=1, episodes=1, grid="dense-jump")
    compared.run()
    assert not compared.failures
    assert {row["prior"] for row in rows_of(tmp_path)} == {method.name for method in METHODS}
    for c in compared.contestants:
        assert all(bool(torch.isfinite(p).all()) for p in c.policy().parameters())
