"""A saved policy is improved, the better policy is kept, and nothing is lost at an interruption."""

from functools import partial
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import SerialEnv

from tests.envs.test_gymnasium import registered_dial
from tests.errors import raises
from tests.rl.training_parts import H, SolvableEnv, make_actor, make_config, make_training
from tests.states import same
from tests.toy_env import CountingEnv, mlp_actor
from warmprior import GaussianPrior, PastPrior, RealTimeChunking, policy_transforms
from warmprior.envs.description import environment_of, registered_description
from warmprior.evaluation import evaluate, parallel_env
from warmprior.io.workers import torch_threads
from warmprior.rl import improve, improve_policy, improved_policy
from warmprior.rl.agent import PriorSpaceAgent
from warmprior.saving import load_policy, save_policy
from warmprior.saving.training_state import load_state


class ReachEnv(SolvableEnv):
    """A success where the actions of an episode sum to more than 1; a policy that stays at 0 has none."""

    def _reset(self, tensordict=None, **kwargs):
        self.episode = -1  # no episode depends on those before
        return super()._reset(tensordict, **kwargs)

    def _seen(self, out):
        reached = out["observation"][..., 2:3] > 0.5
        return out.set("success", reached)

    def _step(self, tensordict):
        out = super()._step(tensordict)
        out["reward"] = out["success"].float()
        return out


def make_env():
    return ReachEnv(6)


@pytest.mark.parametrize("solved", [0, 1])
def test_a_policy_that_solves_nothing_is_said_to_teach_nothing(tmp_path, monkeypatch, recwarn, solved):
    training = make_training(tmp_path)
    counted = [SimpleNamespace(success=k < solved) for k in range(2)]
    monkeypatch.setattr("warmprior.rl.training.evaluate", lambda *args, **options: counted)
    training.run()
    assert any("none of 2 episodes" in str(warning.message) for warning in recwarn) == (solved == 0)


@pytest.mark.parametrize("prior", [PastPrior(H), GaussianPrior(H)])
def test_the_best_agent_of_the_evaluations_is_the_policy(tmp_path, prior):
    """By hand: the evaluation with the most successes, if it has more than the frozen policy."""
    actor = make_actor(prior)
    training = make_training(tmp_path, actor=actor)
    kept, evaluated = {}, training._evaluate

    def remembering(env, name, policy):
        evaluated(env, name, policy)
        weights = {n: v.clone() for n, v in training.agent.network.state_dict().items()}
        kept[training.steps] = weights

    training._evaluate = remembering
    curve = training.run()
    rates = {row["environment_steps"]: row["success_rate"] for row in curve if row["evaluation"] == "greedy"}
    base = curve[0]["success_rate"]
    policy = training.policy()
    best = max(rates, key=lambda steps: (rates[steps], -steps))
    if rates[best] > base:
        agent = training.agent.network
        agent.load_state_dict(kept[best])
        expected = improved_policy(actor, agent, nfe=2)
        assert same(policy.state_dict(), expected.state_dict())
    else:
        assert policy.start is None and policy.sampling.nfe == 2
    again = make_training(tmp_path, actor=actor).policy()  # from the folder
    assert same(policy.state_dict(), again.state_dict())


def test_a_policy_is_improved_compared_and_saved(tmp_path):
    actor = make_actor()
    options = {"make_env": make_env, "num_envs": 2, "description": None}
    config = make_config(environment_steps=60)
    result = improve_policy(actor, tmp_path / "run", config=config, episodes=4, **options)
    assert [row["evaluation"] for row in result.curve[:3]] == ["base", "greedy", "greedy"]
    save_policy(result.policy, tmp_path / "policy")
    env = parallel_env(make_env, partial(policy_transforms, actor), 2)
    for policy, solved in ((actor, result.before), (load_policy(tmp_path / "policy"), result.after)):
        played = evaluate(policy, env, episodes=4, first_seed=10_000_000, nfe=2)
        assert sum(episode.success for episode in played) == solved
    env.close()
    again = improve_policy(actor, tmp_path / "run", config=config, episodes=4, **options)
    assert (
        again.curve == result.curve
        and again.reach == result.reach > 0
        and (again.before, again.after) == (result.before, result.after)
    )


class ShapedEnv(ReachEnv):
    """The same with a reward of its own."""

    def _step(self, tensordict):
        out = super()._step(tensordict)
        out["reward"] = -5.0 + out["observation"][..., 2:3]
        return out


def shaped_env():
    return ShapedEnv(6)


def test_success_is_the_reward_whatever_the_environment_s_own_is(tmp_path):
    actor, config = make_actor(), make_config(environment_steps=60)
    options = {"num_envs": 2, "description": None, "config": config, "episodes": 4}
    states = []
    for place, build in (("own", make_env), ("shaped", shaped_env)):
        improve_policy(actor, tmp_path / place, make_env=build, **options)
        states.append(load_state(tmp_path / place / "state.safetensors")[0])
    assert same(*states)
    name = next(name for name in states[0] if "reward" in name)
    # By hand: a control step costs 1, one at which the task is solved nothing.
    assert ((states[0][name] <= 0) & (states[0][name] >= -H)).all()
    with raises(KeyError, "success", "gym_env"):
        improve_policy(actor, tmp_path / "none", make_env=partial(CountingEnv, 6), **options)


