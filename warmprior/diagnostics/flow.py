"""What the diagnostics of a policy's flow share: checked windows, sources and the field itself."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from warmprior import keys
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.network import encoded
from warmprior.transforms.mean_observation import MeanObservation

Field = Callable[[Tensor, Tensor], Tensor]


@dataclass
class Windows:
    """A batch of windows, flattened to ``N``, on the policy's device.

    Attributes:
        shape: the batch's own shape.
        observation: what the network sees, ``[N, To, d_o]``.
        loc: ``[N, P, d_a]``.
        warm: bool ``[N, P, 1]``.
        counted: positions inside the episode, bool ``[N, P, 1]``.
        target: ``[N, P, d_a]``, if there is one.
    """

    shape: torch.Size
    observation: Tensor
    loc: Tensor
    warm: Tensor
    counted: Tensor
    target: Tensor | None

    def __len__(self) -> int:
        return len(self.loc)

    def repeat(self, draws: int) -> Windows:
        """The windows ``draws`` times in a row, for as many samples of the source each."""
        parts = (self.observation, self.loc, self.warm, self.counted, self.target)
        repeated = [None if p is None else p.repeat(draws, *[1] * (p.ndim - 1)) for p in parts]
        return Windows(self.shape, *repeated)  # type: ignore[arg-type]


def flat_windows(
    policy: WarmPriorActor, batch: TensorDictBase, *, target_needed: bool = False
) -> Windows:
    """Check a batch and bring it into shape.

    Raises:
        KeyError: if a needed key is missing.
        ValueError: if the batch is empty, holds NaN or Inf, or belongs to another prediction length.
    """
    observation_key, loc_key, warm_key = policy.in_keys[:3]
    needed = [*policy.in_keys, *([policy.chunk_key] if target_needed else [])]
    missing = [key for key in needed if batch.get(key, None) is None]
    if missing:
        bare = "" if policy.ode.guidance is None else ", or measure policy.replace(guidance=None)"
        raise KeyError(
            f"the batch lacks {missing}; sample windows from window_replay_buffer, or take a rollout{bare}"
        )
    if batch.batch_size.numel() == 0:
        raise ValueError("the batch holds no observation")
    if isinstance(batch.get(observation_key), TensorDictBase):
        raise ValueError(
            f"{observation_key!r} has several entries, and diagnostics take vectors: pass "
            "encoded_windows(policy, windows)"
        )
    device = next(policy.parameters()).device
    prior, ndim = policy.prior, batch.ndim

    def flat(key: object) -> Tensor | None:
        value = batch.get(key, None)
        return None if value is None else value.reshape(-1, *value.shape[ndim:]).to(device)

    observation, loc, warm = flat(observation_key), flat(loc_key), flat(warm_key)
    target, pad = flat(policy.chunk_key), flat(keys.IS_PAD)
    assert observation is not None and loc is not None and warm is not None
    for key, value in ((observation_key, observation), (loc_key, loc), (policy.chunk_key, target)):
        if value is None:
            continue
        if key != observation_key and value.shape[-2] != prior.prediction_length:
            raise ValueError(
                f"{key} has {value.shape[-2]} positions, but {prior} predicts "
                f"{prior.prediction_length}: sample the windows with the policy's own prior"
            )
        if not torch.isfinite(value).all():
            raise ValueError(f"{key} holds NaN or Inf")
    counted = torch.ones_like(warm) if pad is None else ~pad.unsqueeze(-1)
    return Windows(
        batch.batch_size,
        observation,
        loc,
        warm,
        counted,
        target,
    )


def encoded_windows(
    policy: WarmPriorActor, windows: TensorDictBase, *, split: int = 256
) -> TensorDictBase:
    """Windows with what the policy's network makes of observations that hold images.

    Diagnostics evaluate the network many times at the same observations, and look for near ones among them:
    they take vectors. Windows of such observations are returned as they are.

    Args:
        policy: the policy.
        windows: ``[n]``, see :class:`~warmprior.ActionWindow`.

    Keyword Args:
        split: network batch size, for bounded memory.

    Returns:
        Windows ``[n]`` with features ``[n, To, d_o]`` as the observation.

    Raises:
        ValueError: if there are none.

    Examples:
        >>> from tensordict import TensorDict
        >>> from warmprior import ImageEncoder, PastPrior, VelocityMLP, VisionNetwork
        >>> encoder = ImageEncoder(["agentview_image"], 9, image_size=16, crop_size=12, backbone="small")
        >>> network = VisionNetwork(encoder, VelocityMLP(2, encoder.observation_dim, 4, hidden_dim=8))
        >>> images = torch.zeros(6, 2, 3, 16, 16, dtype=torch.uint8)
        >>> windows = TensorDict(
        ...     {"observation": {"state": torch.zeros(6, 2, 9), "agentview_image": images}}, [6])
        >>> encoded_windows(WarmPriorActor(network, PastPrior(4)), windows)["observation"].shape
        torch.Size([6, 2, 73])
    """
    key = policy.in_keys[0]
    observation = windows.get(key, None)
    if not isinstance(observation, TensorDictBase):
        return windows
    if windows.batch_size.numel() == 0:
        raise ValueError("the batch holds no observation")
    device = next(policy.parameters()).device
    with evaluation_mode(policy):
        parts = [encoded(policy.network, part.to(device)) for part in observation.split(split)]
    features = torch.cat(parts)  # type: ignore[arg-type]
    result = windows.copy().to(device).set(key, features)
    if policy.prior.conditions_network:  # the same without the mean, which stands behind the vector
        bare = windows[keys.OBSERVATION][keys.STATE].shape[-1]
        extended = observation[keys.STATE].shape[-1]
        without = torch.cat([features[..., :bare], features[..., extended:]], -1)
        result.set(keys.OBSERVATION, without)
    return result


def told_mean(policy: WarmPriorActor, windows: TensorDictBase) -> TensorDictBase:
    """Write what a network that sees the mean is told of it anew, after the mean has changed.

    Observations with images have to be as they are, not encoded: the mean stands at their vector's end.

    Raises:
        KeyError: if the windows lack what the network sees, or the mean.
    """
    if not policy.prior.conditions_network:
        return windows
    told, loc_key, warm_key = policy.in_keys[:3]
    make = MeanObservation(observation_key=told, loc_key=loc_key, warm_key=warm_key, out_key=told)
    for key in (told, loc_key):
        if windows.get(key, None) is None:
            raise KeyError(f"the batch lacks {key!r}; windows of the policy's own prior hold it")
    seen = windows.get(told)
    width = MeanObservation.width(policy.prior, windows.get(loc_key).shape[-1])
    if isinstance(seen, TensorDictBase):
        bare: Any = seen.copy().set(keys.STATE, seen.get(keys.STATE)[..., :-width])
    else:
        bare = seen[..., :-width]
    return make(windows.set(told, bare))


def observed(policy: WarmPriorActor, batch: TensorDictBase) -> Tensor:
    """The observations of a batch without the mean that a conditioned network sees beside them."""
    key = policy.in_keys[0]
    if policy.prior.conditions_network and isinstance(batch.get(keys.OBSERVATION), Tensor):
        key = keys.OBSERVATION
    return batch.get(key)


def check_flow(policy: WarmPriorActor, steps: int) -> None:
    """Refuse policies whose field means nothing along a whole path.

    Raises:
        ValueError: if the prior allows fewer than ``steps`` network evaluations, or ``steps < 1``.
    """
    if steps < 1:
        raise ValueError(f"a path needs at least 1 step, got {steps}")
    if not policy.prior.is_flow and steps > 1:
        raise ValueError(
            f"{policy.prior} trains its field for one network evaluation: it has no path of {steps} steps"
        )


def field_of(policy: WarmPriorActor, observation: Tensor) -> Field:
    """The velocity ``(t [n], a_t [n, P, d_a]) -> [n, P, d_a]`` at given observations."""
    return lambda t, a: policy.network(t, a, observation)


@contextmanager
def evaluation_mode(policy: WarmPriorActor) -> Iterator[None]:
    """No dropout and no gradients, and every module's mode as before afterwards."""
    modes = [(module, module.training) for module in policy.modules()]
    policy.eval()
    try:
        with torch.no_grad():
            yield
    finally:
        for module, mode in modes:
            module.training = mode


