from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from tests.errors import raises, refuses
from tests.toy_env import CountingEnv, Halfway, mlp_actor, random_history
from warmprior import GaussianPrior, PastPrior, PreviewPrior, RealTimeChunking, keys, policy_transforms
from warmprior.history import ENTRIES, advance, cold_history
from warmprior.options.agent import PriorSpaceConfig
from warmprior.rl.agent import PriorSpaceAgent

PRIORS = [GaussianPrior, PastPrior, PreviewPrior]
H, D_A, D_O, TO = 3, 2, 5, 2
actor_for = partial(mlp_actor, observation_dim=D_O, hidden_dim=16)


def batch(prior, *shape):
    history = random_history(prior, *shape, action_dim=D_A)
    return TensorDict({"observation": torch.randn(*shape, TO, D_O), "history": history}, shape)


@pytest.mark.parametrize("nfe", [1, 3, 9])
@pytest.mark.parametrize("prior_class", PRIORS)
def test_inference_of_algorithm_one(prior_class, nfe):
    """A whole episode of decisions against the right column of Algorithm 1, same random numbers."""
    prior = prior_class(H)
    actor = actor_for(prior, nfe=nfe, generator=torch.Generator().manual_seed(5))
    generator = torch.Generator().manual_seed(5)
    length = prior.prediction_length
    history, previous = cold_history([1], H, length, D_A), None
    for _ in range(4):
        o = torch.randn(1, TO, D_O)
        data = actor(TensorDict({"observation": o, "history": history}, [1]))
        chunk = data["vla_action", "chunk"]

        epsilon = torch.randn(1, length, D_A, generator=generator)
        a, warm = epsilon.clone(), 0
        if prior_class is PastPrior and previous is not None:
            a, warm = previous + prior.sigma * epsilon, H
        if prior_class is PreviewPrior and previous is not None:
            a[:, :H], warm = previous[:, H:] + prior.sigma * epsilon[:, :H], H
        torch.testing.assert_close(data["prior", "noise"], a)
        assert data["prior", "warm"].flatten().tolist() == [i < warm for i in range(length)]
        assert torch.equal(data["prior", "loc"], prior.distribution(history).loc)
        for i in range(nfe):
            a = a + actor.network(torch.full((1,), i / nfe), a, o) / nfe
        torch.testing.assert_close(chunk, a)
        previous = chunk
        history = advance(history, chunk, torch.full((1, 1), H))


@pytest.mark.parametrize("shape", [(), (4,), (2, 3)])
def test_keys_and_shapes(shape):
    prior = PreviewPrior(H)
    actor = actor_for(prior, nfe=2)
    assert actor.in_keys == ["observation", *(("history", name) for name in ENTRIES)]
    assert actor.out_keys == [keys.LOC, keys.WARM, keys.NOISE, keys.CHUNK]
    out = actor(batch(prior, *shape).select(*actor.in_keys))
    assert out["vla_action", "chunk"].shape == (*shape, 2 * H, D_A)
    assert actor_for(prior, guidance=RealTimeChunking()).in_keys == [*actor.in_keys, keys.DELAY]


def test_a_start_point_enters_the_flow_on_the_way():
    prior = GaussianPrior(H)
    actor = actor_for(prior, start=Halfway(), nfe=2)
    assert actor.ode.start_time == actor.replace(nfe=1).ode.start_time == 0.5
    data = batch(prior, 4)
    out = actor(data.clone(), generator=torch.Generator().manual_seed(0))
    noise = prior.distribution(data["history"]).sample(torch.Generator().manual_seed(0))
    a = data["history", "actions"][:, -1:] + 0.5 * noise
    torch.testing.assert_close(out["prior", "noise"], a)
    for t in (0.5, 0.75):
        a = a + 0.25 * actor.network(torch.full((4,), t), a, data["observation"])
    torch.testing.assert_close(out["vla_action", "chunk"], a)


