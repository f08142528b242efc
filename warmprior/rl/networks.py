"""The actor and critics of an agent that acts in source space."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.data import Bounded, Composite
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator

from warmprior import keys
from warmprior.checks import check_distinct, check_positive, check_whole_numbers
from warmprior.rl.anchor import length_of_residuals


class BoxTanhNormal(TanhNormal):
    r""":class:`~torchrl.modules.TanhNormal` with log-probabilities in units of its box.

    For :math:`\Delta \in [-\delta, \delta]^n` they are those of :math:`\Delta / \delta \in [-1, 1]^n`, larger
    by :math:`n \log \delta`. So all losses measure the entropy of :func:`make_prior_space_actor`'s residuals
    as DSRL does, for any box.

    Args:
        loc: see the parent class.
        scale: see the parent class.
        kwargs (Any): options of the parent class, including ``low`` and ``high``.

    Examples:
        >>> import torch
        >>> from warmprior import BoxTanhNormal
        >>> loc, scale = torch.zeros(2), torch.ones(2)
        >>> small = BoxTanhNormal(loc, scale, low=-0.5, high=0.5, event_dims=1)
        >>> large = BoxTanhNormal(loc, scale, low=-1.5, high=1.5, event_dims=1)
        >>> bool(torch.isclose(small.log_prob(0.1 * torch.ones(2)), large.log_prob(0.3 * torch.ones(2))))
        True
    """

    def _change_of_units(self) -> Tensor:
        half = (self.high - self.low).double() / 2
        return half.log().expand(self.event_shape).sum().to(self.loc.dtype)

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density of ``value`` in units of the box."""
        return super().log_prob(value) + self._change_of_units()

    def rsample_and_log_prob(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> tuple[Tensor, Tensor]:
        """Draw a value with pathwise gradients; return it and its log-density in units of the box."""
        sample, log_prob = super().rsample_and_log_prob(sample_shape)
        return sample, log_prob + self._change_of_units()

    def sample_and_log_prob(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> tuple[Tensor, Tensor]:
        """Draw a value without pathwise gradients; return it and its log-density in units of the box."""
        sample, log_prob = super().sample_and_log_prob(sample_shape)
        return sample, log_prob + self._change_of_units()


LOG_STD_RANGE = (-20.0, 2.0)


@dataclass
class _Sizes:
    """The sizes of what an agent's networks read and write: observation, chunk and residual."""

    action_dim: int
    observation_dim: int
    prediction_length: int
    observation_steps: int
    residual_length: int | None

    def __post_init__(self) -> None:
        lengths = {name: size for name, size in vars(self).items() if name != "residual_length"}
        check_whole_numbers(**lengths)
        self.residual_length = length_of_residuals(self.residual_length, self.prediction_length)

    @property
    def residual(self) -> tuple[int, int]:
        """The shape of a residual, ``(R, d_a)``."""
        return cast(int, self.residual_length), self.action_dim


class _Trunk(nn.Module):
    """A network of ``num_layers`` times Linear, LayerNorm and Tanh, then Linear, on concatenated inputs."""

    def __init__(
        self,
        in_keys: Sequence[NestedKey],
        sizes: _Sizes,
        out_features: int,
        hidden_dim: int,
        num_layers: int,
        scales: Mapping[NestedKey, float],
    ) -> None:
        super().__init__()
        check_whole_numbers(hidden_dim=hidden_dim, num_layers=num_layers, out_features=out_features)
        check_distinct("in_keys", [str(key) for key in in_keys])
        names = [unravel_key(key) for key in in_keys]
        self.scales = [scales.get(name, 1.0) for name in names]
        lengths = [sizes.residual[0] if name == keys.DELTA else sizes.prediction_length for name in names[1:]]
        self.in_features = sizes.observation_steps * sizes.observation_dim + sum(lengths) * sizes.action_dim
        norm: dict[str, Any] = {"norm_class": nn.LayerNorm, "norm_kwargs": {"normalized_shape": hidden_dim}}
        # Its activation is Tanh.
        self.net = MLP(self.in_features, out_features, depth=num_layers, num_cells=hidden_dim, **norm)

    def forward(self, *inputs: Tensor) -> Tensor:
        dtype = cast(nn.Linear, self.net[-1]).weight.dtype  # observations may be doubles
        scaled = zip(inputs, self.scales, strict=True)
        x = torch.cat([value.flatten(-2).to(dtype) * scale for value, scale in scaled], dim=-1)
        if x.shape[-1] != self.in_features:
            shapes = [tuple(value.shape) for value in inputs]
            raise ValueError(f"the network was built for {self.in_features} inputs, got the shapes {shapes}")
        return self.net(x)


class _ActorHead(nn.Module):
    """A head with the residual's location and scale before squashing, each ``[*B, R, d_a]``."""

    def __init__(self, trunk: _Trunk, shape: tuple[int, int]) -> None:
        super().__init__()
        self.trunk = trunk
        self.shape = shape

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        loc, log_std = self.trunk(*inputs).chunk(2, dim=-1)
        scale = log_std.clamp(*LOG_STD_RANGE).exp()
        return loc.unflatten(-1, self.shape), scale.unflatten(-1, self.shape)


def make_prior_space_actor(
    action_dim: int,
    observation_dim: int,
    prediction_length: int,
    observation_steps: int = 2,
    *,
    delta: float,
    residual_length: int | None = None,
    hidden_dim: int = 256,
    num_layers: int = 3,
    in_keys: Sequence[NestedKey] = (keys.OBSERVATION, keys.ANCHOR),
) -> ProbabilisticActor:
    r"""Return a squashed Gaussian over :math:`\Delta \in [-\delta, \delta]^{R \times d_a}`, for SAC.

    It has DSRL's network: per layer ``Linear -> LayerNorm -> Tanh``, then location and log standard deviation
    (clipped to [-20, 2]). The official sizes are 3 layers of 2048 on Square and 128 on Transport. Its
    log-probabilities are in units of the box (:class:`BoxTanhNormal`), whose target entropy is 0 in DSRL.

    Args:
        action_dim: ``d_a``.
        observation_dim: ``d_o``.
        prediction_length: ``P``.
        observation_steps: ``To``.
        delta: half the side of the box, equal to :attr:`PriorDecoder.delta`.
        residual_length: the number ``R`` of residuals per chunk, see :class:`PriorDecoder`; ``P`` by default.
        hidden_dim: width of the layers.
        num_layers: number of layers.
        in_keys: keys of the observation, ``[*B, To, d_o]``, and of any tensors ``[*B, P, d_a]``. Leave the
            anchor out if it is always zero. Add ``keys.ACTIONS`` if the decoder or the next mean depends on
            more than the anchor: for a network that sees the last actions, and for WP-Past with
            ``execute < H``.

    Raises:
        ValueError: if a size is not positive, or ``delta`` is not a finite number > 0.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import make_prior_space_actor
        >>> data = TensorDict({"observation": torch.zeros(5, 2, 3),
        ...                    "prior": {"anchor": torch.zeros(5, 4, 2)}}, [5])
        >>> make_prior_space_actor(2, 3, 4, delta=0.5)(data)["prior", "delta"].shape
        torch.Size([5, 4, 2])
    """
    check_positive(delta=delta)
    sizes = _Sizes(action_dim, observation_dim, prediction_length, observation_steps, residual_length)
    residual = sizes.residual
    trunk = _Trunk(in_keys, sizes, 2 * math.prod(residual), hidden_dim, num_layers, {})
    parameters = ["delta_loc", "delta_scale"]
    actor = ProbabilisticActor(
        TensorDictModule(_ActorHead(trunk, residual), in_keys=list(in_keys), out_keys=parameters),
        in_keys=dict(zip(("loc", "scale"), parameters, strict=True)),
        out_keys=[keys.DELTA],
        spec=Composite({keys.DELTA: Bounded(-delta, delta, residual)}),
        distribution_class=BoxTanhNormal,
        # Two event dimensions give one log-probability per chunk, and not per action.
        distribution_kwargs={"low": -delta, "high": delta, "event_dims": 2},
        return_log_prob=True,
    )
    # For improved_policy, which builds it again.
    own = {"delta": delta, "hidden_dim": hidden_dim, "num_layers": num_layers, "in_keys": list(in_keys)}
    actor.options = {**vars(sizes), **own}
    return actor


def make_prior_space_critic(
    action_dim: int,
    observation_dim: int,
    prediction_length: int,
    observation_steps: int = 2,
    *,
    delta: float = 1.0,
    residual_length: int | None = None,
    hidden_dim: int = 256,
    num_layers: int = 3,
    in_keys: Sequence[NestedKey] = (keys.OBSERVATION, keys.ANCHOR, keys.DELTA),
    out_features: int = 1,
) -> ValueOperator:
    """Return a critic of residuals or of chunks, with the trunk of :func:`make_prior_space_actor`.

    The default evaluates residuals, for TorchRL's losses and as the noise critic of
    :class:`~warmprior.DSRLNALoss`, whose action critic has ``in_keys=(keys.OBSERVATION, keys.CHUNK)``. That
    one evaluates all ``P`` actions of a chunk, which determine the next mean for WP-Preview, and for WP-Past
    if whole chunks are executed. With ``execute < H`` earlier actions are part of the next mean: add
    ``keys.ACTIONS`` to the keys of actor and critics.

    Args:
        action_dim: ``d_a``.
        observation_dim: ``d_o``.
        prediction_length: ``P``.
        observation_steps: ``To``.
        delta: half the side of the box, by which residuals are divided.
        residual_length: the number ``R`` of residuals per chunk; ``P`` by default.
        hidden_dim: width of the layers.
        num_layers: number of layers.
        in_keys: keys of the observation, ``[*B, To, d_o]``, and of any tensors ``[*B, P, d_a]``.
        out_features: number of values per input, more than one for quantile critics.

    Raises:
        ValueError: if a size is not positive, or ``delta`` is not a finite number > 0.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import make_prior_space_critic
        >>> critic = make_prior_space_critic(2, 3, 4, in_keys=["observation", ("vla_action", "chunk")])
        >>> critic(TensorDict({"observation": torch.zeros(5, 2, 3),
        ...     "vla_action": {"chunk": torch.zeros(5, 4, 2)}}, [5]))["state_action_value"].shape
        torch.Size([5, 1])
    """
    check_positive(delta=delta)
    sizes = _Sizes(action_dim, observation_dim, prediction_length, observation_steps, residual_length)
    trunk = _Trunk(in_keys, sizes, out_features, hidden_dim, num_layers, {keys.DELTA: 1.0 / delta})
    # TorchRL would call it "state_value", because the action is not named "action".
    return ValueOperator(trunk, in_keys=list(in_keys), out_keys=["state_action_value"])
