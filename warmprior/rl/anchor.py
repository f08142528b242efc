"""The centre of the agent's box, which environments write in prior-space reinforcement learning."""

from __future__ import annotations

import copy
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import unravel_key
from torch import Tensor, nn
from torchrl.data import TensorSpec

from warmprior import keys
from warmprior.checks import check_keys, check_whole_numbers
from warmprior.history import check_history, window_history
from warmprior.modules.prior import Prior, checked_mean
from warmprior.transforms.inner_step import EnvTransform, check_unwritten, keep_resting


def has_anchor(actor: Any) -> bool:
    """Return True if a policy's source has a moving centre, around which an agent can search.

    It has one if the policy has a start point, or its prior's mean is warm once the history is full.
    Otherwise agents search around zero, as in DSRL.

    Examples:
        >>> from warmprior import GaussianPrior, PastPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior.rl import has_anchor
        >>> network, priors = VelocityMLP(2, 3, 4), (GaussianPrior(4), PastPrior(4))
        >>> [has_anchor(WarmPriorActor(network, prior)) for prior in priors]
        [False, True]
    """
    prior, width = actor.prior, getattr(actor.network, "action_dim", None) or 1
    # A prior without mean() overrides distribution(), and its source moves.
    if actor.start is not None or type(prior).mean is Prior.mean:
        return True
    chunk, target = (torch.zeros(length, width) for length in (prior.history_length, prior.prediction_length))
    steps = torch.tensor([prior.history_length])
    history = window_history(chunk, steps, target, prior.chunk_length)
    return bool(checked_mean(prior, history)[1].any())


def check_source_space(actor: Any) -> None:
    """Raise ValueError unless the start of a policy's flow, which an agent chooses, decides the chunk."""
    if actor.ode.guidance is not None:
        raise ValueError("the agent alone must decide the chunk: use actor.replace(guidance=None)")
    if actor.sampling.max_nfe == 1:
        raise ValueError("the policy is trained at t = 0 alone, so an agent has no source space to act in")


def source_anchor(actor: Any, history: TensorDictBase, observation: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the centre of the source, ``[*B, P, d_a]``, and a mask of valid positions, bool ``[*B, P, 1]``.

    The histories are ``[*B]``, and the observations of the policy's network ``[*B, To, d_o]``.
    """
    if actor.start is not None:
        centre = actor.start.centre(history, observation)
        return centre, torch.ones_like(centre[..., :1], dtype=torch.bool)
    source = actor.prior.distribution(history, observation)
    return source.loc, source.warm


def residual_sigma(actor: Any) -> float:
    """Return the typical deviation of a policy's source from the centre of the search; 1 around zero."""
    if not has_anchor(actor):
        return 1.0
    if actor.start is not None:
        return actor.start.noise_share
    # The sigma of a learned source multiplies its own scale.
    return actor.prior.sigma * float(getattr(actor.prior, "typical_scale", 1.0))


def length_of_residuals(residual_length: int | None, prediction_length: int) -> int:
    """Return how many residuals a chunk has, by default one per action; raise ValueError if not whole."""
    length = prediction_length if residual_length is None else residual_length
    check_whole_numbers(residual_length=length)
    if prediction_length % length:
        raise ValueError(
            f"residual_length ({length}) must divide the prediction length ({prediction_length})"
        )
    return length


def held(delta: Tensor, length: int) -> Tensor:
    """Return residuals ``[*B, R, d_a]``, each held for ``length / R`` actions, as ``[*B, length, d_a]``."""
    return delta.repeat_interleave(length // delta.shape[-2], -2)


class PriorAnchor(EnvTransform):
    r"""A transform that writes the anchor of agents, ``[*B, P, d_a]``: the mean, and noise where it is cold.

    .. math::
        c_\tau = \mu_\tau \;\; (\tau \in W), \qquad
        c_\tau = \varepsilon_\tau \;\; (\tau \in C), \qquad a_0 = c + \Delta.

    The first chunk of an episode and the second half of a preview have no mean. A small box around zero would
    confine these positions to the middle of the source that the policy was trained on; a box around a draw of
    that source does not. This transform draws before the agent acts: the agent sees the noise, and the
    decoder is deterministic. So the decision process stays Markov (for WP-Past if whole chunks are executed,
    see :func:`~warmprior.make_prior_space_actor`). For a policy with a
    :class:`~warmprior.StartPoint` the mean is that of the start point. For a policy without a moving centre
    (:func:`~warmprior.has_anchor`) the anchor is zero, which is vanilla DSRL: :math:`a_0 = \Delta`.

    Append it after :class:`ActionHistory`, inside or outside batched environments.

    .. note::
        ``env.set_seed`` seeds PyTorch's global generator only in the workers of a ``ParallelEnv`` (not with
        ``use_buffers=False``) and of a ``MultiCollector``: in your own process call ``torch.manual_seed``.
        Workers without a seed, or with the same one, draw the same noise: append the transform outside them.

    Args:
        actor: the policy. A learned prior is copied as it is then, and the copy moves with the environment:
            load weights into the policy before.

    Raises:
        ValueError: if the lengths of the environment's history differ from the policy's.
        KeyError: if :class:`ActionHistory` does not precede it.

    Examples:
        >>> from torchrl.envs import Compose, GymEnv, TransformedEnv
        >>> from warmprior import ActionHistory, ChunkStep, PastPrior, PriorAnchor
        >>> from warmprior import VelocityMLP, WarmPriorActor
        >>> actor = WarmPriorActor(VelocityMLP(1, 3, 4), PastPrior(4))
        >>> env = TransformedEnv(
        ...     GymEnv("Pendulum-v1"), Compose(ChunkStep(4), ActionHistory(4), PriorAnchor(actor)))
        >>> rollout = env.rollout(2)
        >>> anchor = rollout["prior", "anchor"]
        >>> bool(anchor[0].any()), bool((anchor[1] == rollout["history", "actions"][1]).all())
        (True, True)
    """

    prior: Any
    start: Any

    def __init__(self, actor: Any) -> None:
        super().__init__(in_keys=list(actor.in_keys), out_keys=[keys.ANCHOR])
        # Copies, so that moving the environment does not move the policy's own.
        self.prior, self.start = (
            copy.deepcopy(part).cpu().requires_grad_(False) if isinstance(part, nn.Module) else part
            for part in (actor.prior, actor.start)
        )
        self.moves = has_anchor(actor)
        self.observation_key, self.history_key = actor.observation_key, actor.history_key

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        history = next_tensordict.get(self.history_key, None)
        check_history(history, self.prior.history_length, self.prior.prediction_length, self.prior)
        forecast = history["forecast"]
        if not self.moves:
            return next_tensordict.set(keys.ANCHOR, torch.zeros_like(forecast))
        # Drawn on the CPU, so that a seed gives the same noise on every device.
        noise = torch.randn(forecast.shape, dtype=forecast.dtype).to(forecast.device)
        with torch.no_grad():
            mean, valid = source_anchor(self, history, next_tensordict.get(self.observation_key, None))
        return next_tensordict.set(keys.ANCHOR, torch.where(valid, mean, noise))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return keep_resting(tensordict, self._call(next_tensordict), [keys.ANCHOR])

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the anchor."""
        forecast = unravel_key((self.history_key, "forecast"))
        check_keys(observation_spec, [forecast], "PriorAnchor", ": append it after ActionHistory")
        check_unwritten(observation_spec, self.out_keys, "PriorAnchor")
        observation_spec[keys.ANCHOR] = observation_spec[forecast].clone()
        return observation_spec
