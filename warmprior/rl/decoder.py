"""A decoder from the agent's residual to the executed chunk, through a frozen policy."""

from __future__ import annotations

import copy
from typing import Any, Literal, get_args

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import nn
from torchrl.data import Bounded, Composite
from torchrl.envs import EnvBase

from warmprior import keys
from warmprior.checks import check_choice, check_keys, check_positive, check_shape, check_whole_numbers
from warmprior.modules.actor import WarmPriorActor, check_usual_keys
from warmprior.modules.generator import Drawing
from warmprior.rl.anchor import check_source_space, has_anchor, held, length_of_residuals, residual_sigma
from warmprior.transforms.inner_step import EnvTransform


class PriorDecoder(TensorDictModuleBase):
    r"""A decoder around a frozen policy: ``(observation, anchor, delta) -> (noise, chunk)``.

    An agent acts in the policy's source space through a bounded residual around an anchor,

    .. math::
        a_0 = \mu + \Delta, \qquad \Delta \in [-\delta, \delta]^{R \times d_a},

    and the policy's own ODE carries :math:`a_0` to the chunk, deterministically. The anchor comes from
    :class:`~warmprior.PriorAnchor`; with zero anchors this is `DSRL <https://arxiv.org/abs/2506.15799>`_.

    Place it after the agent, ``TensorDictSequential(agent, decoder)``, or use :class:`~warmprior.PriorSpace`,
    which puts it before the environment. It runs a copy of the policy under ``no_grad``; the copy is frozen
    and stays in evaluation mode. Initialise an agent before you combine the two: ``apply`` and
    ``reset_parameters_recursive`` of the sequence reach the policy too.

    Args:
        actor: the policy, which is copied as it is then (load weights into it before), or an object with the
            same interface, such as :class:`~warmprior.lerobot.LeRobotActor`.
        delta: half the side of the agent's box, in units of the normalised action space. The paper uses 0.5
            around a warm mean and 1.5 around zero.
        residual_length: the number ``R`` of residuals ``[*B, R, d_a]`` that the agent chooses, each held for
            ``P / R`` actions; ``P`` by default. One residual per chunk shifts all of its actions together,
            as DSRL does with large policies.

    Raises:
        ValueError: if ``delta`` is not a finite number > 0, ``residual_length`` does not divide ``P``, or the
            policy is trained at ``t = 0`` only, is guided, or has keys of its own.
        KeyError: (when called) if an input key is missing.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import PastPrior, PriorDecoder, VelocityMLP, WarmPriorActor
        >>> decoder = PriorDecoder(WarmPriorActor(VelocityMLP(2, 3, 4), PastPrior(4), nfe=1), delta=0.5)
        >>> data = TensorDict({"observation": torch.zeros(5, 2, 3),
        ...     "prior": {"anchor": torch.zeros(5, 4, 2), "delta": torch.full((5, 4, 2), 0.5)}}, [5])
        >>> decoder(data)["vla_action", "chunk"].shape
        torch.Size([5, 4, 2])
        >>> float(data["prior", "noise"].mean()), any(p.requires_grad for p in decoder.parameters())
        (0.5, False)
    """

    def __init__(self, actor: WarmPriorActor, *, delta: float, residual_length: int | None = None) -> None:
        super().__init__()
        check_positive(delta=delta)
        check_usual_keys(actor, "PriorDecoder")
        check_source_space(actor)
        self.delta = float(delta)
        self.ode = copy.deepcopy(actor.ode)
        self.normalizer = copy.deepcopy(actor.normalizer)
        self.prior, self.start = copy.deepcopy(actor.prior), copy.deepcopy(actor.start)
        self.requires_grad_(False).eval()
        self.prediction_length = actor.prior.prediction_length
        self.residual_length = length_of_residuals(residual_length, self.prediction_length)
        #: The number ``d_a``, or ``None`` if the network does not have it.
        self.action_dim = getattr(actor.network, "action_dim", None)
        self.observation_key = self.ode.observation_key
        self.in_keys = [self.observation_key, keys.ANCHOR, keys.DELTA]
        self.out_keys = [self.ode.in_keys[0], *self.ode.out_keys]

    @property
    def network(self) -> nn.Module:
        """The frozen network."""
        return self.ode.network

    @property
    def sizes(self) -> dict[str, int]:
        """The policy's sizes, as arguments of :func:`make_prior_space_actor` and its critics.

        Raises TypeError if the network does not have them.
        """
        names = ("action_dim", "observation_dim", "prediction_length", "observation_steps")
        sizes: dict[str, Any] = {name: getattr(self.network, name, None) for name in names}
        if missing := [name for name, size in sizes.items() if size is None]:
            kind = type(self.network).__name__
            raise TypeError(
                f"an agent needs the policy's {', '.join(missing)}: make {kind} a VelocityNetwork"
            )
        return sizes | {"residual_length": self.residual_length}

    @dispatch(auto_batch_size=False)
    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the source and the chunk."""
        hint = ". PriorAnchor writes the anchor in an environment and the agent the residual"
        check_keys(tensordict, self.in_keys, "PriorDecoder", hint)
        anchor, delta = tensordict.get(keys.ANCHOR), tensordict.get(keys.DELTA)
        chunk_shape = (self.prediction_length, self.action_dim or anchor.shape[-1])
        check_shape(str(keys.ANCHOR), anchor, (*anchor.shape[:-2], *chunk_shape))
        check_shape(str(keys.DELTA), delta, (*anchor.shape[:-2], self.residual_length, anchor.shape[-1]))
        residual = held(delta, self.prediction_length)
        noise = anchor + residual.to(anchor.dtype)  # in the environment's precision
        inputs = tensordict.select(self.observation_key).set(keys.NOISE, noise)
        return tensordict.update(self.ode(inputs).select(*self.out_keys_source))

    def check_env(self, env: EnvBase) -> None:
        """Check that the policy's chunks have the length and width that an environment takes.

        Raises:
            KeyError: if the environment takes no chunk.
            ValueError: if the length or width differs.
        """
        actions = env.full_action_spec
        hint = f" of the actions {list(actions.keys(True, True))}: append ChunkStep first"
        check_keys(actions, [keys.CHUNK], "PriorDecoder", hint)
        *batch, _, width = actions[keys.CHUNK].shape
        expected = (*batch, self.prediction_length, self.action_dim or width)
        check_shape("the chunk that the environment takes", actions[keys.CHUNK], expected)

    def train(self, mode: bool = True) -> PriorDecoder:
        """Stay in evaluation mode."""
        return super().train(False)


class PriorSpace(EnvTransform):
    r"""A transform with the residual as action: :math:`\Delta \in [-\delta, \delta]^{R \times d_a}`.

    It is the other way to use :class:`~warmprior.PriorDecoder`, for agents and tools that expect a plain
    environment with a bounded action. The transitions are those of ``TensorDictSequential(agent, decoder)``,
    but the source is under ``("next", "decoded", "noise")`` and the chunk under ``("next", "decoded",
    "chunk")``. They are part of the next state, because TorchRL drops the entries that an inverse transform
    writes. There their usual names would mean the next step's.

    Append it last, after :class:`~warmprior.PriorAnchor`, and outside batched environments: inside, every
    worker would hold a copy of the network.

    Args:
        decoder: the frozen policy.

    Raises:
        KeyError: if :class:`~warmprior.ChunkStep` or :class:`~warmprior.PriorAnchor` does not precede it.
        ValueError: if the environment's chunks do not fit the policy, see :meth:`PriorDecoder.check_env`.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from warmprior import PastPrior, PriorAnchor, PriorDecoder, PriorSpace, VelocityMLP
        >>> from warmprior import WarmPriorActor, policy_transforms
        >>> from warmprior.envs import NavigationEnv
        >>> actor = WarmPriorActor(VelocityMLP(1, 9, 4, observation_steps=1), PastPrior(4), nfe=1)
        >>> transforms = policy_transforms(actor.prior, observation_steps=1)
        >>> transforms.append(PriorAnchor(actor))
        >>> transforms.append(PriorSpace(PriorDecoder(actor, delta=0.5)))
        >>> env = TransformedEnv(NavigationEnv(batch_size=[3]), transforms)
        >>> env.action_keys, env.rollout(2)["next", "decoded", "chunk"].shape
        ([('prior', 'delta')], torch.Size([3, 2, 4, 1]))
    """

    def __init__(self, decoder: PriorDecoder) -> None:
        written = [keys.DECODED_NOISE, keys.DECODED_CHUNK]
        super().__init__(out_keys=written, in_keys_inv=[keys.CHUNK], out_keys_inv=[keys.DELTA])
        self.decoder = decoder

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.decoder(tensordict)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        for key, out_key in zip(self.decoder.out_keys, self.out_keys, strict=True):
            next_tensordict.set(out_key, tensordict.get(key))
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        anchor = self._anchor_of(tensordict_reset)
        for key in self.out_keys:
            tensordict_reset.set(key, torch.zeros_like(anchor))
        return tensordict_reset

    def _anchor_of(self, observations: Any) -> Any:
        check_keys(observations, [keys.ANCHOR], "PriorSpace", ": append it after PriorAnchor")
        return observations[keys.ANCHOR]

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Replace the chunk by the bounded residual."""
        self.decoder.check_env(self.parent)
        actions = input_spec["full_action_spec"]
        leaf, delta = actions[keys.CHUNK], self.decoder.delta
        *batch, _, width = leaf.shape
        # In the agent's precision, and not in that of the environment's actions.
        shape = (*batch, self.decoder.residual_length, width)
        actions[keys.DELTA] = Bounded(-delta, delta, shape, device=leaf.device)
        # The whole branch is removed, because an empty one would count as an action.
        del actions[keys.CHUNK[0]]
        return input_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the source and the chunk."""
        anchor = self._anchor_of(observation_spec)
        for key in self.out_keys:
            observation_spec[key] = anchor.clone()
        return observation_spec


ResidualDistribution = Literal["normal", "clipped", "uniform"]


class ResidualSampler(Drawing, TensorDictModuleBase):
    r"""A sampler of residuals without an agent, for the warm-up and for distilling the noise critic.

    ``"normal"`` draws :math:`\sigma \varepsilon`, the training prior, which may leave the agent's box;
    ``"clipped"`` clips it to :math:`[-\delta, \delta]`, and ``"uniform"`` draws from
    :math:`U[-\delta, \delta]`. Here :math:`\delta` is the decoder's, and :math:`\sigma` the typical deviation
    of the source from the centre of the search: the prior's ``sigma`` around its mean, the start point's
    share of noise, or 1 around zero.

    ``TensorDictSequential(ResidualSampler(decoder), decoder)`` is a policy for the first steps of a collector
    (the environment's own random actions would be random *chunks* there).

    Args:
        decoder: the frozen policy.
        distribution: one of the names above. By default ``"clipped"`` around a mean (``"uniform"`` if the
            prior has no noise) and ``"normal"`` around zero, as in DSRL-NA; DSRL-SAC uses ``"clipped"``
            around zero.
        generator: source of randomness on the data's device; PyTorch's global one by default.

    Raises:
        ValueError: if the distribution is unknown, or not ``"uniform"`` for a prior without noise.
        KeyError: (when called) if the anchor is missing.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import PastPrior, PriorDecoder, ResidualSampler, VelocityMLP, WarmPriorActor
        >>> decoder = PriorDecoder(WarmPriorActor(VelocityMLP(2, 3, 4), PastPrior(4)), delta=0.5)
        >>> data = TensorDict({"prior": {"anchor": torch.zeros(100, 4, 2)}}, [100])
        >>> float(ResidualSampler(decoder)(data)["prior", "delta"].abs().max())
        0.5
    """

    def __init__(
        self,
        decoder: PriorDecoder,
        *,
        distribution: ResidualDistribution | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        sigma = residual_sigma(decoder)
        if distribution is None:
            distribution = "normal" if not has_anchor(decoder) else "clipped" if sigma > 0 else "uniform"
        check_choice("distribution", distribution, get_args(ResidualDistribution))
        if distribution != "uniform" and sigma == 0:
            raise ValueError(f"a prior without noise needs 'uniform', got the distribution {distribution!r}")
        self.distribution, self.generator = distribution, generator
        self.sigma, self.delta, self.residual_length = sigma, decoder.delta, decoder.residual_length
        self.in_keys, self.out_keys = [keys.ANCHOR], [keys.DELTA]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the residual."""
        check_keys(tensordict, self.in_keys, "ResidualSampler", ". PriorAnchor writes it")
        anchor = tensordict.get(self.in_keys[0])
        shape = (*anchor.shape[:-2], self.residual_length, anchor.shape[-1])
        # In the agent's precision, because a replay buffer holds residuals of both.
        like = {"device": anchor.device, "generator": self.chosen_generator()}
        if self.distribution == "uniform":
            delta = (2.0 * torch.rand(shape, **like) - 1.0) * self.delta
        else:
            delta = self.sigma * torch.randn(shape, **like)
        if self.distribution == "clipped":
            delta = delta.clamp(-self.delta, self.delta)
        return tensordict.set(self.out_keys[0], delta)


def residual_reach(
    decoder: PriorDecoder,
    states: TensorDictBase,
    *,
    draws: int = 16,
    generator: torch.Generator | None = None,
) -> float:
    """Return how far the agent's box moves chunks, in units of the normalised actions.

    It is the standard deviation of decoded actions over residuals from the whole box, at a fixed observation
    and anchor, as the root mean square over states, positions and dimensions. Near 0 an agent has nothing to
    choose from: demonstrations that are alike teach a policy to ignore where its flow starts, most of all at
    one network evaluation.

    Args:
        decoder: the frozen policy and its box.
        states: the observations and anchors, ``[N]``, such as those of a replay buffer.
        draws: residuals per state, at least 2.
        generator: source of randomness; PyTorch's global one by default.

    Raises:
        KeyError: if the states lack a key.
        ValueError: if ``draws`` is less than 2.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import PastPrior, PriorDecoder, VelocityMLP, WarmPriorActor
        >>> from warmprior import residual_reach
        >>> decoder = PriorDecoder(WarmPriorActor(VelocityMLP(2, 3, 4), PastPrior(4), nfe=1), delta=0.5)
        >>> states = TensorDict({"observation": torch.zeros(100, 2, 3),
        ...                      "prior": {"anchor": torch.zeros(100, 4, 2)}}, [100])
        >>> wide = PriorDecoder(WarmPriorActor(decoder.network, PastPrior(4), nfe=1), delta=1.0)
        >>> residual_reach(decoder, states) < residual_reach(wide, states)
        True
    """
    check_whole_numbers(2, draws=draws)
    box = ResidualSampler(decoder, distribution="uniform", generator=generator)
    states = states.select(decoder.observation_key, keys.ANCHOR)
    chunks = [decoder(box(states.copy()))[keys.CHUNK] for _ in range(draws)]
    return float(torch.stack(chunks).var(0).mean().sqrt())