def test_one_evaluation_alone():
    """A network that was trained at t = 0 alone, as by regression."""
    prior = GaussianPrior(H)
    actor = actor_for(prior, max_nfe=1)
    assert (actor.sampling.evaluations(), actor_for(prior).sampling.evaluations()) == (1, 3)
    refuses(lambda: actor_for(prior, nfe=3, max_nfe=1), ValueError, "at most 1", "nfe=3")
    refuses(lambda: actor(batch(prior, 4), nfe=9), ValueError, "at most 1", "nfe=9")
    refuses(lambda: actor_for(prior, max_nfe=1, guidance=RealTimeChunking()), ValueError, "guide")


def test_what_is_replaced_and_what_stays():
    actor = actor_for(PastPrior(H), observation_key="state", clip=(0.1, 0.2), start=Halfway())
    again = actor.replace(prior=GaussianPrior(H))
    assert isinstance(again.prior, GaussianPrior) and again.observation_key == "state"
    assert again.start is actor.start and again.sampling.clip == (0.1, 0.2)
    # What was not chosen follows from the rest, and what was stays.
    assert actor.replace(max_nfe=1).sampling.evaluations() == 1
    four = actor.replace(nfe=4)  # as of a saved policy, whose number was chosen
    assert four.replace(max_nfe=8).sampling.nfe == four.replace(prior=GaussianPrior(H)).sampling.nfe == 4
    refuses(lambda: four.replace(max_nfe=1), ValueError, "at most 1")


def test_a_subclass_keeps_its_own_arguments():
    made = actor_for(PastPrior(H))

    class Capped(type(made)):
        def __init__(self, network, prior, limit, *, kept=True, **options):
            super().__init__(network, prior, **options)
            if kept:
                self.limit, self.kept = limit, kept

    actor = Capped(made.network, made.prior, 0.3)
    one = PriorSpaceAgent(actor, PriorSpaceConfig(hidden_dim=8)).decoder
    again = actor.replace(nfe=2)
    assert (one.ode.sampling.nfe, again.limit, again.sampling.nfe) == (1, 0.3, 2)
    assert actor.replace(limit=0.5).limit == 0.5
    with raises(TypeError, "Capped", "'limit'"):
        Capped(made.network, made.prior, 0.3, kept=False).replace(nfe=1)


OWN_KEYS = {f"{part}_key": ("left", part) for part in ("observation", "history", "source", "chunk")}


def test_keys_of_its_own_give_the_same_chunks():
    prior = PreviewPrior(H)
    actor, data = actor_for(prior, nfe=2), batch(prior, 4)
    own = actor.replace(**OWN_KEYS)
    renamed = TensorDict({"left": data.select("observation", "history")}, [4])
    out = actor(data, generator=torch.Generator().manual_seed(0))
    left = own(renamed, generator=torch.Generator().manual_seed(0))["left"]
    assert torch.equal(left["chunk"], out["vla_action", "chunk"])
    assert torch.equal(left["source", "noise"], out["prior", "noise"])
    source = [("left", "source", name) for name in ("loc", "warm", "noise")]
    assert own.out_keys == [*source, ("left", "chunk")]
    assert own.replace(nfe=1).tensor_keys == OWN_KEYS
    written = {"observation_key": ("prior", ("observation",)), "history_key": ("history",)}  # other forms
    usual = own.replace(**written, source_key=("prior",), chunk_key=(("vla_action",), "chunk"))
    assert usual.tensor_keys == actor.tensor_keys | {"observation_key": keys.CONDITIONED}
    assert usual.sees_history


def test_dispatch_takes_tensors_and_returns_tensors():
    prior = PastPrior(H)
    actor, data = actor_for(prior, nfe=2), batch(prior, 4)
    tensors = {"_".join(key) if isinstance(key, tuple) else key: data[key] for key in actor.in_keys}
    *_, chunk = actor(**tensors, generator=torch.Generator().manual_seed(0))
    expected = actor(data, generator=torch.Generator().manual_seed(0))
    assert torch.equal(chunk, expected["vla_action", "chunk"])


