from functools import partial

import pytest
import torch
from torchrl.data import Bounded, Unbounded
from torchrl.envs import SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.rl.training_parts import (
    ALGORITHMS,
    EVALUATION_SEED,
    LENGTHS,
    H,
    SolvableEnv,
    check_transitions,
    from_step,
    make_actor,
    make_config,
    make_training,
)
from tests.states import copied, same
from tests.toy_env import ACTION_DIM
from warmprior import GaussianPrior, PastPrior, PreviewPrior, PriorAnchor, policy_transforms
from warmprior.rl import PriorSpace, PriorSpaceTraining

pytest.importorskip("tqdm")


class Recorded(PriorSpaceTraining):
    """Remembers what every save held."""

    def _save(self):
        super()._save()
        now = copied(self.agent.state()), torch.get_rng_state(), len(self.buffer), len(self.curve)
        self.saves = getattr(self, "saves", {}) | {self.steps: now}


@pytest.mark.parametrize("offset", [1.0, 0.25])
def test_transitions_are_those_of_a_rollout_by_hand(tmp_path, offset):
    training = make_training(tmp_path, env={"truncate": True}, reward_offset=offset)
    training.run()
    check_transitions(training, offset=offset)
    stored = training.buffer[:]
    assert stored["prior", "delta"].abs().max() <= training.decoder.delta == 0.5
    assert 90 <= training.steps < 90 + 2 * H


def test_the_warm_up_draws_from_the_prior_and_learns_nothing(tmp_path):
    actor = make_actor(PastPrior(H, sigma=0.01))
    options = {"actor": actor, "warmup_steps": 40}
    training = make_training(tmp_path, **options, environment_steps=40)
    fresh = copied(training.agent.state())
    training.run()
    assert same(fresh, training.agent.state())
    assert training.buffer[:]["prior", "delta"].std() == pytest.approx(0.01, rel=0.15)
    more = make_training(tmp_path / "more", **options, environment_steps=70)
    more.run()
    after = more.buffer[:]["prior", "delta"][len(training.buffer) :]
    assert after.std() > 0.1  # an agent's, on its way
    assert not same(fresh, more.agent.state())


@pytest.mark.parametrize(
    ("algorithm", "prior", "see_history"),
    [
        ("dsrl-na", GaussianPrior(H), True),
        ("dsrl-na", PastPrior(H), False),
        ("dsrl-sac", GaussianPrior(H), False),
        ("dsrl-sac", PreviewPrior(H), False),
    ],
)
def test_both_algorithms_train_and_the_policy_stays_frozen(tmp_path, algorithm, prior, see_history):
    actor = make_actor(prior, see_history=see_history)
    before = copied(actor.state_dict())
    training = make_training(tmp_path, actor, algorithm=algorithm)
    decoder, agent = copied(training.decoder.state_dict()), copied(training.agent.state())
    curve = training.run()
    assert same(before, actor.state_dict()) and same(decoder, training.decoder.state_dict())
    assert not any("decoder" in name for name in agent)
    moved = {
        name.split("/")[1].split(".")[0]
        for name, value in training.agent.state().items()
        if name.startswith("loss/") and not torch.equal(value, agent[name])
    }
    critics = {"qvalue_network_params", "target_qvalue_network_params"}
    distilled = {"noise_qvalue_network_params"} if algorithm == "dsrl-na" else set()
    assert moved >= {"actor_network_params", "log_alpha"} | critics | distilled
    delta = 1.5 if prior.name == "gaussian" else 0.5
    assert training.decoder.delta == delta
    assert training.buffer[:]["prior", "delta"].abs().max() <= delta

    kinds = [row["evaluation"] for row in curve]
    assert kinds == ["base", *["greedy"] * 3]
    steps = [row["environment_steps"] for row in curve]
    assert steps[0] == 0
    # At the first decision after every 30 control steps, of at most H in two environments.
    assert all(30 * k <= step < 30 * k + 2 * H for k, step in enumerate(steps[1:], 1))
    for row in curve:
        assert row["episodes"] == 2 and row["success_rate"] == row["successes"] / 2


class Doubles(SolvableEnv):
    """The toy in double precision, as the environments of dm_control are."""

    def __init__(self, length):
        super().__init__(length, truncate=True)
        self.observation_spec["observation"] = Unbounded((2 + ACTION_DIM,), dtype=torch.float64)
        self.action_spec = Bounded(-1, 1, (ACTION_DIM,), dtype=torch.float64)
        self.reward_spec = Unbounded((1,), dtype=torch.float64)

    def _seen(self, out):
        double = out.apply(lambda value: value.double() if value.is_floating_point() else value)
        return super()._seen(double)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_environments_in_double_precision(tmp_path, algorithm):
    actor = make_actor()

    def make_doubles(seed):
        transforms = policy_transforms(actor.prior, observation_steps=1)
        transforms.append(PriorAnchor(actor))
        return TransformedEnv(SerialEnv(2, [partial(Doubles, length) for length in LENGTHS]), transforms)

    config = make_config(algorithm=algorithm)
    training = PriorSpaceTraining(actor, make_doubles, config, tmp_path, evaluation_seed=EVALUATION_SEED)
    training.run()
    check_transitions(training)
    stored = training.buffer[:]
    assert (
        stored["prior", "anchor"].dtype == torch.float64 and stored["prior", "delta"].dtype == torch.float32
    )
    # A tool's random residuals are an agent's, too.
    env = make_doubles(0).append_transform(PriorSpace(training.decoder))
    check_env_specs(env)
    assert env.rand_action(env.reset())["prior", "delta"].dtype == torch.float32


