"""What is easily done wrong with the library's parts, and what the error says."""

from __future__ import annotations

import multiprocessing
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import GymEnv, TransformedEnv
from torchrl.record.loggers.csv import CSVLogger

from warmprior import PastPrior, VelocityMLP, WarmPriorActor, policy_transforms, window_transforms
from warmprior.training import BehaviourCloning, TrainingConfig

PRIOR = PastPrior(4)


def actor(**options) -> WarmPriorActor:
    return WarmPriorActor(VelocityMLP(1, 3, 4, 1, hidden_dim=8), PRIOR, **options)


def steps() -> TensorDict:
    data = {
        "observation": torch.randn(20, 3),
        "action": torch.randn(20, 1),
        "episode": torch.arange(20) // 10,
    }
    return TensorDict(data, [20])


def test_a_vector_environment_of_gymnasium_cannot_execute_chunks():
    """It would play the rest of a chunk in the next episode."""
    env = TransformedEnv(GymEnv("Pendulum-v1", num_envs=2), policy_transforms(PRIOR, observation_steps=1))
    with pytest.raises(RuntimeError, match="SerialEnv or ParallelEnv"):
        env.rollout(2, actor())
    env.close()


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
