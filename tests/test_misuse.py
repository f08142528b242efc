"""What is easily done wrong with the library's parts, and what the error says."""

import pickle
from copy import deepcopy
from functools import partial
from multiprocessing.context import set_spawning_popen
from multiprocessing.popen_spawn_posix import _DupFd
from multiprocessing.reduction import ForkingPickler
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import GymEnv, RenameTransform, TransformedEnv
from torchrl.record.loggers.csv import CSVLogger

from tests.errors import raises, refuses
from tests.processes import apart
from tests.toy_env import demonstrations, mlp_actor
from warmprior import (
    CameraImages,
    HistoryObservation,
    Normalizer,
    PastPrior,
    Prior,
    PriorDecoder,
    RealTimeChunking,
    ResidualSampler,
    SourceMoments,
    VelocityMLP,
    WarmPriorActor,
    policy_transforms,
    window_transforms,
)
from warmprior.envs import environment_of
from warmprior.envs.description import registered_description
from warmprior.history import cold_history
from warmprior.keys import CHUNK
from warmprior.training import BehaviourCloning, NetworkOptions, TrainingConfig, ema_of, train_policy

PRIOR = PastPrior(4)
CONFIG = TrainingConfig(iterations=1, batch_size=4, checkpoints=1)
NETWORK = NetworkOptions("mlp,hidden_dim=8", observation_steps=1)
SHORT = {"network": NETWORK, "training": CONFIG, "description": None}
actor = partial(mlp_actor, PRIOR, 1, 3, 1)


def steps():
    return demonstrations(20, 10, d_a=1)


def sent(module, monkeypatch):
    """The copy of a module that a worker process gets."""
    with monkeypatch.context() as patch:
        patch.setattr("warmprior.modules.generator.get_spawning_popen", lambda: object())
        return pickle.loads(pickle.dumps(module))


def test_a_generator_stays_in_its_process(monkeypatch):
    """Workers that were all given one would draw the same noise, so they say so where they draw."""
    policy, data = actor(generator=torch.Generator()), window_transforms(steps(), PRIOR, observation_steps=1)
    decoder = PriorDecoder(policy, delta=0.5)
    batch = data(TensorDict({"frame": torch.tensor([3])}, [1])).set("prior", {"anchor": torch.zeros(1, 4, 1)})
    for module in (policy, ResidualSampler(decoder, generator=torch.Generator())):
        copy = sent(module, monkeypatch)
        with raises(RuntimeError, "same noise", "set_seed"):
            copy(batch.copy())
        assert module(batch.copy()) is not None
    assert sent(policy, monkeypatch)(batch.copy(), generator=torch.Generator()) is not None
    assert sent(actor(), monkeypatch)(batch.copy()) is not None


def test_a_generator_does_not_draw_in_forked_workers():
    windows = window_transforms(steps(), PRIOR, observation_steps=1)
    data, policy = windows(TensorDict({"frame": torch.tensor([3])}, [1])), actor(generator=torch.Generator())

    @apart
    def drawn():
        for same in (policy, deepcopy(policy), policy.replace(nfe=1)):
            with raises(RuntimeError, "same noise", "set_seed"):
                same(data.copy())
        others = [policy.replace(generator=own) for own in (None, torch.Generator())]
        return [other(data.copy())[CHUNK].shape for other in others]

    assert drawn() == 2 * [policy(data.copy())[CHUNK].shape]

    @apart
    def made():
        return pickle.dumps([policy, policy.replace(generator=torch.Generator())])

    left, own = pickle.loads(made())
    with raises(RuntimeError, "same noise", "set_seed"):
        left(data.copy())
    assert own(data.copy())[CHUNK].shape == policy(data.copy())[CHUNK].shape


def test_a_policy_with_a_generator_can_be_sent():
    """An error while TorchRL's collectors send a policy would leave its weights on the device meta."""
    set_spawning_popen(SimpleNamespace(DupFd=_DupFd, duplicate_for_child=lambda file: file))
    try:
        assert ForkingPickler.dumps(actor(generator=torch.Generator())).nbytes
    finally:
        set_spawning_popen(None)


def test_a_training_is_of_its_units(tmp_path):
    """The same data in other units look alike once they are normalised."""
    data = steps()
    train_policy(data, PRIOR, tmp_path / "run", **SHORT)
    with raises(ValueError, "demonstrations"):
        doubled = data.apply(lambda value: value * 2 if value.is_floating_point() else value)
        train_policy(doubled, PRIOR, tmp_path / "run", **SHORT)


def test_what_train_policy_cannot_take():
    for data, prior, error, fact in (
        ({"action": 1}, PRIOR, TypeError, "dict"),
        (TensorDict(dict(steps().items()), []), PRIOR, ValueError, "steps"),
        (steps(), PastPrior, TypeError, "PastPrior"),
        (steps().exclude("episode"), PRIOR, KeyError, "missing: ['episode']"),
    ):
        with raises(error, fact):
            train_policy(data, prior)
    refuses(lambda: train_policy(steps(), PRIOR, device="gpu"), ValueError, "gpu", "choose another")


def velocity(entries):
    return VelocityMLP(1, 3, 4, 1, hidden_dim=8)(torch.zeros(2), torch.zeros(2, 4, 1), entries)