@pytest.mark.parametrize("start", [None, Halfway()], ids=["source", "start point"])
def test_the_temperature_scales_the_noise_of_the_source_alone(start):
    prior = PastPrior(H, sigma=0.3, correlation=0.4)
    actor, data = actor_for(prior, nfe=2, start=start), batch(prior, 4)

    def noise(policy):
        return policy(data.clone(), generator=torch.Generator().manual_seed(0))["prior", "noise"]

    mean, whole = noise(actor.replace(temperature=0.0)), noise(actor)
    torch.testing.assert_close(noise(actor.replace(temperature=0.25)), mean + 0.25 * (whole - mean))
    loc = prior.distribution(data["history"]).loc
    expected = loc if start is None else data["history", "actions"][:, -1:] + 0.5 * loc
    torch.testing.assert_close(mean, expected)
    for name, point in {"DETERMINISTIC": mean, "MEAN": mean, "RANDOM": whole}.items():
        with set_exploration_type(ExplorationType[name]):
            assert torch.equal(noise(actor), point)
            assert torch.equal(noise(actor.replace(temperature=1.0)), whole)  # what was chosen stays
    for wrong in (-0.1, float("nan")):
        with raises(ValueError, "temperature"):
            actor.replace(temperature=wrong)


def test_a_spec_is_kept_by_key_and_collectors_accept_it():
    env = TransformedEnv(CountingEnv(7), policy_transforms(PastPrior(H)))
    chunk = env.full_action_spec[keys.CHUNK]
    actor = mlp_actor(PastPrior(H, sigma=0.0), nfe=1, clip=1.0, spec=chunk)
    assert actor.replace(nfe=2).spec[keys.CHUNK] == chunk and actor_for(PastPrior(H)).spec is None
    batches = []
    for policy in (actor, actor.replace(spec=None)):
        torch.manual_seed(0)
        env = TransformedEnv(CountingEnv(7), policy_transforms(PastPrior(H)))
        collector = Collector(env, policy, frames_per_batch=6, total_frames=6)
        batches += [batch.exclude("collector") for batch in collector]
        collector.shutdown()
    one, other = batches
    assert set(one.keys(True, True)) == set(other.keys(True, True))
    assert all(torch.equal(one[key], other[key]) for key in one.keys(True, True))
    assert chunk.is_in(one[keys.CHUNK][0])


class Chunks(nn.Module):
    """A policy with tensors in place of tensordicts, as export wants it."""

    def __init__(self, actor):
        super().__init__()
        self.actor = actor

    def forward(self, observation, *history):
        shape = observation.shape[:-2]
        data = TensorDict(dict(zip(ENTRIES, history, strict=True)), shape)
        data = TensorDict({"observation": observation, "history": data}, shape)
        return self.actor(data)[keys.CHUNK]


@pytest.mark.parametrize("batches", [[(3,), (2,), (5,)], [(3, 2), (4, 5)]])
def test_policies_compile_and_export_for_every_batch_size(batches):
    policy = Chunks(actor_for(PastPrior(H, sigma=0.0), nfe=2).eval())

    def inputs(shape):
        data = batch(policy.actor.prior, *shape)
        data["history", "steps"] = torch.full((*shape, 1), H)  # nothing is drawn
        return (data["observation"], *(data["history", name] for name in ENTRIES))

    rows = {i: torch.export.Dim(f"rows{i}", min=2, max=64) for i in range(len(batches[0]))}
    options = {"dynamic_shapes": {"observation": rows, "history": (rows,) * 4}}
    with torch.no_grad():
        exported = torch.export.export(policy, inputs(batches[0]), **options).module()
        compiled = torch.compile(policy, backend="eager")
        for shape in batches:
            given = inputs(shape)
            torch.testing.assert_close(exported(*given), policy(*given))
            torch.testing.assert_close(compiled(*given), policy(*given))
