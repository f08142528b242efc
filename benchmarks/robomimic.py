"""The paper's Table 1: Gaussian source, WP-Past and WP-Preview on Robomimic tasks.

python benchmarks/robomimic.py                                   # a first table within 15 minutes
python benchmarks/robomimic.py --task can stack --data ph mh --preset cpu
python benchmarks/robomimic.py --obs image                       # lift from two cameras
python benchmarks/robomimic.py --download --preset paper --device cuda --out runs/paper
python benchmarks/robomimic.py --resume --out runs/paper         # after an interruption
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from importlib.util import find_spec

from warmprior.envs import rendering_backend
from warmprior.envs.tasks import EVALUATION_SEED
from warmprior.experiments import (
    PRESETS,
    Comparison,
    Row,
    comparison_preset,
    flow_table,
    parse,
    plot_filmstrip,
    plot_learning_curves,
    plot_success,
    select,
    source_labels,
    started,
    success_table,
    write_report,
)
from warmprior.experiments.record import variation_notes
from warmprior.experiments.store import Store
from warmprior.io.script import run_script
from warmprior.training import record_filmstrip


def notes(comparison: Comparison) -> list[str]:
    recipe, paper = comparison.recipe, PRESETS["paper"]
    variations = variation_notes(recipe)
    if recipe.network == paper.network and recipe.training.iterations >= paper.training.iterations:
        return variations
    return [*variations, "- Network and training budget are smaller than the paper's."]


def draw(comparison: Comparison, rows: Sequence[Row]) -> None:
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
            film(comparison, store, end)
    if rendering_backend() is None:
        print(
            "No filmstrips: neither EGL nor OSMesa works here. On Debian or Ubuntu: "
            "apt-get install libegl1 libegl-mesa0 (or libosmesa6)."
        )


def film(comparison: Comparison, store: Store, end: str) -> None:
    """An episode of every source's first policy, in pictures and, where PyAV is there, as a film."""
    films = find_spec("av") is not None
    if not films:
        print("No videos: they need PyAV, as in: pip install 'warmprior[lerobot]'")
    mine = [c for c in comparison.contestants if c.store is store]
    label = source_labels([Row(c.facts(), {}) for c in mine])
    first = {label(Row(c.facts(), {})): c for c in reversed(mine)}
    for name, contestant in reversed(first.items()):
        nfe = min(contestant.prior.allowed_nfes(comparison.nfes))
        slug = re.sub(r"[^\w.]+", "-", name if "," in name else contestant.prior.name)
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


def run(argv: Sequence[str] | None) -> None:
    recipe = parse(PRESETS, argv, study="robomimic", description=__doc__, preset=comparison_preset)
    with started(recipe, "robomimic") as out:
        comparison = Comparison(recipe, "robomimic")
        comparison.run()
        rows = comparison.rows
        source = comparison.stores[0].problem.facts["source"]
        table = success_table(
            rows, top_k=recipe.evaluation.top_k, source=source, notes=notes(comparison)
        )
        draw(comparison, rows)
        write_report(out, f"{table}\n{flow_table(comparison.timed())}", comparison.failures)


def main(argv: Sequence[str] | None = None) -> int:
    return run_script(lambda: run(argv), "robomimic.py")


if __name__ == "__main__":
    sys.exit(main())
