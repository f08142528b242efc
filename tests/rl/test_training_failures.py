"""Training in source space: what is refused, and what failures leave behind."""

from __future__ import annotations

import os
import signal
from functools import partial

import pytest
import torch
from torchrl.envs import SerialEnv, TransformedEnv

from tests.rl.training_parts import (
    ALGORITHMS,
    EVALUATION_SEED,
    H,
    SolvableEnv,
    make_actor,
    make_config,
    make_env,
    make_training,
)
from warmprior import GaussianPrior, PastPrior, PreviewPrior, PriorAnchor, policy_transforms
from warmprior.rl import PriorSpaceConfig, PriorSpaceTraining
from warmprior.training import parallel_env

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


@pytest.mark.parametrize("wiring", ["keys", "shape"])
def test_a_replay_buffer_of_another_wiring_is_refused(tmp_path, wiring):
    from safetensors.torch import load_file, save_file

    training = make_training(tmp_path, environment_steps=30)
    training.run()
    (segment,) = (tmp_path / "buffer").iterdir()
    tensors = load_file(segment)
    if wiring == "keys":  # PriorSpace writes the chunk elsewhere
        tensors['["next", "decoded", "chunk"]'] = tensors.pop('["vla_action", "chunk"]')
        message = r"another wiring: it lacks \[\('vla_action', 'chunk'\)\].*decoded"
    else:
        delta = '["prior", "delta"]'
        tensors[delta] = tensors[delta][:, :-1].clone()
        message = r"another policy: its .*delta.* is .*\(P, d_a\) = \(3, 2\)"
    save_file(tensors, segment)
    with pytest.raises(ValueError, match=message):
        make_training(tmp_path, environment_steps=30)


def fill_critic(training):
    with torch.no_grad():
        next(iter(training.agent.loss.qvalue_network_params.values(True, True))).fill_(torch.nan)


def fill_actor(training):
    with torch.no_grad():
        for value in training.agent.loss.actor_network_params.values(True, True):
            value.fill_(torch.nan)


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


def test_a_policy_that_is_nan_never_reaches_the_simulator(tmp_path):
    seen = []

    def hook(out):
        seen.append(out["observation"].clone())
        if len(seen) == 40:
            training.agent.learn = lambda buffer: {}
            fill_actor(training)
        return out

    training = make_training(tmp_path, env={"hook": hook}, warmup_steps=10)
    with pytest.raises(FloatingPointError, match=r"NaN or infinity in .*delta.*chunk.*the policy"):
        training.run()
    assert torch.isfinite(torch.stack(seen)).all()


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
        (PastPrior(4), r"chunks of \(P, d_a\) = \(4, 2\), but the policy predicts \(3, 2\)"),
        (PreviewPrior(H), r"chunks of \(P, d_a\) = \(6, 2\)"),
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


def test_an_action_width_of_another_policy_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"\(3, 2\), but the policy predicts \(3, 1\)"):
        make_training(tmp_path, make_actor(action_dim=1), {"actor": make_actor()}).run()


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


def test_an_environment_without_an_anchor_is_refused_before_any_work(tmp_path):
    def bare(seed):
        bases = [SolvableEnv(length) for length in (5, 7)]
        transforms = policy_transforms(PastPrior(H), observation_steps=1)
        return TransformedEnv(SerialEnv(2, [lambda base=base: base for base in bases]), transforms)

    training = PriorSpaceTraining(
        make_actor(), bare, make_config(), tmp_path, evaluation_seed=EVALUATION_SEED
    )
    with pytest.raises(KeyError, match="append PriorAnchor"):
        training.run()
    assert training.curve == []


def test_an_environment_that_does_not_start_closes_the_other(tmp_path):
    opened = []

    def broken(seed):
        if opened:
            raise OSError("no simulator left")
        opened.append(make_env(seed))
        return opened[0]

    training = PriorSpaceTraining(
        make_actor(), broken, make_config(), tmp_path, evaluation_seed=EVALUATION_SEED
    )
    with pytest.raises(OSError, match="no simulator left"):
        training.run()
    assert opened[0].is_closed


class MortalEnv(SolvableEnv):
    """Takes its process along in the fifth episode of a training."""

    def __init__(self, seed_offset=0, seed_stride=1):
        super().__init__(5)
        self.training = False

    def _set_seed(self, seed):
        self.training = seed != EVALUATION_SEED

    def _step(self, tensordict):
        if self.training and self.episode > 3:
            os.kill(os.getpid(), signal.SIGKILL)
        return super()._step(tensordict)


def test_a_killed_worker_ends_the_training(tmp_path):
    """And does not let it wait for hours."""
    actor = make_actor()

    def mortal(seed):
        transforms = partial(policy_transforms, actor.prior, observation_steps=1)
        env = TransformedEnv(parallel_env(MortalEnv, transforms, 2), PriorAnchor(actor))
        env.set_seed(seed or EVALUATION_SEED, static_seed=True)
        return env

    training = PriorSpaceTraining(actor, mortal, make_config(), tmp_path, evaluation_seed=EVALUATION_SEED)
    with pytest.raises(RuntimeError, match=r"worker \d of 2 \(exit code -9\)"):
        training.run()
    # Four episodes of five steps in two environments, with one save on the way.
    assert make_training(tmp_path).steps == 30


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"algorithm": "sac"}, "algorithm must be dsrl-na or dsrl-sac, got 'sac'"),
        ({"delta": 0.0}, "delta must be a finite number > 0, got 0.0"),
        ({"delta": -1.0}, "delta must be a finite number > 0"),
        ({"delta": float("nan")}, "delta must be a finite number > 0"),
        ({"warmup_steps": 0}, "warmup_steps must be at least 1"),
        ({"updates": 0}, "updates must be at least 1"),
        ({"evaluation_episodes": 0}, "evaluation_episodes must be at least 1"),
        ({"warmup_steps": 9, "environment_steps": 8}, r"warmup_steps \(9\) exceed .* \(8\)"),
        ({"gamma": 1.5}, r"gamma must lie in \(0, 1\], got 1.5"),
        ({"tau": 0.0}, r"tau must lie in \(0, 1\], got 0.0"),
        ({"noise_critic_steps": 0}, "noise_critic_steps must be at least 1"),
        ({"hidden_dim": 0}, "hidden_dim must be at least 1"),
        ({"backup": "max"}, "backup must be 'min' or 'mean', got 'max'"),
        ({"reward_offset": float("nan")}, "reward_offset must be a finite number"),
        ({"target_entropy": float("inf")}, "target_entropy must be a finite number"),
        ({"algorithm": "dsrl-sac", "backup_entropy": False}, "dsrl-sac has .* leave them out"),
        ({"algorithm": "dsrl-sac", "backup": "mean"}, "dsrl-sac has .* leave them out"),
        ({"learning_rate": 0.0}, "learning_rate must be a finite number > 0"),
        ({"alpha_init": -1.0}, "alpha_init must be a finite number > 0"),
    ],
)
def test_bad_recipes(options, message):
    with pytest.raises(ValueError, match=message):
        PriorSpaceConfig(**options)