def allowed_nfes(policy: WarmPriorActor, nfes: Sequence[int]) -> list[int]:
    """Those that the prior allows, ascending.

    Raises:
        ValueError: if it allows none, or the solver cannot spend one.
    """
    allowed = sorted(set(policy.prior.allowed_nfes(nfes)))
    for nfe in allowed:
        policy.ode.check_nfe(nfe)
    return allowed


def predict(
    policy: WarmPriorActor, rows: TensorDictBase, a0: Tensor, *, nfe: int, split: int
) -> Tensor:
    """The chunks ``[N, P, d_a]`` that windows ``[N]`` and sources lead to, ``split`` at a time.

    Raises:
        FloatingPointError: if one is NaN or infinite.
    """
    parts = rows.clone(recurse=False).set(policy.ode.in_keys[0], a0).split(split)
    chunk = torch.cat([policy.integrate(part, nfe).get(policy.chunk_key) for part in parts])
    if not torch.isfinite(chunk).all():
        raise FloatingPointError(f"at NFE {nfe} a prediction is NaN or infinite")
    return chunk


class RunningVariance:
    """Mean and variance of tensors that arrive one by one, per element (Welford)."""

    def __init__(self) -> None:
        self.count = 0
        self.mean = torch.zeros(())
        self.deviations = torch.zeros(())

    def add(self, value: Tensor) -> Tensor:
        """Take another one in, and return it."""
        self.count += 1
        difference = value - self.mean
        self.mean = self.mean + difference / self.count
        self.deviations = self.deviations + difference * (value - self.mean)
        return value

    def variance(self, *, unbiased: bool = False) -> Tensor:
        """Squared deviations by their number, or by one less."""
        return self.deviations / (self.count - unbiased)
