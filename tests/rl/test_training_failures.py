import pytest
import torch

from tests.errors import raises
from tests.rl.training_parts import ALGORITHMS, H, from_step, make_actor, make_config, make_env, make_training
from tests.toy_env import Halfway
from warmprior import GaussianPrior, PastPrior, PreviewPrior, WarmPriorActor
from warmprior.io.files import exclusive
from warmprior.rl import PriorSpaceConfig, PriorSpaceTraining

pytest.importorskip("tqdm")


def test_a_state_of_something_else_is_refused(tmp_path):
    make_training(tmp_path, environment_steps=30).run()
    files = {path: path.read_bytes() for path in tmp_path.rglob("*.safetensors")}
    for part, options in {
        "gamma": {"gamma": 0.5},
        "sigma": {"actor": make_actor(PastPrior(H, sigma=0.25))},
        "policy": {"actor": make_actor(seed=1)},
        "clip": {"actor": make_actor().replace(clip=0.5)},
        "start": {"actor": make_actor().replace(start=Halfway())},
        "environment": {"actor": make_actor().replace(environment={"env_name": "Other"})},
        "evaluation_seed": {"running": {"evaluation_seed": 7}},
    }.items():
        with raises(ValueError, part):
            make_training(tmp_path, **{"environment_steps": 30, **options})
    assert files == {path: path.read_bytes() for path in tmp_path.rglob("*.safetensors")}


def test_a_second_training_in_a_folder_waits_its_turn_and_loses_nothing(tmp_path):
    early = make_training(tmp_path, environment_steps=60)  # before the first has saved anything
    first = make_training(tmp_path, environment_steps=60)
    with exclusive(tmp_path), raises(BlockingIOError, "in use"):
        first.run()
    curve = first.run()
    files = {path: path.read_bytes() for path in tmp_path.rglob("*.safetensors")}
    assert early.run() == curve and early.steps == first.steps
    assert (early.buffer[:] == first.buffer[:]).all()
    assert files == {path: path.read_bytes() for path in tmp_path.rglob("*.safetensors")}


def test_a_folder_that_cannot_be_written_is_told_before_the_first_step(tmp_path):
    (tmp_path / "file").touch()
    training = make_training(tmp_path / "file" / "run", environment_steps=60)
    with raises(OSError, tmp_path / "file" / "run", "choose another folder"):
        training.run()
    assert training.steps == 0


def fill_critic(training):
    with torch.no_grad():
        next(iter(training.agent.loss.qvalue_network_params.values(True, True))).fill_(torch.nan)


def stop_learning(training):
    """No loss is computed any more that could tell."""
    training.agent.learn = lambda buffer: {}
    fill_critic(training)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize(
    ("spoil", "place"), [(fill_critic, "loss_qvalue"), (stop_learning, "loss/qvalue_network_params")]
)
def test_nan_stops_the_training_and_the_last_state_stays(tmp_path, algorithm, spoil, place):
    options = {"algorithm": algorithm, "warmup_steps": 10}
    hook = from_step(40, lambda out: spoil(training))
    training = make_training(tmp_path, env={"hook": hook}, **options)
    with raises(FloatingPointError, "NaN", place):
        training.run()
    again = make_training(tmp_path, **options)
    assert 30 <= again.steps < 40 and len(again.curve) == 2
    assert all(torch.isfinite(value).all() for value in again.agent.state().values())
    again.run()
    assert again.steps >= 90


@pytest.mark.parametrize("key", ["reward", "observation"])
def test_nan_from_the_environment_is_never_saved(tmp_path, key):
    hook = from_step(40, lambda out: out.set(key, torch.full_like(out[key], torch.nan)))
    with raises(FloatingPointError, "NaN", f"'{key}'"):
        make_training(tmp_path, env={"hook": hook}).run()
    again = make_training(tmp_path)
    assert 30 <= again.steps < 40
    assert all(torch.isfinite(v.float()).all() for v in again.buffer[:].values(True, True))


@pytest.mark.parametrize(("prior", "length"), [(PastPrior(4), 4), (PreviewPrior(H), 6)])
def test_an_environment_of_another_policy_is_refused_before_any_work(tmp_path, prior, length):
    opened = []

    def spied(seed):
        opened.append(make_env(seed, make_actor(prior)))
        return opened[-1]

    training = PriorSpaceTraining(make_actor(), spied, make_config(), tmp_path, evaluation_seed=100)
    with raises(ValueError, f"{length}, 2]", f"{H}, 2]"):
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
    with raises(ValueError, 2, 3):
        training.run()
    assert len(training.buffer) == 0


def test_a_network_without_sizes_is_named(tmp_path):
    actor = WarmPriorActor(torch.nn.Linear(2, 2), PastPrior(H))
    with raises(TypeError, "Linear", "action_dim", "VelocityNetwork"):
        make_training(tmp_path, actor)


def test_rewards_discounted_inside_chunks_are_refused(tmp_path):
    """They would be discounted again, and the offset of rewards not at all."""
    training = make_training(tmp_path, env={"gamma": 0.9})
    with raises(ValueError, "gamma"):
        training.run()
    assert len(training.buffer) == 0 and not training.state_path.exists()


def test_bad_recipes():
    for name, value in {
        **{"algorithm": "sac", "delta": 0.0, "warmup_steps": 0, "gamma": 1.5, "noise_critic_steps": 0},
        "reward_offset": float("nan"),
    }.items():
        with raises(ValueError, name, value):
            PriorSpaceConfig(**{name: value})
    with raises(ValueError, "warmup_steps", 9, "environment_steps", 8):
        PriorSpaceConfig(warmup_steps=9, environment_steps=8)
    with raises(ValueError, "dsrl-sac"):
        PriorSpaceConfig(algorithm="dsrl-sac", backup_entropy=False)
