"""Sources and start points that learn before the flow are trained once, frozen, and kept with the policy."""

import dataclasses

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from tests.errors import raises, refuses
from tests.states import copied, same
from tests.together import together
from tests.toy_env import demonstrations, random_history
from warmprior import CVAEPrior, GaussianPrior, PastPrior, PreviewPrior, Prior, StartPoint
from warmprior.data import demonstrations_of
from warmprior.deploy import AsyncExecutor
from warmprior.saving import load_policy
from warmprior.saving.training_state import load_state, save_state
from warmprior.tasks import Task
from warmprior.training import NetworkOptions, TrainingConfig, train_policy

H = 4
NETWORK = NetworkOptions("mlp,hidden_dim=8", observation_steps=1)
CONFIG = TrainingConfig(iterations=8, batch_size=16, checkpoints=2, save_every=2)
OPTIONS = {"network": NETWORK, "training": CONFIG, "description": None}


def steps(episodes=12):
    """Their actions differ in the mean from episode to episode."""
    data = demonstrations(10 * episodes, 10)
    data["action"] += data["episode"][:, None]
    return data


class MeanChunk(GaussianPrior, nn.Module):
    """A user's own: a Gaussian around the mean chunk of the demonstrations."""

    name = "mean-chunk-of-the-tests"

    def __init__(self, chunk_length, *, action_dim=None):
        nn.Module.__init__(self)
        super().__init__(chunk_length)
        self.action_dim = action_dim
        if action_dim is not None:
            self.chunk = nn.Parameter(torch.zeros(chunk_length, action_dim))

    def mean(self, history):
        loc, warm = super().mean(history)
        return loc + self.chunk, ~warm

    def fit(self, windows, held_out, *, iterations, generator):
        fits.append((windows[:], held_out[:], iterations))
        chunks = windows[:]["vla_action", "chunk"]
        self.__init__(self.chunk_length, action_dim=chunks.shape[-1])
        self.chunk.data = chunks.mean(0)


fits = []


@pytest.fixture(autouse=True)
def counted():
    fits.clear()


def policy_of(folder, prior, data=None, **options):
    return train_policy(steps() if data is None else data, prior, folder, **OPTIONS | options)


def chunks(policy, seed=1):
    data = {"observation": torch.randn(5, 1, 3, generator=torch.Generator().manual_seed(0))}
    data = TensorDict(data | {"history": random_history(policy.prior, 5)}, [5])
    return policy(data, generator=torch.Generator().manual_seed(seed))["vla_action", "chunk"]


def test_a_prior_of_ones_own_learns_from_the_windows_of_the_flow(tmp_path):
    """Every tenth episode is held out; the given object stays as it is."""
    given, data = MeanChunk(H), steps()
    policy = policy_of(tmp_path, given, data)
    ((windows, held_out, iterations),) = fits
    assert iterations == 2  # a quarter
    data = Task(demonstrations_of(data, "steps")).data  # normalised
    number = data["episode"]
    assert held_out["frame"].tolist() == list(range(10))
    expected = []
    for i in range(len(data)):
        last = int((number == number[i]).nonzero().max())
        if int(number[i]) != 9:
            expected.append(torch.stack([data["action"][min(i + k, last)] for k in range(H)]))
    assert torch.equal(windows["vla_action", "chunk"], torch.stack(expected))
    assert windows["observation"].shape == (110, 1, 3)
    torch.testing.assert_close(policy.prior.chunk, torch.stack(expected).mean(0))
    assert given.action_dim is None and not list(given.parameters())


def test_few_episodes_hold_out_the_second(tmp_path):
    for count, held_out in ((2, 10), (1, 10)):  # the only one is trained on, and measured on
        policy_of(tmp_path / str(count), MeanChunk(H), steps(count))
        assert [len(part) for part in fits.pop()[:2]] == [10, held_out]


@pytest.mark.parametrize("prior", [CVAEPrior(H, hidden_dim=8, latent_dim=2), MeanChunk(H)])
def test_a_policy_holds_its_source_as_it_was_before_the_flow(tmp_path, prior):
    policy = policy_of(tmp_path, prior)
    kept, facts = load_state(tmp_path / "prior.safetensors")
    assert kept and same(dict(policy.prior.state_dict()), kept)
    assert facts["config"] == policy.prior.config()
    loaded = load_policy(tmp_path / "policy_000008")
    assert loaded.prior.config() == policy.prior.config()
    assert torch.equal(chunks(loaded), chunks(policy)) and not torch.equal(chunks(policy), chunks(policy, 2))
    with AsyncExecutor(policy, latency=0) as executor:
        assert executor.act(torch.zeros(3)).shape == (2,)


