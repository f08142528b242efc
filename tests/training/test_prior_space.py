"""Training in source space: what is stored, what is counted, what is kept, and what is refused."""

from __future__ import annotations

import os
import signal
from functools import partial

import pytest
import torch
from torchrl.envs import TransformedEnv

from tests.training.prior_space_parts import (
    EVALUATION_SEED,
    LENGTHS,
    H,
    SolvableEnv,
    make_actor,
    make_config,
    make_env,
    make_training,
)
from warmprior import (
    GaussianPrior,
    HistoryPrior,
    PastPrior,
    PreviewPrior,
    PriorAnchor,
    keys,
    policy_transforms,
)
from warmprior.training import PriorSpaceConfig, PriorSpaceTraining, parallel_env

pytest.importorskip("tqdm")

ALGORITHMS = ("dsrl-na", "dsrl-sac")


class Recorded(PriorSpaceTraining):
    """Remembers what every save held."""

    def _save(self):
        super()._save()
        if not hasattr(self, "saves"):
            self.saves = {}
        state = {name: value.clone() for name, value in self.agent.state().items()}
        self.saves[self.steps] = (state, torch.get_rng_state(), len(self.buffer), len(self.curve))


def hand_rollout(decisions):
    """Start, executed steps, reward sum and end of every decision, environment by environment."""
    time, result = [0, 0], []
    for _ in range(decisions):
        for i, length in enumerate(LENGTHS):
            executed = min(H, length - time[i])
            rewards = range(
                time[i] + 1, time[i] + executed + 1
            )  # CountingEnv pays the step's number
            ended = time[i] + executed == length
            result.append((i, time[i], executed, sum(rewards), ended))
            time[i] = 0 if ended else time[i] + executed
    return result


