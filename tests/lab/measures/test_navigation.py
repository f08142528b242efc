"""The toy shows what the paper says it shows (Sec. 5.2, Fig. 5)."""

import math

import pytest
import torch

from lab.demonstrations.loading import navigation_task
from lab.measures.navigation import judge_navigation, play_navigation
from lab.methods.methods import PointPrior
from warmprior import GaussianPrior, PastPrior, PreviewPrior
from warmprior.diagnostics import SharedObservations, branching_bound, curvature, executed_actions
from warmprior.envs import navigation_metrics
from warmprior.training import NetworkOptions, TrainingConfig, train_policy

SOURCES = {
    "gaussian": (lambda: GaussianPrior(4), {}, {}),
    "regression": (lambda: PointPrior(4), {"max_nfe": 1}, {"times": "start"}),
    "history": (lambda: GaussianPrior(4), {"see_history": True}, {}),
    "past": (lambda: PastPrior(4, sigma=0.1), {}, {}),
    "wide": (lambda: PastPrior(4, sigma=0.5), {}, {}),
    "preview": (lambda: PreviewPrior(4, sigma=0.1), {}, {}),
}


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("policies")

    def train(name, iterations, seed=1):
        make, options, recipe = SOURCES[name]
        recipe |= {"iterations": iterations, "save_every": iterations, "checkpoints": 1, "seed": seed}
        recipe |= {"batch_size": 256, "learning_rate": 2e-3, "warmup_ratio": 0.0}
        recipe["cold_probability"] = 0.0 if name in ("gaussian", "regression") else 0.1
        options |= {"network": NetworkOptions("mlp,hidden_dim=128", observation_steps=1), "description": None}
        out = folder / f"{name}-{iterations}-{seed}"
        return train_policy(navigation_task(), make(), out, training=TrainingConfig(**recipe), **options)

    return train


@pytest.mark.parametrize("name", ["regression", "preview"])
def test_judgements_are_reproducible_and_of_what_was_played(trained, name):
    actor, nfe = trained(name, 5), 1 if name == "regression" else 9
    row = judge_navigation(actor, 1, nfe=nfe, rollouts=8)
    again = judge_navigation(actor, 1, nfe=nfe, rollouts=8)
    assert row == pytest.approx(again, nan_ok=True)
    heights = executed_actions(play_navigation(actor, 1, nfe=nfe, rollouts=8))[0]
    assert heights.shape == (8, 64, 1) and actor.sampler.generator is None
    metrics = navigation_metrics(heights.squeeze(-1), 4)
    assert row["collision_rate"] == metrics.collision_rate
    assert row["distance"] == pytest.approx(metrics.distance, nan_ok=True)


def bent(actor, seed, draws=4, steps=100):
    """Curvature and branching bound on demonstrated observations."""
    batch = SharedObservations(navigation_task().data, 4).windows(actor.prior)
    generator = torch.Generator().manual_seed(seed)
    kappa = curvature(actor, batch, steps, draws=draws, generator=generator)["kappa"].nanmean()
    return float(kappa), float(branching_bound(batch, actor.prior)["total"].nanmean())


def test_warm_sources_stop_mode_switching(trained):
    """A tenth of the benchmark's budget, one seed: the contrast is far larger than what that costs."""
    base, past = trained("gaussian", 300, 0), trained("past", 300, 0)
    of_base, of_past = (judge_navigation(actor, 0, nfe=9, rollouts=64) for actor in (base, past))
    assert of_base["switch_rate"] > 0.4 and of_base["collision_rate"] > 0.8
    assert of_past["switch_rate"] < 0.05 and of_past["collision_rate"] < 0.3
    (kappa, bound), (warm_kappa, warm_bound) = (bent(actor, 0, 1, 10) for actor in (base, past))
    assert warm_kappa < 0.3 * kappa and warm_bound < bound


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_the_figure_at_the_benchmarks_budget(trained, seed):
    names = ("gaussian", "regression", "history", "past", "wide")
    actors = {name: trained(name, 3_000, seed) for name in names}
    base, regression, history, sharp, wide = (
        judge_navigation(actor, seed, nfe=1 if name == "regression" else 9) for name, actor in actors.items()
    )
    assert base["switch_rate"] > 0.4 and base["collision_rate"] > 0.8
    assert sharp["switch_rate"] < 0.03 and sharp["collision_rate"] < 0.15
    assert wide["route_entropy"] > 1.6 and wide["collision_rate"] < 0.15
    assert regression["collision_rate"] == 1.0 and math.isnan(regression["switch_rate"])
    # Conditioning commits as well, but on a history that is slightly wrong it leaves the data.
    assert history["switch_rate"] < 0.03
    assert history["shifted_distance"] > 2 * sharp["shifted_distance"]
    kappas = [bent(actors[name], seed)[0] for name in ("past", "wide", "gaussian")]
    assert kappas[0] < kappas[1] < 0.3 * kappas[2]
    # Each decision of the base alone is right: it stays near the data, on either side.
    assert base["distance"] < 0.1
