"""The environment's side of prior-space reinforcement learning: the centre of the agent's box."""

from __future__ import annotations

import copy
import multiprocessing
import random
from typing import Any, Literal, Self

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import nn
from torchrl.data import TensorSpec
from torchrl.envs.transforms import Transform

from warmprior import keys
from warmprior.modules.prior import Prior
from warmprior.rl.decoder import visible_priors

__all__ = ["PriorAnchor"]


class PriorAnchor(Transform):
    r"""Writes the anchor around which an agent acts in source space: the mean, and noise where it is cold.

    .. math::
        c_\tau = \mu_\tau \;\; (\tau \in W), \qquad
        c_\tau = \varepsilon_\tau \text{ or } 0 \;\; (\tau \in C), \qquad a_0 = c + \Delta.

    The first chunk of an episode has no mean, nor has the second half of a preview. A small box around
    zero would confine these positions to a corner of the source the policy was trained on; around a
    draw of that source it does not. The draw is made *here*, before the agent acts, and written next to
    the observation: the agent sees which noise will be used, the decision process stays Markov (for WP-Past
    if whole chunks are executed, see :func:`~warmprior.make_prior_space_actor`) and the decoder
    deterministic. ``("prior", "loc")`` is left alone, :class:`ActionHistory` carries it on. The mean is that
    of what the flow starts from at decisions, :meth:`Prior.anchor`: of :class:`~warmprior.StepPrior` a share
    of its forecast.

    Append it after :class:`ActionHistory`, inside or outside of batched environments.

    .. note::
        ``env.set_seed`` seeds the noise too. Workers of a batched environment that all get the same seed
        (``static_seed=True``) need different ``seed_offset``; outside of the workers one
        transform draws for all of them.

    Args:
        prior: the policy's source distribution. One that learns is copied, as it is now: the copy goes where
            the environment goes, and the policy's own where the policy goes.

    Keyword Args:
        cold: ``"noise"`` draws the cold source, N(0, I); ``"zero"`` puts zero. By default
            noise for priors with a mean and zero for the others (:class:`~warmprior.GaussianPrior`,
            :class:`~warmprior.HistoryPrior`), which gives vanilla DSRL: :math:`a_0 = \Delta`.
        seed: of the noise until ``env.set_seed`` is called. By default it is drawn from PyTorch's global
            generator with the first noise, and differs between the workers of a batched environment,
            whose generators are alike.
        seed_offset: mixed with the seed.
        observation_key: what the policy's network sees, ``[*B, To, d_o]``, for priors whose mean depends on
            it.
        loc_key: the mean, ``[*B, P, d_a]``.
        warm_key: its mask, bool ``[*B, P, 1]``.
        anchor_key: where the anchor is written, ``[*B, P, d_a]``.

    Raises:
        ValueError: for an unknown ``cold``, or if the environment's :class:`ActionHistory` carries another
            prior (compared where it can be seen, outside of workers; the length everywhere).
        KeyError: if :class:`ActionHistory` does not come before.

    Examples:
        >>> from torchrl.envs import GymEnv, TransformedEnv, Compose
        >>> from warmprior import ActionHistory, ChunkStep, PastPrior, PriorAnchor
        >>> prior = PastPrior(4)
        >>> env = TransformedEnv(
        ...     GymEnv("Pendulum-v1"), Compose(ChunkStep(4), ActionHistory(prior), PriorAnchor(prior)))
        >>> rollout = env.rollout(2)
        >>> anchor = rollout["prior", "anchor"]
        >>> bool(anchor[0].any()), bool((anchor[1] == rollout["prior", "loc"][1]).all())
        (True, True)
    """

    def __init__(
        self,
        prior: Prior,
        *,
        cold: Literal["noise", "zero"] | None = None,
        seed: int | None = None,
        seed_offset: int = 0,
        observation_key: NestedKey = keys.OBSERVATION,
        loc_key: NestedKey = keys.LOC,
        warm_key: NestedKey = keys.WARM,
        anchor_key: NestedKey = keys.ANCHOR,
    ) -> None:
        super().__init__(in_keys=[loc_key, warm_key], out_keys=[anchor_key])
        if cold not in (None, "noise", "zero"):
            raise ValueError(f"cold must be 'noise' or 'zero', got {cold!r}")
        if isinstance(prior, nn.Module):
            # It becomes a part of this one: whatever moved the environment would move the policy's weights.
            prior = copy.deepcopy(prior).cpu().requires_grad_(False)
        self.prior = prior
        self.follows_mean = prior.moves_source
        self.cold = cold or ("noise" if self.follows_mean else "zero")
        self.seed_offset = seed_offset
        self.observation_key = unravel_key(observation_key)
        self.loc_key, self.warm_key = unravel_key(loc_key), unravel_key(warm_key)
        self.anchor_key = unravel_key(anchor_key)
        self.generator: torch.Generator | None = None
        if seed is not None:
            self.set_seed(seed)

    def set_seed(self, seed: int | str) -> None:
        """Start the noise again from a seed; ``env.set_seed`` calls it.

        Args:
            seed: anything that has one text; mixed with ``seed_offset``.
        """
        state = random.Random(f"{seed}/{self.seed_offset}").getrandbits(62)
        self.generator = torch.Generator().manual_seed(state)

    def clone(self) -> Self:
        """A copy without environment, whose noise continues by itself."""
        twin = super().clone()
        if self.generator is not None:
            twin.generator = self.generator.clone_state()
        return twin

    def _environment(self) -> Any:
        try:
            return self.container
        except ValueError:  # of a chain that has none yet
            return None

    def set_container(self, container: Any) -> None:
        """Attach the transform, and have it told the seeds that its environment is given."""
        super().set_container(container)
        env = self._environment()
        if env is not None:
            # TorchRL hands seeds to the base environment alone. A method is copied with its object, so that
            # copies of the environment seed themselves.
            env.__dict__["set_seed"] = self._set_env_seed

    def reset_parent(self) -> None:
        """Detach the transform, whose environment gets its own ``set_seed`` back."""
        env = self._environment()
        if env is not None:
            env.__dict__.pop("set_seed", None)
        super().reset_parent()

    def _set_env_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        env = self._environment()
        if seed is not None:
            for transform in env.transform.modules():
                if isinstance(transform, PriorAnchor):
                    transform.set_seed(seed)
        return type(env).set_seed(env, seed, static_seed=static_seed)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        loc = next_tensordict.get(self.loc_key, None)
        warm = next_tensordict.get(self.warm_key, None)
        if loc is None or warm is None:
            raise KeyError(
                f"PriorAnchor found no {self.loc_key} and {self.warm_key}: append it after ActionHistory"
            )
        if loc.shape[-2] != self.prior.prediction_length:
            raise ValueError(
                f"{self.loc_key} has shape {tuple(loc.shape)}, but {self.prior} predicts "
                f"{self.prior.prediction_length} actions: ActionHistory must carry the same prior"
            )
        if self.cold == "noise":
            if self.generator is None:
                drawn = int(torch.randint(2**62, ()))
                self.set_seed(f"{drawn}/{multiprocessing.current_process().name}")
            # Drawn on the CPU: one seed gives one noise on every device.
            cold = torch.randn(loc.shape, generator=self.generator, dtype=loc.dtype)
            cold = cold.to(loc.device)
        else:
            cold = torch.zeros_like(loc)
        anchor = cold
        if self.follows_mean:
            observation = next_tensordict.get(self.observation_key, None)
            with torch.no_grad():
                mean = self.prior.anchor(loc, warm, observation)
            anchor = torch.where(warm | self.prior.always_warm, mean, cold)
        return next_tensordict.set(self.anchor_key, anchor)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # For all sub-environments: TorchRL keeps the rows of those that were reset.
        return self._call(tensordict_reset)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Outside environments the transform does nothing: the key is already in the data."""
        return tensordict

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the anchor."""
        if self.loc_key not in observation_spec.keys(True, True):
            raise KeyError(f"PriorAnchor found no {self.loc_key}: append it after ActionHistory")
        for transform, prior in visible_priors(self.parent):
            if prior.config() != self.prior.config():
                raise ValueError(
                    f"PriorAnchor was built for {self.prior}, but {transform} carries {prior}: all parts "
                    "of an environment need the policy's own prior"
                )
        observation_spec[self.anchor_key] = observation_spec[self.loc_key].clone()
        return observation_spec
