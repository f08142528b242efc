"""The study of the paper's Table 1: success rates of sources, with pictures, from a command line."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib.util import find_spec

from warmprior.envs.rendering import rendering_backend
from warmprior.envs.tasks import EVALUATION_SEED
from warmprior.experiments.cli import parse, started, write_report
from warmprior.experiments.comparison import Comparison
from warmprior.experiments.figures import plot_filmstrip, plot_learning_curves, plot_success
from warmprior.experiments.labels import source_labels
from warmprior.experiments.recipe import Recipe
from warmprior.experiments.record import variation_notes
from warmprior.experiments.results import Row, select
from warmprior.experiments.store import Store
from warmprior.experiments.tables import flow_table, success_table
from warmprior.training import record_filmstrip

__all__ = ["study_success", "success_notes"]


def study_success(
    presets: Mapping[str, Recipe],
    argv: Sequence[str] | None,
    *,
    study: str,
    description: str | None = None,
    preset: Callable[[Recipe], Recipe] | None = None,
) -> None:
    """Compare sources as a command line asks for, and write results, table and pictures.

    Args:
        presets: by name; the first is the default, and ``"paper"`` is the paper's recipe.
        argv: see :func:`parse`.

    Keyword Args:
        study: see :func:`parse`.
        description: likewise.
        preset: likewise.

    Raises:
        ValueError: naming the option that cannot work.
        PartialFailure: if policies failed, after the report on the others.

    Examples:
        >>> from warmprior.experiments import PRESETS
        >>> study_success(PRESETS, ["--task", "lift", "--prior", "past"], study="mine")  # doctest: +SKIP
        Output folder: runs/mine-lift-ph-quick
        >>> study_success(PRESETS, ["--chunk", "0"], study="mine")
        Traceback (most recent call last):
            ...
        ValueError: --chunk must be between 1 and 1,000,000, got 0
    """
    recipe = parse(presets, argv, study=study, description=description, preset=preset)
    with started(recipe, study) as out:
        comparison = Comparison(recipe, study)
        comparison.run()
        rows = comparison.rows
        table = success_table(
            rows,
            top_k=recipe.evaluation.top_k,
            source=comparison.stores[0].problem.facts["source"],
            notes=success_notes(recipe, presets["paper"]),
        )
        _draw(comparison, rows)
        write_report(out, f"{table}\n{flow_table(comparison.timed())}", comparison.failures)


def success_notes(recipe: Recipe, paper: Recipe) -> list[str]:
    """What the table says of a recipe beside the paper's.

    Args:
        recipe: of all rows.
        paper: the paper's.

    Examples:
        >>> from warmprior.experiments import PRESETS
        >>> success_notes(PRESETS["paper"], PRESETS["paper"])
        []
    """
    told = variation_notes(recipe, paper)
    # An encoder that could not start from ImageNet's weights is as large as theirs.
    network = replace(recipe.network, encoder=paper.network.encoder)
    if network != paper.network or recipe.training.iterations < paper.training.iterations:
        told.append("- Network and training budget are smaller than the paper's.")
    return told


def _draw(comparison: Comparison, rows: Sequence[Row]) -> None:
    """One set of pictures per problem."""
    out, several = comparison.directory, len(comparison.stores) > 1
    for store in comparison.stores:
        problem = store.problem
        mine = select(rows, task=problem.task, data=problem.style)
        end = f"_{problem.task}_{problem.style}.png" if several else ".png"
        last = [row for row in mine if row["checkpoint"] == row["iterations"]]
        chunks = ", ".join(map(str, sorted({row["chunk"] for row in mine})))
        title = f"{problem.name}, H = {chunks}"
        plot_success(last, out / f"success{end}", title=title)
        curve = select(mine, nfe=min(comparison.nfes))
        plot_learning_curves(
            comparison.losses(store), curve, out / f"learning_curves{end}", title=title
        )
        if rendering_backend() is not None:
            _film(comparison, store, end)
    if rendering_backend() is None:
        print(
            "No filmstrips: neither EGL nor OSMesa works here. On Debian or Ubuntu: "
            "apt-get install libegl1 libegl-mesa0 (or libosmesa6)."
        )


def _film(comparison: Comparison, store: Store, end: str) -> None:
    """An episode of every source's first policy, in pictures and, where PyAV is there, as a film."""
    films = find_spec("av") is not None
    if not films:
        print("No videos: they need PyAV, as in: pip install 'warmprior[lerobot]'")
    mine = [c for c in comparison.contestants if c.store is store]
    label = source_labels([Row(c.facts(), {}) for c in mine])
    first = {label(Row(c.facts(), {})): c for c in reversed(mine)}
    for name, contestant in reversed(first.items()):
        nfe = min(contestant.method.allowed_nfes(comparison.nfes))
        slug = re.sub(r"[^\w.]+", "-", name if "," in name else contestant.method.name)
        video = comparison.directory / f"film_{slug}{end.removesuffix('.png')}.mp4"
        strip = record_filmstrip(
            comparison.player(contestant),
            seed=EVALUATION_SEED,
            nfe=nfe,
            policy_seed=contestant.training.seed,
            video=video if films else None,
            **comparison.recipe.evaluation.environment,
        )
        outcome = "solved" if strip.success else "not solved"
        plot_filmstrip(
            strip.frames,
            [f"step {step}" for step in strip.steps],
            comparison.directory / f"filmstrip_{slug}{end}",
            title=f"{name}, NFE {nfe}, episode {EVALUATION_SEED}: {outcome}",
        )
