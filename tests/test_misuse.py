"""What is easily done wrong with the library's parts, and what the error says."""

from __future__ import annotations

import multiprocessing
import pickle
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import GymEnv, RenameTransform, TransformedEnv
from torchrl.record.loggers.csv import CSVLogger

from tests.toy_env import demonstrations
from warmprior import (
    PastPrior,
    RealTimeChunking,
    VelocityMLP,
    WarmPriorActor,
    policy_transforms,
    window_transforms,
)
from warmprior.training import BehaviourCloning, NetworkOptions, TrainingConfig, ema_of, train_policy

PRIOR = PastPrior(4)


def actor(**options) -> WarmPriorActor:
    return WarmPriorActor(VelocityMLP(1, 3, 4, 1, hidden_dim=8), PRIOR, **options)


def steps() -> TensorDict:
    return demonstrations(20, 10, d_a=1)


@pytest.mark.parametrize("frame", [-1, 20])
def test_a_step_that_the_data_do_not_hold(frame):
    windows = window_transforms(steps(), PRIOR, observation_steps=1)
    with pytest.raises(IndexError, match="data hold 0 to 19"):
        windows(TensorDict({"frame": torch.tensor([0, frame])}, [2]))


def test_a_generator_stays_in_its_process():
    """Workers that were all given one would draw the same noise."""
    policy = actor(generator=torch.Generator())
    process = multiprocessing.get_context("spawn").Process(target=partial(policy, None))
    with pytest.raises(RuntimeError, match="set_seed"):
        process.start()


def test_a_training_is_of_its_units(tmp_path):
    """The same data in other units look alike once they are normalised."""
    config = TrainingConfig(iterations=1, batch_size=4)
    options = {"network": NetworkOptions(hidden_dim=8, observation_steps=1), "description": None}
    data = steps()
    train_policy(data, PRIOR, tmp_path / "run", training=config, **options)
    with pytest.raises(ValueError, match="belongs to another policy"):
        doubled = data.apply(lambda value: value * 2 if value.is_floating_point() else value)
        train_policy(doubled, PRIOR, tmp_path / "run", training=config, **options)


@pytest.mark.parametrize(
    ("data", "prior", "error", "said"),
    [
        ({"action": 1}, PRIOR, TypeError, "got dict"),
        (TensorDict(dict(steps().items()), []), PRIOR, ValueError, "must be flat steps"),
        (steps(), PastPrior, TypeError, "an object such as PastPrior"),
        (steps().exclude("episode"), PRIOR, KeyError, r"missing: .'episode'"),
    ],
)
def test_what_train_policy_cannot_take(data, prior, error, said):
    with pytest.raises(error, match=said):
        train_policy(data, prior)


def test_train_policy_gives_the_global_generator_back():
    config = TrainingConfig(iterations=1, batch_size=4)
    network = NetworkOptions(hidden_dim=8, observation_steps=1)
    data = steps()
    torch.manual_seed(3)
    expected = torch.rand(2)
    torch.manual_seed(3)
    train_policy(data, PRIOR, network=network, training=config, description=None)
    assert torch.equal(torch.rand(2), expected)


def test_averages_can_be_pickled():
    average = pickle.loads(pickle.dumps(ema_of(VelocityMLP(1, 3, 4, 1, hidden_dim=8))))
    average.update_parameters(VelocityMLP(1, 3, 4, 1, hidden_dim=8))


def test_an_environment_of_a_guided_policy_with_an_observation_of_another_name():
    guided = actor(guidance=RealTimeChunking(), observation_key="state")
    base = TransformedEnv(GymEnv("Pendulum-v1"), RenameTransform(["observation"], ["state"]))
    env = TransformedEnv(base, policy_transforms(guided), auto_unwrap=False)
    assert env.rollout(2, guided)["vla_action", "chunk"].shape == (2, 4, 1)


def test_a_log_that_cannot_be_written_is_named(tmp_path, monkeypatch):
    logger = CSVLogger("run", log_dir=str(tmp_path / "logs"))

    def full(*args, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(logger, "log_scalar", full)
    config = TrainingConfig(iterations=1, batch_size=4, checkpoints=1)
    training = BehaviourCloning(
        actor(), steps(), config, tmp_path / "run", observation_steps=1, logger=logger
    )
    with pytest.raises(OSError, match=r"cannot write the log.*logs"):
        training.run(None)