@pytest.mark.parametrize("shape", [(2,), (2, 1)])
@pytest.mark.parametrize("failing", [None, 0, 1])
def test_an_episode_that_was_solved_earlier_does_not_end_in_failure(tmp_path, recwarn, failing, shape):
    """By hand: two episodes of three decisions, solved at the first or second, but for the failing one."""
    training = make_training(tmp_path)
    solved = [[True, False], [False, True], [False, False]]
    for decision, flags in enumerate(solved * 2):
        flags = torch.tensor([flag and row != failing for row, flag in enumerate(flags)])
        ends = torch.full((2, 1), decision % 3 == 2)
        after = TensorDict({"success": flags.view(shape), "terminated": ends, "done": ends}, [2])
        training._check_failures(after)
    assert len([w for w in recwarn if "reward_offset" in str(w.message)]) == (failing is not None)


@pytest.mark.parametrize("offset", [1.0, 0.0])
@pytest.mark.parametrize("truncate", [True, False])
def test_failures_that_end_episodes_are_said_to_be_cheap(tmp_path, recwarn, truncate, offset):
    # Every other episode is not solved.
    make_training(tmp_path, env={"truncate": truncate}, reward_offset=offset).run()
    said = [w for w in recwarn if "reward_offset" in str(w.message)]
    assert len(said) == (offset > 0 and not truncate)


def test_updates_have_the_threads_that_waiting_workers_would_take(tmp_path, monkeypatch):
    threads, original = set(), PriorSpaceAgent.learn

    def counting(agent, buffer):
        threads.add(torch.get_num_threads())
        return original(agent, buffer)

    monkeypatch.setattr(PriorSpaceAgent, "learn", counting)
    actor = make_actor()
    with torch_threads(2):
        config, options = make_config(environment_steps=60), {"make_env": make_env, "num_envs": 2}
        options |= {"description": None}
        improve_policy(actor, tmp_path, config=config, episodes=2, **options)
    assert threads == {2}


@pytest.mark.parametrize("confirmed", [(1, 2), (2, 2), (2, 1)])
def test_an_agent_that_is_no_better_on_other_episodes_is_not_kept(tmp_path, monkeypatch, confirmed):
    """The evaluations choose the luckiest of several; the frozen policy stays unless others confirm it."""
    actor = make_actor()
    policies, seeds = [], []

    def counted(policy, env, *, episodes, first_seed, **options):
        seeds.append(first_seed)
        policies.append(policy)
        solved = confirmed[len(seeds) - 1] if len(seeds) < 3 else 3
        return [SimpleNamespace(success=k < solved) for k in range(episodes)]

    monkeypatch.setattr(improve, "evaluate", counted)
    lucky = improved_policy(actor, make_training(tmp_path / "other", actor=actor).agent.network, nfe=2)
    monkeypatch.setattr(improve.PriorSpaceTraining, "run", lambda self: [])
    monkeypatch.setattr(improve.PriorSpaceTraining, "policy", lambda self: lucky)
    monkeypatch.setattr(improve.PriorSpaceTraining, "reach", lambda self: 0.1)
    options = {"make_env": make_env, "num_envs": 2, "description": None}
    result = improve_policy(actor, tmp_path, config=make_config(environment_steps=60), episodes=4, **options)
    kept = confirmed[1] > confirmed[0]
    assert (result.policy is lucky) is result.improved is kept and (result.before, result.after) == (3, 3)
    assert len(policies) == 3 + kept and policies[1] is lucky
    assert len({*seeds[:2]}) == 1 and seeds[2] == 10_000_000 and seeds[0] > 10_000_000 + 4


def test_a_policy_of_gymnasium_is_improved_by_its_success(tmp_path, monkeypatch):
    """Played beside the library's numbers of episodes: environments that are seeded one by one."""
    dial = registered_dial(monkeypatch)
    described = registered_description({**dial, "kwargs": {}, "observation_keys": []})
    actor = mlp_actor(GaussianPrior(H), 1, 2, 1, nfe=2, clip=1.0, environment=described)
    config = make_config(environment_steps=60)
    result = improve_policy(actor, tmp_path, num_envs=2, config=config, episodes=4, description=None)
    single = partial(environment_of, actor)
    env = SerialEnv(2, [single, single])
    for policy, solved in ((actor, result.before), (result.policy, result.after)):
        played = evaluate(policy, env, episodes=4, first_seed=10_000_000)
        assert sum(episode.success for episode in played) == solved
    stored, _ = load_state(tmp_path / "state.safetensors")
    reward, executed = (stored[f'buffer/["next", "{name}"]'] for name in ("reward", "executed_steps"))
    assert set((reward + executed).flatten().tolist()) == {0.0, 1.0}  # the dial's own rewards are 1 a step


def test_a_policy_without_an_environment_is_refused(tmp_path):
    with raises(ValueError, "keeps no description"):
        improve_policy(make_actor(), tmp_path)
    with raises(ValueError, 5000, "episodes"):
        improve_policy(make_actor(), tmp_path, make_env=make_env, episodes=5001)
    with raises(ValueError, "guidance=None"):
        improve_policy(make_actor().replace(guidance=RealTimeChunking(execution_horizon=2)), tmp_path)
    registered = {"id": "Pendulum-v1", "kwargs": {}, "max_episode_steps": 20, "success": None}
    described = registered_description({**registered, "observation_keys": ["observation"]})
    with raises(KeyError, "success"):
        improve_policy(make_actor().replace(environment=described), tmp_path)
    assert not list(tmp_path.iterdir())
