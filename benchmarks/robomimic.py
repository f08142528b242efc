"""The paper's Table 1: Gaussian source, WP-Past and WP-Preview on Robomimic tasks from state.

python benchmarks/robomimic.py                                   # a first table within 15 minutes
python benchmarks/robomimic.py --task can --data mh --preset cpu
python benchmarks/robomimic.py --download --preset paper --device cuda --out runs/paper
python benchmarks/robomimic.py --resume --out runs/paper         # after an interruption
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

import _experiment as experiment

from warmprior import Prior
from warmprior.diagnostics.plots import plot_filmstrip, plot_learning_curves, plot_success
from warmprior.diagnostics.results import success_table
from warmprior.envs import rendering_backend
from warmprior.envs.tasks import EVALUATION_SEED
from warmprior.io.files import write_atomic
from warmprior.training.comparison import Comparison
from warmprior.training.filmstrip import record_filmstrip


def add_options(parser: argparse.ArgumentParser) -> Callable[..., argparse.Action]:
    """Add the options of a comparison of sources and return ``parser.add_argument``."""
    add = experiment.add_options(parser)
    experiment.add_prior(parser, experiment.COMPARED, "what to compare, gains being over the first")
    add("--sigma", type=float, help="noise of the warm priors (default: past 0.5, preview 1.0)")
    add("--nfe", nargs="+", type=int, default=[9, 3, 1], help="evaluations per chunk (%(default)s)")
    add("--chunk", type=int, default=8, help="chunk length H (%(default)s)")
    return add


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_options(parser)
    return parser


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    return experiment.parse(make_parser, argv)


def make_priors(args: argparse.Namespace) -> list[Prior]:
    names = list(dict.fromkeys(args.prior))
    if args.sigma is not None and not any(Prior.find(name).takes("sigma") for name in names):
        raise ValueError(f"--sigma belongs to warm priors; {', '.join(names)} take none")
    options = {"sigma": args.sigma, "cold_probability": args.cold_probability}
    return [Prior.make(name, args.chunk, **options) for name in names]


def draw(comparison: Comparison) -> None:
    results, out, policies = comparison.results, comparison.directory, comparison.policies
    priors = [prior.name for prior in comparison.priors]
    first = results.rows[0]
    title = f"{first.task} {first.data} ({results.meta['data_source']} data), H = {first.chunk}"
    plot_success(
        results.rows, out / "success.png", priors=priors, nfes=comparison.nfes, title=title
    )
    plot_learning_curves(
        comparison.losses,
        results.rows,
        out / "learning_curves.png",
        nfe=min(comparison.nfes),
        title=title,
    )
    if rendering_backend() is None:
        print(
            "No filmstrips: neither EGL nor OSMesa works here. On Debian or Ubuntu: "
            "apt-get install libegl1 libegl-mesa0 (or libosmesa6)."
        )
        return
    for prior in comparison.priors:
        nfe = min(prior.allowed_nfes(comparison.nfes))
        policy = policies.policy(prior, comparison.seeds[0])
        strip = record_filmstrip(
            policy,
            policies.make_env,
            policies.transforms(policy.prior),
            seed=EVALUATION_SEED,
            nfe=nfe,
            policy_seed=comparison.seeds[0],
        )
        outcome = "solved" if strip.success else "not solved"
        plot_filmstrip(
            strip.frames,
            [f"step {step}" for step in strip.steps],
            out / f"filmstrip_{prior.name}.png",
            title=f"{prior.label}, NFE {nfe}, episode {EVALUATION_SEED}: {outcome}",
        )


def main(argv: list[str] | None = None) -> int:
    try:
        args = parse(argv)
        preset, priors = experiment.make_preset(args), make_priors(args)
        comparison = experiment.start_comparison(args, preset, priors, args.nfe)
        results = comparison.run()
        table = success_table(
            results, priors=[p.name for p in priors], nfes=comparison.nfes, top_k=preset.top_k
        )
        write_atomic(args.out / "table.md", lambda path: path.write_text(table))
        draw(comparison)
    except experiment.ERRORS as error:
        print(f"robomimic.py: error: {error}", file=sys.stderr)
        return 2
    print(f"\n{table}\nResults, table and pictures: {args.out}")
    return 0


if __name__ == "__main__":
    experiment.launch(main)