@pytest.mark.parametrize(
    ("offset", "truncate", "bootstrap"),
    [(1.0, True, False), (0.0, True, True), (0.25, False, True)],
)
def test_transitions_are_those_of_a_rollout_by_hand(tmp_path, offset, truncate, bootstrap):
    training = make_training(
        tmp_path,
        env={"truncate": truncate},
        reward_offset=offset,
        bootstrap_timeouts=bootstrap,
    )
    training.run()
    stored = training.buffer[:]
    expected = hand_rollout(len(stored) // 2)
    assert len(stored) == len(expected)
    latest: dict[int, tuple[bool, torch.Tensor]] = {}
    for row, (i, start, executed, reward, ended) in zip(stored, expected, strict=True):
        following = row["next"]
        assert row["observation"][0, 0] == start
        # The last state of the episode, not the first of the next one.
        assert following["observation"][0, 0] == start + executed
        assert following["observation"][0, 1] == row["observation"][0, 1]
        last_action = row["vla_action", "chunk"][executed - 1]
        torch.testing.assert_close(following["observation"][0, 2:], last_action)
        assert following["executed_steps"] == executed
        assert following["reward"] == pytest.approx(reward - offset * executed)
        assert following["done"] == ended
        # DSRL takes time-outs for terminations.
        assert following["terminated"] == (ended and not (bootstrap and truncate))
        # The mean of WP-Past is what was executed last.
        if executed == H:
            assert torch.equal(following["prior", "anchor"], row["vla_action", "chunk"])
        if i in latest:
            was_last, anchor = latest[i]
            assert torch.equal(anchor, row["prior", "anchor"]) != was_last
        latest[i] = (ended, following["prior", "anchor"])
    # What was decoded is what the residual says.
    decoded = training.decoder(stored.select("observation", "prior"))["vla_action", "chunk"]
    torch.testing.assert_close(decoded, stored["vla_action", "chunk"])
    assert stored["prior", "delta"].abs().max() <= training.decoder.delta == 0.5
    # All control steps are counted, those of the warm-up too.
    assert training.steps == sum(executed for _, _, executed, _, _ in expected)
    assert 90 <= training.steps < 90 + 2 * H


def test_the_warm_up_draws_from_the_prior_and_learns_nothing(tmp_path):
    actor = make_actor(PastPrior(H, sigma=0.01))
    options = {"actor": actor, "env": {"prior": actor.prior}, "warmup_steps": 40}
    training = make_training(tmp_path, **options, environment_steps=40)
    fresh = {name: value.clone() for name, value in training.agent.state().items()}
    training.run()
    assert all(torch.equal(fresh[name], value) for name, value in training.agent.state().items())
    assert training.buffer[:]["prior", "delta"].std() == pytest.approx(0.01, rel=0.15)
    more = make_training(tmp_path / "more", **options, environment_steps=70)
    more.run()
    after = more.buffer[:]["prior", "delta"][len(training.buffer) :]
    assert after.std() > 0.1  # an agent's, on its way
    state = more.agent.state()
    assert not all(torch.equal(fresh[name], state[name]) for name in fresh)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("prior_class", [GaussianPrior, HistoryPrior, PastPrior, PreviewPrior])
def test_both_algorithms_train_and_the_policy_stays_frozen(tmp_path, algorithm, prior_class):
    prior = prior_class(H)
    actor = make_actor(prior)
    before = {name: value.clone() for name, value in actor.state_dict().items()}
    training = make_training(tmp_path, actor, {"prior": prior}, algorithm=algorithm)
    decoder = {name: value.clone() for name, value in training.decoder.state_dict().items()}
    agent = {name: value.clone() for name, value in training.agent.state().items()}
    curve = training.run()
    for module, old in ((actor, before), (training.decoder, decoder)):
        new = module.state_dict()
        assert new.keys() == old.keys() and all(torch.equal(new[n], old[n]) for n in new)
    assert not any("decoder" in name for name in agent)
    moved = {
        name.split("/")[1].split(".")[0]
        for name, value in training.agent.state().items()
        if name.startswith("loss/") and not torch.equal(value, agent[name])
    }
    critics = {"qvalue_network_params", "target_qvalue_network_params"}
    distilled = {"noise_qvalue_network_params"} if algorithm == "dsrl-na" else set()
    assert moved >= {"actor_network_params", "log_alpha"} | critics | distilled
    delta = {"gaussian": 1.5, "history": 1.5}.get(prior.name, 0.5)
    assert training.decoder.delta == delta
    assert training.buffer[:]["prior", "delta"].abs().max() <= delta

    kinds = [row["evaluation"] for row in curve]
    assert kinds == ["base", *["greedy", "stochastic"] * 3]
    steps = [row["environment_steps"] for row in curve]
    assert steps[0] == 0 and steps[1::2] == steps[2::2]
    # At the first decision after every 30 control steps, of at most H in two environments.
    assert all(30 * k <= step < 30 * k + 2 * H for k, step in enumerate(steps[1::2], 1))
    for row in curve:
        assert row["episodes"] == 2 and row["success_rate"] == row["successes"] / 2


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_agent_sees_a_mean_that_conditions_the_policy(tmp_path, algorithm):
    """Its anchor is zero, so that without the mean the agent could not tell what is decoded."""
    prior = HistoryPrior(H)
    training = make_training(
        tmp_path, make_actor(prior), {"prior": prior}, algorithm=algorithm, environment_steps=30
    )
    training.run()
    data = training.buffer[:][:1].clone()
    residuals = []
    for mean in (0.0, 1.0):
        data[keys.LOC] = torch.full_like(data[keys.LOC], mean)
        torch.manual_seed(0)
        residuals.append(training.agent.policy(data)[keys.DELTA].clone())
    assert not data[keys.ANCHOR].isnan().any() and not torch.equal(*residuals)


@pytest.mark.parametrize("prior_class", [PastPrior, GaussianPrior])
def test_chunks_executed_in_part_are_refused_where_the_mean_would_hold_them(tmp_path, prior_class):
    prior = prior_class(H)
    training = make_training(tmp_path, make_actor(prior), {"prior": prior, "execute": 2})
    if prior_class is GaussianPrior:
        training.run()
        return
    with pytest.raises(ValueError, match="executes 2 of H = 3 actions per decision"):
        training.run()
    assert len(training.buffer) == 0


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_agent_climbs_its_critic(tmp_path, algorithm):
    """The actor's gradient depends on what the critic thinks of its residual."""
    training = make_training(tmp_path, algorithm=algorithm, environment_steps=30)
    training.run()
    loss, data = training.agent.loss, training.buffer[:]
    critic = "noise_qvalue_network_params" if algorithm == "dsrl-na" else "qvalue_network_params"

    def gradient():
        torch.manual_seed(0)
        loss.zero_grad()
        loss(data.clone())["loss_actor"].backward()
        return torch.cat(
            [
                p.grad.flatten()
                for p in loss.actor_network_params.values(True, True)
                if p.requires_grad
            ]
        )

    one = gradient()
    with torch.no_grad():
        for value in getattr(loss, critic).values(True, True):
            value.mul_(-2.0)
    assert not torch.allclose(one, gradient())


def test_both_algorithms_want_the_same_entropy(tmp_path):
    """TorchRL's SAC counts it in units of the residual, DSRL-NA in units of the box."""
    losses = {}
    for algorithm in ALGORITHMS:
        options = {"alpha_init": 3.0, "target_entropy": -2.5, "delta": 0.7}
        training = make_training(
            tmp_path / algorithm, algorithm=algorithm, environment_steps=30, **options
        )
        if algorithm == "dsrl-na":
            training.run()
            data, weights = training.buffer[:], training.agent.loss.actor_network_params
        loss = training.agent.loss
        loss.actor_network_params.data.copy_(weights.data)
        torch.manual_seed(0)
        losses[algorithm] = loss(data.clone())["loss_alpha"].item()
    # Without the change of units they would be 2.4 apart; TorchRL inverts the squashing numerically.
    assert losses["dsrl-sac"] == pytest.approx(losses["dsrl-na"], abs=0.05)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_evaluations_leave_the_training_alone(tmp_path, algorithm):
    runs = []
    for k, options in enumerate(
        ({"evaluation_episodes": 1}, {"evaluation_episodes": 3}, {"evaluate_every": 40})
    ):
        training = make_training(tmp_path / str(k), algorithm=algorithm, **options)
        training.run()
        runs.append((training.buffer[:], training.agent.state()))
    (data, state), *others = runs
    for other_data, other_state in others:
        # Another evaluation schedule is another recipe, but the same numbers.
        assert (data == other_data).all()
        assert all(torch.equal(state[name], other_state[name]) for name in state)


def test_one_seed_gives_one_result_and_another_another(tmp_path):
    runs = []
    for k, seed in enumerate((4, 4, 5)):
        training = make_training(tmp_path / str(k), seed=seed)
        runs.append((training.run(), training.buffer[:]))
    assert runs[0][0] == runs[1][0] and (runs[0][1] == runs[1][1]).all()
    delta = ("prior", "delta")
    assert not torch.isclose(runs[0][1][delta][:10], runs[2][1][delta][:10]).all()


def interrupt_after(steps):
    """A hook that lets the training die in its ``steps``-th control step."""
    count = iter(range(1, 10_000))

    def hook(out):
        if next(count) > steps:
            raise KeyboardInterrupt
        return out

    return hook


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_resume(tmp_path, algorithm):
    whole = make_training(tmp_path / "whole", training_class=Recorded, algorithm=algorithm)
    curve = whole.run()
    at = sorted(whole.saves)
    assert len(at) == 4  # at the start, and after 30, 60 and 90 control steps
    hook = interrupt_after(at[2] + 7)
    folder = tmp_path / "cut"
    with pytest.raises(KeyboardInterrupt):
        make_training(folder, env={"hook": hook}, algorithm=algorithm).run()

    again = make_training(folder, training_class=Recorded, algorithm=algorithm)
    state, rng, size, evaluations = whole.saves[at[2]]
    assert torch.equal(torch.get_rng_state(), rng)
    assert again.steps == at[2] and again.curve == curve[:evaluations]
    assert (again.buffer[:] == whole.buffer[:][:size]).all()
    restored = again.agent.state()
    assert restored.keys() == state.keys()
    assert all(torch.equal(restored[name], state[name]) for name in state)

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
        tensors["next.decoded.chunk"] = tensors.pop("vla_action.chunk")
        message = r"another wiring: it lacks \[\('vla_action', 'chunk'\)\].*decoded"
    else:
        tensors["prior.delta"] = tensors["prior.delta"][:, :-1].clone()
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
        (fill_critic, r"loss_qvalue=nan.*diverged"),
        (stop_learning, r"qvalue_network.* NaN or infinite: the training has diverged"),
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
    with pytest.raises(FloatingPointError, match=r"transition holds NaN .*delta.*chunk"):
        training.run()
    assert torch.isfinite(torch.stack(seen)).all()


@pytest.mark.parametrize("key", ["reward", "observation"])
def test_nan_from_the_environment_is_never_saved(tmp_path, key):
    count = iter(range(1, 10_000))

    def hook(out):
        if next(count) >= 40:
            out[key] = torch.full_like(out[key], torch.nan)
        return out

    with pytest.raises(FloatingPointError, match=rf"NaN or infinity at .*'next', '{key}'"):
        make_training(tmp_path, env={"hook": hook}).run()
    again = make_training(tmp_path)
    assert 30 <= again.steps < 40
    assert all(torch.isfinite(v.float()).all() for v in again.buffer[:].values(True, True))


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        (PastPrior(4), r"chunks of \(P, d_a\) = \(4, 2\), but the policy predicts \(3, 2\)"),
        (PastPrior(H, sigma=0.1), "the policy was trained with .* carries PastPrior.*0.1"),
        (PreviewPrior(H), r"chunks of \(P, d_a\) = \(6, 2\)"),
    ],
)
def test_an_environment_of_another_policy_is_refused_before_any_work(tmp_path, prior, message):
    opened = []

    def spied(seed):
        opened.append(make_env(seed, prior))
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
        make_training(tmp_path, make_actor(action_dim=1)).run()


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
    prior = PastPrior(H)

    def mortal(seed):
        transforms = partial(policy_transforms, prior, observation_steps=1)
        env = TransformedEnv(parallel_env(MortalEnv, transforms, 2), PriorAnchor(prior, seed=seed))
        env.set_seed(seed or EVALUATION_SEED, static_seed=True)
        return env

    training = PriorSpaceTraining(
        make_actor(prior), mortal, make_config(), tmp_path, evaluation_seed=EVALUATION_SEED
    )
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
        ({"learning_rate": 0.0}, "learning_rate must be a finite number > 0"),
        ({"alpha_init": -1.0}, "alpha_init must be a finite number > 0"),
    ],
)
def test_bad_recipes(options, message):
    with pytest.raises(ValueError, match=message):
        PriorSpaceConfig(**options)
