"""Training in source space: what is refused, and what failures leave behind."""

from __future__ import annotations

import pytest
import torch

from tests.rl.training_parts import (
    ALGORITHMS,
    EVALUATION_SEED,
    H,
    make_actor,
    make_config,
    make_env,
    make_training,
)
from warmprior import GaussianPrior, PastPrior, PreviewPrior
from warmprior.rl import PriorSpaceConfig, PriorSpaceTraining

pytest.importorskip("tqdm")


def test_a_state_of_something_else_is_refused(tmp_path):
    make_training(tmp_path, environment_steps=30).run()
    files = {path: path.read_bytes() for path in tmp_path.rglob("*.safetensors")}
    for part, options in {
        "config": {"gamma": 0.5},
        "prior": {"actor": make_actor(PastPrior(H, sigma=0.25))},
        "policy": {"actor": make_actor(seed=1)},
    }.items():
        with pytest.raises(ValueError, match=rf"belongs to another {part}.*another output folder"):
            make_training(tmp_path, **{"environment_steps": 30, **options})
    assert files == {path: path.read_bytes() for path in tmp_path.rglob("*.safetensors")}


def fill_critic(training):
    with torch.no_grad():
        next(iter(training.agent.loss.qvalue_network_params.values(True, True))).fill_(torch.nan)


def stop_learning(training):
    """No loss is computed any more that could tell."""
    training.agent.learn = lambda buffer: {}
    fill_critic(training)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (fill_critic, r"NaN or infinity in .*loss_qvalue.*: the training has diverged"),
        (stop_learning, r"NaN or infinity in loss/qvalue_network.*: the training has diverged"),
    ],
)
def test_nan_stops_the_training_and_the_last_state_stays(tmp_path, algorithm, spoil, message):
    options = {"algorithm": algorithm, "warmup_steps": 10}
    count = iter(range(1, 10_000))

    def hook(out):
        if next(count) == 40:
            spoil(training)
        return out

    training = make_training(tmp_path, env={"hook": hook}, **options)
    with pytest.raises(FloatingPointError, match=message):
        training.run()
    again = make_training(tmp_path, **options)
    assert 30 <= again.steps < 40 and len(again.curve) == 3
    assert all(torch.isfinite(value).all() for value in again.agent.state().values())
    again.run()
    assert again.steps >= 90


@pytest.mark.parametrize("key", ["reward", "observation"])
def test_nan_from_the_environment_is_never_saved(tmp_path, key):
    count = iter(range(1, 10_000))

    def hook(out):
        if next(count) >= 40:
            out[key] = torch.full_like(out[key], torch.nan)
        return out

    with pytest.raises(FloatingPointError, match=rf"NaN or infinity in .*'next', '{key}'"):
        make_training(tmp_path, env={"hook": hook}).run()
    again = make_training(tmp_path)
    assert 30 <= again.steps < 40
    assert all(torch.isfinite(v.float()).all() for v in again.buffer[:].values(True, True))


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        (PastPrior(4), r"4, 2\], expected \[.*3, 2\]"),
        (PreviewPrior(H), r"6, 2\], expected"),
    ],
)
def test_an_environment_of_another_policy_is_refused_before_any_work(tmp_path, prior, message):
    opened = []

    def spied(seed):
        opened.append(make_env(seed, make_actor(prior)))
        return opened[-1]

    training = PriorSpaceTraining(
        make_actor(), spied, make_config(), tmp_path, evaluation_seed=EVALUATION_SEED
    )
    with pytest.raises(ValueError, match=message):
        training.run()
    assert len(opened) == 2 and all(env.is_closed for env in opened)
    assert not training.state_path.exists()


@pytest.mark.parametrize("prior_class", [PastPrior, GaussianPrior])
def test_chunks_executed_in_part_are_refused_where_the_mean_would_hold_them(tmp_path, prior_class):
    prior = prior_class(H)
    training = make_training(tmp_path, make_actor(prior), {"execute": 2})
    if prior_class is GaussianPrior:
        training.run()
        return
    with pytest.raises(ValueError, match="executes 2 of H = 3 actions per decision"):
        training.run()
    assert len(training.buffer) == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"algorithm": "sac"}, "algorithm must be dsrl-na or dsrl-sac, got 'sac'"),
        ({"delta": 0.0}, "delta must be a finite number > 0, got 0.0"),
        ({"warmup_steps": 0}, "warmup_steps must be a whole number of at least 1"),
        ({"warmup_steps": 9, "environment_steps": 8}, r"warmup_steps \(9\) exceed .* \(8\)"),
        ({"gamma": 1.5}, r"gamma must lie in \(0, 1\], got 1.5"),
        ({"noise_critic_steps": 0}, "noise_critic_steps must be a whole number of at least 1"),
        ({"reward_offset": float("nan")}, "reward_offset must be a finite number"),
        ({"algorithm": "dsrl-sac", "backup_entropy": False}, "dsrl-sac has .* leave it out"),
    ],
)
def test_bad_recipes(options, message):
    with pytest.raises(ValueError, match=message):
        PriorSpaceConfig(**options)
