"""A tiny training in source space, on an environment whose transitions are known in closed form."""

from functools import partial

import pytest
import torch
from torchrl.data import Categorical
from torchrl.envs import SerialEnv, TransformedEnv

from tests.toy_env import ACTION_DIM, CountingEnv, mlp_actor
from warmprior import HistoryObservation, PastPrior, PriorAnchor, keys, policy_transforms
from warmprior.rl import PriorSpaceConfig, PriorSpaceTraining

H = 3
LENGTHS = (5, 7)
EVALUATION_SEED = 100
ALGORITHMS = ("dsrl-na", "dsrl-sac")


class SolvableEnv(CountingEnv):
    """:class:`CountingEnv` with a success at every other episode's end, and a hook before every step."""

    before_step = None

    def __init__(self, length, truncate=False, device="cpu"):
        super().__init__(length, truncate, device)
        success = Categorical(2, dtype=torch.bool, shape=(1,), device=device)
        self.observation_spec["success"] = success

    def _seen(self, out):
        return out.set("success", out["done"] & (self.episode % 2 == 0))

    def _step(self, tensordict):
        out = super()._step(tensordict)
        return out if self.before_step is None else self.before_step(out)


def make_actor(prior=None, seed=0, action_dim=ACTION_DIM, see_history=False):
    prior = PastPrior(H) if prior is None else prior
    width = 2 + ACTION_DIM + see_history * HistoryObservation.width(H, action_dim)
    key = keys.CONDITIONED if see_history else keys.OBSERVATION
    return mlp_actor(prior, action_dim, width, 1, seed=seed, nfe=2, clip=1.0, observation_key=key)


def make_env(seed, actor=None, truncate=True, hook=None, device="cpu", **chunking):
    """Two environments; the hook gets what those of the training (and not of evaluations) return."""
    actor = make_actor() if actor is None else actor
    bases = [SolvableEnv(length, truncate, device) for length in LENGTHS]
    for base in bases:
        base.before_step = None if seed == 0 else hook
    transforms = policy_transforms(
        actor.prior, observation_steps=1, see_history=actor.sees_history, **chunking
    )
    transforms.append(PriorAnchor(actor))
    return TransformedEnv(SerialEnv(2, [lambda base=base: base for base in bases]), transforms)


def from_step(step, act):
    """A hook that lets ``act`` change what this control step and all later ones return."""
    count = iter(range(1, 10_000))

    def hook(out):
        if next(count) >= step:
            act(out)
        return out

    return hook


def make_config(**options):
    steps = {"environment_steps": 90, "warmup_steps": 30, "evaluate_every": 30, "evaluation_episodes": 2}
    sizes = {"batch_size": 8, "hidden_dim": 8, "num_layers": 1, "nfe": 2}
    return PriorSpaceConfig(**steps | sizes | {"updates": 1, "noise_critic_steps": 1} | options)


def hand_rollout(decisions, lengths):
    """Start, executed steps, reward sum and end of every decision, environment by environment."""
    time, result = [0] * len(lengths), []
    for _ in range(decisions):
        for i, length in enumerate(lengths):
            executed = min(H, length - time[i])
            rewards = range(time[i] + 1, time[i] + executed + 1)  # CountingEnv pays the step's number
            ended = time[i] + executed == length
            result.append((i, time[i], executed, sum(rewards), ended))
            time[i] = 0 if ended else time[i] + executed
    return result


def check_transitions(training, *, lengths=LENGTHS, offset=1.0):
    """What a training of WP-Past stored is what its environments do, with episodes of these lengths.

    The offset is that of rewards.
    """
    stored = training.buffer[:]
    expected = hand_rollout(len(stored) // len(lengths), lengths)
    assert len(stored) == len(expected)
    latest = {}
    for row, (i, start, executed, reward, ended) in zip(stored, expected, strict=True):
        following = row["next"]
        assert row["observation"][0, 0] == start
        # The last state of the episode, not the first of the next one.
        assert following["observation"][0, 0] == start + executed
        assert following["observation"][0, 1] == row["observation"][0, 1]
        last_action = row["vla_action", "chunk"][executed - 1]
        torch.testing.assert_close(following["observation"][0, 2:], last_action)
        assert following["executed_steps"] == executed
        assert float(following["reward"]) == pytest.approx(reward - offset * executed)
        # DSRL takes time-outs for terminations.
        assert following["done"] == following["terminated"] == ended
        # The mean of WP-Past is what was executed last.
        if executed == H:
            assert torch.equal(following["prior", "anchor"], row["vla_action", "chunk"])
        if i in latest:
            was_last, anchor = latest[i]
            assert torch.equal(anchor, row["prior", "anchor"]) != was_last
        latest[i] = (ended, following["prior", "anchor"])
    # What was decoded is what the residual says, in the network's precision: other environments store its
    # chunks in their own, and products with another number of rows have other last bits.
    decoded = training.decoder(stored.select("observation", "prior"))["vla_action", "chunk"]
    computed_in = next(training.decoder.parameters()).dtype
    torch.testing.assert_close(decoded.to(computed_in), stored["vla_action", "chunk"].to(computed_in))
    # All control steps are counted, those of the warm-up too.
    assert training.steps == sum(executed for _, _, executed, _, _ in expected)


def make_training(
    directory, actor=None, env=None, training_class=PriorSpaceTraining, running=None, **options
):
    actor = make_actor() if actor is None else actor
    environments = partial(make_env, **{"actor": actor} | (env or {}))
    running = {"evaluation_seed": EVALUATION_SEED} | (running or {})
    return training_class(actor, environments, make_config(**options), directory, **running)
