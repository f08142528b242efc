import importlib.util
from contextlib import nullcontext

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import TransformedEnv

from lab.demonstrations.loading import navigation_task
from tests.errors import raises, refuses
from tests.rl.training_parts import make_actor, make_env, make_training
from tests.toy_env import ACTION_DIM, CountingEnv, demonstrations
from warmprior import ChiTransformer, HistoryObservation, PastPrior, policy_transforms
from warmprior.data import demonstrations_of
from warmprior.data.formats.hdf5 import RobomimicDemonstrations
from warmprior.deploy import AsyncExecutor
from warmprior.evaluation import evaluate
from warmprior.modules import PreconditionedNetwork
from warmprior.saving import load_policy
from warmprior.tasks import Task
from warmprior.training import NetworkOptions, TrainingConfig, make_network, train_policy
from warmprior.training.networks import check_network
from warmprior.training.train import new_policy

NETWORK = NetworkOptions("mlp,hidden_dim=8", observation_steps=1)
CONFIG = TrainingConfig(iterations=8, batch_size=16, checkpoints=2, save_every=2)
OPTIONS = {"network": NETWORK, "training": CONFIG, "description": None}


def train(folder, prior=None, **options):
    return train_policy(navigation_task(), prior or PastPrior(4), folder, **OPTIONS | options)


def equal(one, two):
    return all(map(torch.equal, one.parameters(), two.parameters()))


def test_what_is_done_before_makes_no_difference(tmp_path):
    policies = []
    for name in ("one", "two"):
        torch.manual_seed(len(policies))
        threads = torch.get_num_threads()
        torch.set_num_threads(1 + len(policies))
        policies.append(train(tmp_path / name))
        assert torch.get_num_threads() == 1 + len(policies) - 1
        torch.set_num_threads(threads)
    assert equal(*policies) and next(policies[0].parameters()).device.type == "cpu"
    other = TrainingConfig(iterations=8, batch_size=16, checkpoints=1, seed=1)
    assert not equal(policies[0], train(tmp_path / "other", training=other))


def test_a_bound_of_ones_own_replaces_that_of_the_demonstrations():
    assert train(None, clip=0.5).sampling.clip == 0.5