def test_one_seed_is_one_result_whatever_was_drawn_before():
    policies = []
    for draws, seed in ((0, 0), (5, 0), (0, 1)):
        torch.rand(draws)
        state = torch.get_rng_state()
        recipe = dataclasses.replace(CONFIG, seed=seed)
        policies.append(copied(policy_of(None, CVAEPrior(H, hidden_dim=8), training=recipe).state_dict()))
        assert torch.equal(torch.get_rng_state(), state)
    assert same(*policies[:2])
    name = next(name for name in policies[0] if "decoder" in name)
    assert not torch.equal(policies[0][name], policies[2][name])


@pytest.mark.parametrize("when", [0, 5])
def test_a_run_that_continues_learns_nothing_twice(tmp_path, when):
    """Also if it ended before the flow had saved anything."""

    def interrupt(iteration):
        if iteration == when:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        policy_of(tmp_path / "halves", MeanChunk(H), progress=interrupt)
    halves = policy_of(tmp_path / "halves", MeanChunk(H))
    assert len(fits) == 1
    whole = policy_of(tmp_path / "whole", MeanChunk(H))
    assert len(fits) == 2
    assert same(copied(halves.state_dict()), copied(whole.state_dict()))


def test_what_another_run_learnt_is_refused(tmp_path):
    policy_of(tmp_path, CVAEPrior(H, hidden_dim=8))
    for fact, changes in (
        ("seed", {"training": dataclasses.replace(CONFIG, seed=1)}),
        ("hidden_dim", {"prior": CVAEPrior(H, hidden_dim=16)}),
        ("demonstrations", {"data": steps(11)}),
        ("observation_steps", {"network": dataclasses.replace(NETWORK, observation_steps=2)}),
    ):
        with raises(ValueError, "prior.safetensors", fact):
            policy_of(tmp_path, **{"prior": CVAEPrior(H, hidden_dim=8)} | changes)


def test_options_in_a_file_cannot_fill_the_memory(tmp_path):
    policy_of(tmp_path, CVAEPrior(H, hidden_dim=8))
    path = tmp_path / "prior.safetensors"
    tensors, facts = load_state(path)
    facts["config"]["widths"] = [10**6, 10**6, 1]
    save_state(path, tensors, facts)
    with raises(ValueError, "prior.safetensors", "weights"):
        policy_of(tmp_path, CVAEPrior(H, hidden_dim=8))


class NaNChunk(MeanChunk):
    name = "nan-chunk-of-the-tests"

    def fit(self, windows, held_out, **options):
        super().fit(windows, held_out, **options)
        self.chunk.data[0] = torch.nan


def test_what_diverges_is_not_kept(tmp_path):
    refuses(lambda: policy_of(tmp_path, NaNChunk(H)), FloatingPointError, "NaNChunk")
    assert not (tmp_path / "prior.safetensors").exists()


def test_what_it_cannot_read_is_refused_by_name(tmp_path):
    data = steps()
    images = torch.zeros(120, 3, 12, 12, dtype=torch.uint8)
    seen = TensorDict({"state": data["observation"], "camera": images}, [120])
    network = NetworkOptions("mlp,hidden_dim=8", encoder="small", crop_size=10)
    with raises(ValueError, "CVAEPrior", "vectors", "images"):
        policy_of(tmp_path, CVAEPrior(H), data.set("observation", seen), network=network)
    refuses(lambda: policy_of(tmp_path, CVAEPrior(H), see_history=True), ValueError, "see_history")
    assert not list(tmp_path.iterdir())


class FromTheMean(StartPoint):
    """A user's own start point, at the mean chunk; its state is a constructor argument alone."""

    name = "from-the-mean-of-the-tests"
    time = noise_share = 0.5

    def __init__(self, level=0.0):
        super().__init__()
        self.level = level

    def fit(self, windows, held_out, *, iterations, generator):
        fits.append(iterations)
        self.level = float(windows[:]["vla_action", "chunk"].mean())

    def centre(self, history, observation):
        return self.time * self.level * torch.ones_like(history["forecast"])

    def forward(self, noise, history, observation):
        return self.centre(history, observation) + self.noise_share * noise


def test_a_start_point_learns_from_windows_of_the_policys_lengths(tmp_path):
    for _ in range(2):
        policy = policy_of(tmp_path, PreviewPrior(H), start=FromTheMean())
    assert fits == [2] and policy.start.level != 0.0
    assert load_policy(tmp_path / "policy_000008").start.level == policy.start.level


def test_what_learns_with_the_flow_or_not_at_all_leaves_no_file(tmp_path):
    policy_of(tmp_path, PastPrior(H))
    assert not list(tmp_path.glob("p*.safetensors"))


def _train(folder):
    Prior.classes[MeanChunk.name] = MeanChunk
    policy_of(folder, MeanChunk(H))
    with (folder / "fits").open("a") as file:
        file.write(f"{len(fits)}\n")


def test_of_several_processes_the_first_learns_for_all(tmp_path):
    together(_train, tmp_path)
    assert sorted((tmp_path / "fits").read_text().split()) == ["0", "1"]
    policy = load_policy(tmp_path / "policy_000008")
    assert same(dict(policy.prior.state_dict()), load_state(tmp_path / "prior.safetensors")[0])
