"""Only a GPU shows these: nothing waits, no draw is lost, and numbers are those of the CPU.

pytest -m cuda                 # or: make gpu PART=1
"""

import dataclasses

import pytest
import torch

from lab.demonstrations.loading import navigation_task
from tests.rl.training_parts import ALGORITHMS, make_actor, make_training
from tests.states import copied, same
from tests.training.cloning_parts import CONFIG, actor_for, dataset, mlp, run_until, training, weights
from tests.training.test_synchronisation import CASES
from warmprior import PastPrior, window_replay_buffer
from warmprior.evaluation import evaluate
from warmprior.saving import load_policy
from warmprior.saving.training_state import load_state
from warmprior.training import NetworkOptions, train_policy
from warmprior.training.placement import placed

pytestmark = pytest.mark.cuda
GPU = "cuda"


def on_gpu(folder, config=CONFIG, *, data=None, actor=None, **options):
    """A training on the GPU; its data are there too unless others are given."""
    data = placed(dataset(), GPU) if data is None else data
    return training(folder, config, data=data, actor=(actor or actor_for()).to(GPU), **options)


def distance(one, two):
    one, two = ({name: value.cpu() for name, value in weights(each).items()} for each in (one, two))
    return max(float((one[name] - two[name]).abs().max()) for name in one)


@pytest.mark.parametrize("case", CASES)
def test_a_step_does_not_wait_for_the_gpu(tmp_path, case):
    config, data, actor = CASES[case]()
    cloning = on_gpu(tmp_path, config, data=data.to(GPU), actor=actor)
    cloning.actor.train()
    for _ in range(3):
        cloning.step()
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        cloning.step()
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.mark.parametrize("behind", [False, True])
def test_an_interrupted_training_draws_on_where_it_stopped(tmp_path, behind):
    data = dataset() if behind else placed(dataset(), GPU)
    whole = on_gpu(tmp_path / "whole", data=data)
    whole.run(None)
    run_until(on_gpu(tmp_path / "part", data=data), 18)
    again = on_gpu(tmp_path / "part", data=data)
    assert again.iteration == 14
    again.run(None)
    assert ("rng/windows" in load_state(again.state_path)[0]) == behind
    other = on_gpu(tmp_path / "other", dataclasses.replace(CONFIG, seed=1), data=data)
    other.run(None)
    # The order of sums on a GPU is its own; other draws move weights by much more.
    assert distance(again, whole) < 1e-3 < distance(other, whole)


def test_graphs_and_the_cpu_train_alike(tmp_path):
    """From the same windows, sources and times, which generators of two devices would not draw."""
    losses = []
    for device, compiled in (("cpu", False), (GPU, False), (GPU, True)):
        actor = actor_for(PastPrior(4, sigma=1e-9), mlp()).replace(max_nfe=1, nfe=1).to(device)
        folder = tmp_path / f"{device}{compiled}"
        config = dataclasses.replace(CONFIG, times="start", cold_probability=0.0)
        cloning = training(folder, config, data=dataset().to(device), actor=actor, compile=compiled)
        buffer = window_replay_buffer(
            dataset(), actor.prior, batch_size=16, generator=torch.Generator().manual_seed(0)
        )
        losses.append([float(cloning.update(warm(buffer.sample()).to(device))) for _ in range(10)])
    assert losses[1] == pytest.approx(losses[0], rel=1e-3)
    assert losses[2] == pytest.approx(losses[0], rel=1e-3)
    assert losses[0][-1] != pytest.approx(losses[0][0], rel=1e-2)


def warm(batch):
    """Windows whose sources are warm: what a cold one starts from is drawn."""
    batch["history", "steps"].fill_(4)
    return batch


def test_bf16_keeps_float32_weights_and_a_close_loss(tmp_path):
    found = {}
    for precision in ("float32", "bf16"):
        config = dataclasses.replace(CONFIG, precision=precision)
        cloning = on_gpu(tmp_path / precision, config, actor=actor_for(network=mlp()))
        found[precision] = float(cloning.step())
        assert {p.dtype for p in cloning.actor.network.parameters()} == {torch.float32}
    assert found["bf16"] == pytest.approx(found["float32"], rel=2e-2)
    assert found["bf16"] != found["float32"]


def test_decisions_are_those_of_the_cpu():
    actor = actor_for().eval()
    data = window_replay_buffer(dataset(), actor.prior, batch_size=64).sample()
    with torch.no_grad():
        data = actor(data)
        noise, chunk = data["prior", "noise"].clone(), data["vla_action", "chunk"].clone()
        found = actor.to(GPU).integrate(data.to(GPU))["vla_action", "chunk"]
        assert found.is_cuda and not torch.allclose(chunk, noise, atol=1e-2)
        torch.testing.assert_close(found.cpu(), chunk, rtol=1e-4, atol=1e-4)


def test_a_policy_trains_compiled_and_plays_on_the_gpu(tmp_path):
    task, network = navigation_task(), NetworkOptions("mlp,hidden_dim=8", observation_steps=1)
    config = dataclasses.replace(CONFIG, iterations=8, checkpoints=1)
    options = {"network": network, "training": config, "description": None, "device": GPU, "compile": True}
    policy = train_policy(task, PastPrior(4), tmp_path, **options)
    assert {p.device.type for p in policy.parameters()} == {"cpu"}
    loaded = load_policy(tmp_path / "policy_000008", device=GPU)
    episodes = evaluate(loaded, task, episodes=2, first_seed=5, nfe=2)
    assert [episode.seed for episode in episodes] == [5, 6]


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_an_agent_learns_on_the_gpu_and_is_found_again(tmp_path, algorithm):
    options = {"actor": make_actor().to(GPU), "env": {"actor": make_actor()}, "algorithm": algorithm}
    agent = make_training(tmp_path, **options)
    fresh = copied(agent.agent.state())
    curve = agent.run()
    assert "rng_cuda" in load_state(agent.state_path)[0]
    again = make_training(tmp_path, **options)
    assert again.curve == curve and curve
    assert same(agent.agent.state(), again.agent.state())
    assert not same(agent.agent.state(), fresh)