def moments(*values):
    return SourceMoments(*(torch.full((4, 1), value) for value in values))


def recorded(**entries):
    return train_policy(steps().update(entries), PRIOR, **SHORT)


def seeing(**entries):
    """An environment's step for a network that sees the last actions."""
    observation = TensorDict(entries, [2])
    history = cold_history([2], 4, 4, 1)
    return HistoryObservation()(TensorDict({"observation": observation, "history": history}, [2]))


ONE = {"history": cold_history([1], 4, 4, 1), "observation": torch.zeros(1, 1, 3)}
ONE |= {"vla_action": {"chunk": torch.zeros(1, 4, 1)}, "action_is_pad": torch.zeros(1, 4, dtype=torch.bool)}


def stateful():
    """An environment with a state, but no simulator that renders it."""
    names = ["observation"], ["sim_state"]
    return TransformedEnv(GymEnv("Pendulum-v1"), RenameTransform(*names, create_copy=True))


@pytest.mark.parametrize(
    ("call", "error", "facts"),
    [
        (lambda: WarmPriorActor(VelocityMLP(1, 3, 8, 1), PRIOR), ValueError, [8, 4, "prediction_length"]),
        (lambda: actor(clip=(1.0, 1.0)), ValueError, ["clip", 2, 1]),
        (lambda: velocity(TensorDict(arm=torch.zeros(2, 1, 3))), ValueError, ["'arm'", "(1, 3)"]),
        (lambda: VelocityMLP(1, 3, 4, timestep_embedding_dim=5), ValueError, ["even", 5]),
        (lambda: Prior(4).distribution(ONE["history"]), NotImplementedError, ["mean(history)"]),
        (lambda: Normalizer(*2 * [{"action": torch.tensor([torch.nan])}]), ValueError, ["action", "NaN"]),
        (lambda: moments(0.0, 0.0, 1.0, torch.inf, 0.0), ValueError, ["moments", "infinity"]),
        (lambda: SourceMoments(*5 * [torch.zeros(4)]), ValueError, ["[P, d_a]", "(4,)"]),
        (lambda: SourceMoments.fit(TensorDict(ONE, [1]), PRIOR), ValueError, [2, "windows", 1]),
        (lambda: policy_transforms("past"), TypeError, ["WarmPriorActor", "Prior", "str"]),
        (lambda: seeing(arm=torch.zeros(2, 1, 3)), ValueError, ["'arm'", "state"]),
        (
            lambda: TransformedEnv(stateful(), CameraImages(["front"], size=8)).reset(),
            RuntimeError,
            ["GymEnv"],
        ),
        (lambda: recorded(episode=torch.zeros(20)), ValueError, ["'episode'", "float32"]),
        (lambda: recorded(episode=torch.full((20,), -1)), ValueError, ["'episode'", 0]),
    ],
)
def test_what_does_not_fit_is_refused(call, error, facts):
    refuses(call, error, *facts)


def test_averages_can_be_pickled():
    average = pickle.loads(pickle.dumps(ema_of(VelocityMLP(1, 3, 4, 1, hidden_dim=8))))
    average.update_parameters(VelocityMLP(1, 3, 4, 1, hidden_dim=8))


def test_an_environment_of_a_guided_policy_with_an_observation_of_another_name():
    guided = actor(guidance=RealTimeChunking(), observation_key="state")
    base = TransformedEnv(GymEnv("Pendulum-v1"), RenameTransform(["observation"], ["state"]))
    env = TransformedEnv(base, policy_transforms(guided), auto_unwrap=False)
    assert env.rollout(2, guided)["vla_action", "chunk"].shape == (2, 4, 1)


def test_an_environment_stacks_the_observations_that_the_network_reads():
    described = registered_description({"id": "Pendulum-v1", "kwargs": {}})
    policy = actor(environment=described)
    assert environment_of(policy, horizon=8).rollout(2, policy)["observation"].shape == (2, 1, 3)


def test_a_log_that_cannot_be_written_is_named(tmp_path, monkeypatch):
    logger = CSVLogger("run", log_dir=str(tmp_path / "logs"))

    def full(*args, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(logger, "log_scalar", full)
    training = BehaviourCloning(actor(), steps(), CONFIG, tmp_path / "run", logger=logger)
    refuses(lambda: training.run(None), OSError, "log", "logs")


def test_a_logger_may_have_no_folder(tmp_path):
    logger = CSVLogger("run", log_dir=str(tmp_path / "logs"))
    logger.log_dir = None  # as that of Weights & Biases
    BehaviourCloning(actor(), steps(), CONFIG, tmp_path / "run", logger=logger).run(None)
    assert (tmp_path / "run" / "state.safetensors").exists()


def test_a_run_of_another_version_is_named(tmp_path, monkeypatch):
    with monkeypatch.context() as before:
        before.setattr("warmprior.saving.training_state.STATE_FORMAT", 0)
        BehaviourCloning(actor(), steps(), CONFIG, tmp_path).run(None)
    refuses(lambda: BehaviourCloning(actor(), steps(), CONFIG, tmp_path), ValueError, "another version")