def test_the_targets_of_sac_by_hand(tmp_path):
    """Squared errors to rewards and soft values, with entropies that do not depend on the box."""
    options = {"algorithm": "dsrl-sac", "alpha_init": 0.7, "delta": 1.5, "gamma": 0.9}
    training = make_training(tmp_path, environment_steps=30, **options)
    training.run()
    loss, data = training.agent.loss, training.buffer[:]
    for params in (loss.qvalue_network_params, loss.target_qvalue_network_params):
        params.data.zero_()  # values are zero: what is left is the reward and the entropy
    with torch.no_grad():
        for value in loss.actor_network_params.values(True, True):
            value.zero_()  # a standard normal before the squashing
    torch.manual_seed(0)
    u = torch.randn(200_000, H, 2).double()
    entropy = -(torch.distributions.Normal(0.0, 1.0).log_prob(u) - (1 - u.tanh() ** 2).log())
    bonus = 0.7 * entropy.sum((1, 2)).mean()
    after = data["next"]
    follows = 0.9 * (~after["terminated"].flatten()).double()
    errors = (after["reward"].flatten().double() + follows * bonus).square()
    # The rest is the variance of the single draw per transition.
    variance = 0.7**2 * entropy.sum((1, 2)).var() * follows.square()
    expected = (errors + variance).mean().item()
    found = loss(data.repeat(300))["loss_qvalue"].item()
    assert found == pytest.approx(2 * expected, rel=0.02)  # summed over two critics


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_evaluations_leave_the_training_alone(tmp_path, algorithm):
    runs = []
    schedules = ({"evaluation_episodes": 1}, {"evaluation_episodes": 3}, {"evaluate_every": 40})
    for k, options in enumerate(schedules):
        training = make_training(tmp_path / str(k), algorithm=algorithm, environment_steps=60, **options)
        training.run()
        runs.append((training.buffer[:], training.agent.state()))
    (data, state), *others = runs
    for other_data, other_state in others:
        # Another evaluation schedule is another recipe, but the same numbers.
        assert (data == other_data).all()
        assert same(state, other_state)


def test_one_seed_gives_one_result_and_another_another(tmp_path):
    runs = []
    for k, seed in enumerate((4, 4, 5)):
        training = make_training(tmp_path / str(k), seed=seed, environment_steps=60)
        runs.append((training.run(), training.buffer[:]))
    assert runs[0][0] == runs[1][0] and (runs[0][1] == runs[1][1]).all()
    delta = ("prior", "delta")
    assert not torch.isclose(runs[0][1][delta][:10], runs[2][1][delta][:10]).all()


@pytest.mark.slow  # tracing the losses takes a minute
def test_compiled_updates_learn_the_same(tmp_path, monkeypatch):
    compile_, states = torch.compile, []
    monkeypatch.setattr(torch, "compile", lambda function: compile_(function, backend="eager"))
    for compiled in (False, True):
        running = {"compile": compiled}
        training = make_training(tmp_path / str(compiled), running=running, environment_steps=40)
        training.run()
        states.append(training.agent.state())
    assert same(*states)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_resume(tmp_path, algorithm):
    whole = make_training(tmp_path / "whole", training_class=Recorded, algorithm=algorithm)
    curve = whole.run()
    at = sorted(whole.saves)
    assert len(at) == 4  # at the start, and after 30, 60 and 90 control steps
    folder = tmp_path / "cut"

    def die(out):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_training(folder, env={"hook": from_step(at[2] + 8, die)}, algorithm=algorithm).run()

    again = make_training(folder, training_class=Recorded, algorithm=algorithm)
    state, rng, size, evaluations = whole.saves[at[2]]
    assert torch.equal(torch.get_rng_state(), rng)
    assert again.steps == at[2] and again.curve == curve[:evaluations]
    assert (again.buffer[:] == whole.buffer[:][:size]).all()
    assert same(again.agent.state(), state)

    final = again.run()
    assert [row["evaluation"] for row in final] == [row["evaluation"] for row in curve]
    assert final[:evaluations] == curve[:evaluations]
    assert 90 <= again.steps < 90 + 2 * H
    assert sorted(again.saves) == [again.steps]  # the frozen policy is not evaluated again
    assert int(again.buffer[:]["next", "executed_steps"].sum()) == again.steps
    # What is finished starts no simulator.
    finished = make_training(folder, algorithm=algorithm)
    finished.make_env = None
    assert finished.run() == final