def test_gradients_that_rollouts_hold_make_no_difference():
    """As those of `env.rollout(steps, expert)`, which TorchRL does not detach."""
    torch.manual_seed(0)
    values = {"observation": torch.rand(60, 3), "action": torch.rand(60, 2)}
    policies = []
    for of in (torch.Tensor.clone, lambda value: value.clone().requires_grad_() * 1):
        steps = {name: of(value) for name, value in values.items()}
        steps = TensorDict(steps | {"episode": torch.arange(60) // 20}, [60])
        policies.append(train_policy(steps, PastPrior(4), **OPTIONS))
    assert equal(*policies)


@pytest.fixture
def doubles():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_scripts_in_double_precision_train_and_play(doubles, tmp_path, dtype):
    steps = demonstrations(d_o=2 + ACTION_DIM).apply(
        lambda value: value.to(dtype) if value.ndim > 1 else value
    )
    policy = train_policy(steps, PastPrior(4), tmp_path, **OPTIONS)
    assert {value.dtype for value in policy.state_dict().values()} == {torch.float64}
    env = TransformedEnv(CountingEnv(5), policy_transforms(policy))
    assert env.rollout(3, policy)["vla_action", "chunk"].dtype == torch.float64
    torch.set_default_dtype(torch.float32)  # as another script, which loads it
    assert equal(policy, load_policy(tmp_path / "policy_000008"))


def test_a_replay_buffer_that_has_overwritten_steps_is_refused():
    """It holds the end of its last episode before the middle of it."""
    steps = demonstrations(length=60)
    for room, refused in ((60, False), (50, True)):
        buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(room))
        for part in steps.split(20):
            buffer.extend(part)
        with raises(ValueError, "storage") if refused else nullcontext():
            train_policy(buffer, PastPrior(4), **OPTIONS)


@pytest.mark.parametrize("turned_off", [False, True])
def test_the_environment_turns_bars_off(turned_off, tmp_path, monkeypatch, capsys):
    write_robomimic_file = pytest.importorskip("tests.data.synthetic").write_robomimic_file
    if turned_off:
        monkeypatch.setenv("TQDM_DISABLE", "1")
    spec = importlib.util.find_spec("tqdm.std")
    tqdm = importlib.util.module_from_spec(spec)  # a second one: it reads the environment once
    spec.loader.exec_module(tqdm)
    monkeypatch.setattr("warmprior.io.progress.tqdm", tqdm.tqdm)
    train_policy(navigation_task(), PastPrior(4), network=NETWORK, training=CONFIG, description="train")
    make_training(tmp_path, environment_steps=90, running={"description": "agent"}).run()
    evaluate(make_actor(), make_env(0), episodes=2, first_seed=0, description="play")
    write_robomimic_file(tmp_path / "images.hdf5", lengths=(30,))
    RobomimicDemonstrations(tmp_path / "images.hdf5").steps(images=("agentview_image",))
    said = capsys.readouterr().err
    shown = [f"{name}:" in said for name in ("train", "agent", "play", "of images.hdf5")]
    assert shown == [not turned_off] * 4


def test_what_does_not_exist_is_refused_with_what_does():
    refuses(lambda: navigation_task("ph"), ValueError, "style", "'ph'")
    with raises(ValueError, "network", "mlp, plain_mlp", "'nonsense'"):
        train_policy("missing.hdf5", PastPrior(4), network=NetworkOptions("nonsense"))  # before data are read
    with raises(ValueError, "encoder", "resnet18, small", "'resnet18-imagnet'"):
        NetworkOptions(encoder="resnet18-imagnet")  # its weights would be random


@pytest.mark.parametrize(("name", "value"), [("observation_layers", 2), ("time_frequency", 1e-4)])
def test_options_behind_a_network_s_name_reach_it(name, value):
    for network in ("chi_transformer", "adaln_transformer"):
        usual, made = (
            make_network(NetworkOptions(f"{network},hidden_dim=12{more}"), 2, 3, 4)
            for more in ("", f",{name}={value}")
        )
        assert made.config() == usual.config() | {name: value} != usual.config()
    assert (
        make_network(NetworkOptions("chi_transformer"), 2, 3, 4).config() == ChiTransformer(2, 3, 4).config()
    )
    seeing = NetworkOptions(f"chi_transformer,hidden_dim=12,{name}={value}", encoder="small", crop_size=8)
    network = make_network(seeing, 2, 3, 4, {"camera": 10})  # behind an encoder of images
    assert network.config()["network"][name] == value
    images = {"state": torch.zeros(5, 2, 3), "camera": torch.zeros(5, 2, 3, 10, 10, dtype=torch.uint8)}
    assert network(torch.rand(5), torch.randn(5, 4, 2), TensorDict(images, [5])).shape == (5, 4, 2)
    for network in ("mlp", "plain_mlp"):
        with raises(ValueError, name, "hidden_dim"):  # what it takes
            check_network(NetworkOptions(f"{network},{name}={value}"))
    refuses(lambda: check_network(NetworkOptions(f"chi_transformer,{name}=-1")), ValueError, name, -1)


def test_options_of_images_are_refused_without_images():
    seeing = NetworkOptions(crop_size=32, share_encoder=True)
    with raises(ValueError, "crop_size", "share_encoder", "image keys"):
        train_policy(demonstrations(), PastPrior(4), network=seeing)


def test_a_fresh_policy_has_the_parts_that_were_asked_for():
    task = navigation_task()
    plain = NetworkOptions("mlp,hidden_dim=8", observation_steps=1, precondition=False)
    first, again, other = (
        new_policy(task, PastPrior(4), plain, TrainingConfig(seed=seed)) for seed in (3, 3, 4)
    )
    assert equal(first, again) and not equal(first, other)
    made = new_policy(task, PastPrior(4), NETWORK, CONFIG, max_nfe=1, see_history=True)
    assert isinstance(made.network, PreconditionedNetwork) and made.sampling.max_nfe == 1
    width = task.vector.shape[-1]
    assert made.network.observation_dim > first.network.observation_dim == width


def test_joint_targets_need_preconditioning():
    plain = NetworkOptions("mlp,hidden_dim=8", observation_steps=1, precondition=False)
    data = demonstrations()
    data["action"] = data["observation"][:, :2] + 0.01
    joints, none = (Task(demonstrations_of(data), joints=joints) for joints in ([0, 1], ""))
    with raises(ValueError, "joints=''", "precondition=False"):
        train_policy(joints, PastPrior(4), network=plain, training=CONFIG, description=None)
    trained = train_policy(none, PastPrior(4), network=plain, training=CONFIG, description=None)
    assert not isinstance(trained.network, PreconditionedNetwork)


class Long(PastPrior):
    history_length = 7


def test_networks_see_all_that_a_prior_remembers():
    policy = train_policy(task := navigation_task(), Long(4), see_history=True, nfe=1, **OPTIONS)
    width = task.vector.shape[-1]
    assert policy.network.observation_dim == width + HistoryObservation.width(7, 1)
    with AsyncExecutor(policy, latency=0) as executor:
        assert executor.act(torch.zeros(width)).shape == (1,)
