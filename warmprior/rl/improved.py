"""A policy that a trained agent improves: its start point is the one that the agent chooses."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from warmprior import keys
from warmprior.modules.actor import StartPoint, WarmPriorActor
from warmprior.modules.prior import Prior
from warmprior.modules.registry import from_config
from warmprior.rl.anchor import check_source_space, has_anchor, held, source_anchor
from warmprior.rl.networks import make_prior_space_actor
from warmprior.saving.training_state import as_key

_READ = (keys.ANCHOR, keys.ACTIONS)
"""What agents read beside the observation."""


class AgentStart(StartPoint):
    r"""The start point that an agent chooses, :math:`a_0 = c + \Delta`.

    The anchor :math:`c` is that of :class:`~warmprior.PriorAnchor`: the source's mean where it is warm, and
    the source sample where it is cold; zero for a source without a moving centre.

    Args:
        prior: the source distribution, or its ``config()``.
        agent: the arguments of :func:`~warmprior.make_prior_space_actor`.
        observation_key: key of the observation that the agent reads.
        start: the start point of the policy before, or its ``config()``; none by default.
        greedy: True takes the agent's most likely residual, False draws it, with
            PyTorch's global generator.

    See Also:
        :func:`~warmprior.improved_policy`: builds the policy of a trained agent.

    Examples:
        >>> import torch
        >>> from warmprior import PastPrior
        >>> from warmprior.history import cold_history
        >>> from warmprior.rl.improved import AgentStart
        >>> sizes = {"action_dim": 2, "observation_dim": 3, "prediction_length": 4, "observation_steps": 1}
        >>> start = AgentStart(PastPrior(4), {**sizes, "delta": 0.5, "hidden_dim": 8})
        >>> noise, observation = torch.zeros(5, 4, 2), torch.zeros(5, 1, 3)
        >>> float(start(noise, cold_history([5], 4, 4, 2), observation).abs().amax().detach()) <= 0.5
        True
    """

    name = "agent"
    noise_share = 0.0

    def __init__(
        self,
        prior: Prior | dict[str, Any],
        agent: Mapping[str, Any],
        *,
        observation_key: Any = keys.OBSERVATION,
        start: StartPoint | dict[str, Any] | None = None,
        greedy: bool = True,
    ) -> None:
        super().__init__()
        self.prior = from_config(Prior, prior) if isinstance(prior, dict) else prior
        self.start = from_config(StartPoint, start) if isinstance(start, dict) else start
        self.time = 0.0 if self.start is None else self.start.time
        self.agent, self.greedy = dict(agent), greedy
        self.observation_key = as_key(observation_key)
        read = [as_key(key) for key in agent.get("in_keys", (self.observation_key, keys.ANCHOR))]
        self.module = make_prior_space_actor(**{**agent, "in_keys": read})
        self.moves = has_anchor(
            SimpleNamespace(prior=self.prior, start=self.start, network=SimpleNamespace(**agent))
        )

    def centre(self, history: TensorDictBase, observation: Tensor | None) -> Tensor:
        """Return the chosen start where the source sample is zero."""
        return self(torch.zeros_like(history["forecast"]), history, observation)

    def forward(self, noise: Tensor, history: TensorDictBase, observation: Tensor | None) -> Tensor:
        """Return the chosen start ``[*B, P, d_a]`` for a source sample."""
        anchor = torch.zeros_like(noise)
        if self.moves:
            mean, warm = source_anchor(self, history, observation)
            anchor = torch.where(warm, mean, noise)
        values = {self.observation_key: observation, keys.ANCHOR: anchor, keys.ACTIONS: history["actions"]}
        with set_exploration_type(ExplorationType.DETERMINISTIC if self.greedy else ExplorationType.RANDOM):
            delta = self.module(TensorDict(values, noise.shape[:-2]))[keys.DELTA]
        return anchor + held(delta, anchor.shape[-2]).to(anchor.dtype)


def check_improvable(actor: WarmPriorActor) -> None:
    """Raise ValueError if no agent can become part of the policy, for its guidance, times or images."""
    check_source_space(actor)
    if getattr(actor.network, "encodes", False):
        raise ValueError("the agent of a policy that sees images reads features, which no policy gives it")


def improved_policy(
    actor: WarmPriorActor,
    agent: ProbabilisticTensorDictSequential,
    *,
    nfe: int | None = None,
    greedy: bool = True,
) -> WarmPriorActor:
    """Return a policy whose flow starts where an agent chooses, with copies of the agent and the source.

    It is a :class:`~warmprior.WarmPriorActor` with a start point: it works in ``env.rollout``,
    :func:`~warmprior.evaluation.evaluate`, :class:`~warmprior.deploy.AsyncExecutor` and
    :func:`~warmprior.saving.save_policy` like the policy before. Its chunks are those that
    :class:`~warmprior.PriorDecoder` decodes in the agent's environment.

    Args:
        actor: the frozen policy that the agent was trained around.
        agent: the agent, from :func:`~warmprior.make_prior_space_actor`.

    Keyword Args:
        nfe: network evaluations per chunk, as in the training; those of the policy by default.
        greedy: True takes the agent's most likely residual, False draws it.

    Raises:
        TypeError: if the agent is not from :func:`~warmprior.make_prior_space_actor`.
        ValueError: if the policy is guided, is trained at ``t = 0`` only, or sees images, or the agent reads
            something else than its observation, anchor and last actions.

    Examples:
        >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor, make_prior_space_actor
        >>> from warmprior import improved_policy
        >>> actor = WarmPriorActor(VelocityMLP(2, 3, 4), PastPrior(4), nfe=1)
        >>> agent = make_prior_space_actor(2, 3, 4, delta=0.5, hidden_dim=16)  # untrained here
        >>> policy = improved_policy(actor, agent)
        >>> policy.start.name, policy.network is actor.network
        ('agent', True)
    """
    options = getattr(agent, "options", None)
    if options is None:
        raise TypeError(f"need an agent from make_prior_space_actor, got {type(agent).__name__}")
    check_improvable(actor)
    read = [as_key(key) for key in options["in_keys"]]
    if unknown := [key for key in read if key not in (actor.observation_key, *_READ)]:
        raise ValueError(
            f"the agent reads {unknown}, but a policy has {[actor.observation_key, *_READ]} for it"
        )
    prior = copy.deepcopy(actor.prior)
    start = AgentStart(
        prior.requires_grad_(False) if isinstance(prior, nn.Module) else prior,
        options,
        observation_key=actor.observation_key,
        start=copy.deepcopy(actor.start),
        greedy=greedy,
    )
    weight = next(agent.parameters())
    nn.Module.to(start.module, weight.dtype)  # TorchRL's own method takes no precision
    start.module.load_state_dict(agent.state_dict())
    start.requires_grad_(False).eval().to(weight.device)
    changes: dict[str, Any] = {} if nfe is None else {"nfe": nfe}
    # The anchor's noise is that of the training, under every exploration type.
    return actor.replace(start=start, temperature=1.0, **changes)
