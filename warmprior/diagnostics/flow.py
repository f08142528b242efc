"""Common parts of the diagnostics: windows of every policy, sources and predictions."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from warmprior import keys
from warmprior.checks import (
    check_between,
    check_finite,
    check_finite_steps,
    check_keys,
    check_positions,
    check_whole_numbers,
)
from warmprior.history import advance
from warmprior.modules.actor import WarmPriorActor, check_usual_keys
from warmprior.modules.network import device_of, encoded
from warmprior.modules.prior import Prior
from warmprior.transforms.history import HistoryObservation
from warmprior.transforms.window import window_transforms

SPLIT = 4096
"""The largest batch of the network, which bounds memory and changes nothing else."""


def flat_windows(
    policy: WarmPriorActor, batch: TensorDictBase, *, target_needed: bool = False
) -> TensorDictBase:
    """Check a batch, and return it flattened to ``[N]``, on the policy's device.

    It has the policy's inputs, the target if the batch has one, the source's ``keys.LOC`` and ``keys.WARM``,
    and ``"counted"``, bool ``[N, P, 1]``: True inside the episode. Raises KeyError or ValueError if the batch
    is invalid.
    """
    observation_key = policy.observation_key
    needed = [*policy.in_keys, *([keys.CHUNK] if target_needed else [])]
    bare = "" if policy.ode.guidance is None else "; or measure policy.replace(guidance=None)"
    check_keys(batch, needed, "a batch of windows, or a rollout,", bare)
    check_not_empty(batch)
    check_usual_keys(policy, "a measure")
    if isinstance(batch.get(observation_key), TensorDictBase):
        raise ValueError(f"{observation_key!r} is not a vector: pass encoded_windows(policy, windows)")
    device, read = device_of(policy, batch.get(observation_key)), (*policy.in_keys, keys.CHUNK, keys.IS_PAD)
    flat = batch.select(*read, strict=False).reshape(-1).to(device)
    for key in (observation_key, keys.CHUNK, keys.ACTIONS, keys.FORECAST):
        if (value := flat.get(key, None)) is not None:
            check_finite_steps(key, value)
    if keys.CHUNK in flat.keys(True):
        check_positions(keys.CHUNK, flat[keys.CHUNK], policy.prior)
    with torch.no_grad():
        source = policy.sampler.source(flat)
    return flat.update({keys.LOC: source.loc, keys.WARM: source.warm, "counted": unpadded(flat, source.warm)})


def unpadded(windows: TensorDictBase, warm: Tensor) -> Tensor:
    """Return True at the positions that are not padding, bool ``[*B, P, 1]`` like `warm`."""
    pad = windows.get(keys.IS_PAD, None)
    return torch.ones_like(warm) if pad is None else pad.logical_not().unsqueeze(-1)


def check_not_empty(batch: TensorDictBase) -> None:
    """Raise ValueError if a batch has no elements."""
    if batch.batch_size.numel() == 0:
        raise ValueError(f"the batch has shape {list(batch.batch_size)}: it holds no observation")


def inputs_and_targets(
    policy: WarmPriorActor, windows: TensorDictBase
) -> tuple[TensorDictBase, Tensor, TensorDictBase, torch.Generator]:
    """Return windows, targets, the policy's inputs, and a generator with a fixed seed."""
    flat = flat_windows(policy, windows, target_needed=True)
    generator = torch.Generator(flat.device).manual_seed(0)
    return flat, flat[keys.CHUNK], flat.select(*policy.in_keys), generator


def depends_on_history(policy: WarmPriorActor, windows: TensorDictBase) -> bool:
    """Return True if a policy's chunks depend on the history of windows ``[*B]`` with encoded images."""
    sees = policy.sees_history or policy.start is not None
    return sees or bool(flat_windows(policy, windows)[keys.WARM].any())


def drawn(policy: WarmPriorActor, rows: TensorDictBase, generator: torch.Generator | None) -> Tensor:
    """Draw the points from which a policy integrates at windows ``[N]``, ``[N, P, d_a]``."""
    inputs = rows.select(*policy.in_keys)
    options = {"generator": generator, "temperature": policy.sampling.temperature}
    return policy.sampler(inputs, **options)[keys.NOISE]


def encoded_windows(policy: WarmPriorActor, windows: TensorDictBase, *, split: int = 256) -> TensorDictBase:
    """Return windows ``[n]`` whose images are encoded by the policy's network, ``split`` at a time.

    Their observation becomes the features ``[n, To, d_o]``, because diagnostics evaluate the network many
    times at the same observations. Windows without images are returned unchanged. Raises ValueError if there
    are no windows.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import ImageEncoder, PastPrior, VelocityMLP, VisionNetwork, WarmPriorActor
        >>> from warmprior.diagnostics import encoded_windows
        >>> encoder = ImageEncoder(["agentview_image"], 9, image_size=16, crop_size=12, backbone="small")
        >>> network = VisionNetwork(encoder, VelocityMLP(2, encoder.observation_dim, 4, hidden_dim=8))
        >>> images = torch.zeros(6, 2, 3, 16, 16, dtype=torch.uint8)
        >>> windows = TensorDict(
        ...     {"observation": {"state": torch.zeros(6, 2, 9), "agentview_image": images}}, [6])
        >>> encoded_windows(WarmPriorActor(network, PastPrior(4)), windows)["observation"].shape
        torch.Size([6, 2, 73])
    """
    key = policy.observation_key
    observation = windows.get(key, None)
    if not isinstance(observation, TensorDictBase):
        return windows
    check_not_empty(windows)
    device = device_of(policy, observation)
    with evaluation_mode(policy):
        parts = [encoded(policy.network, part.to(device)) for part in observation.split(split)]
    features = torch.cat(parts)  # type: ignore[arg-type]
    result = windows.copy().to(device).set(key, features)
    if policy.sees_history:  # the plain observation has no last actions, which follow the vector
        bare = windows[keys.OBSERVATION][keys.STATE].shape[-1]
        extended = observation[keys.STATE].shape[-1]
        without = torch.cat([features[..., :bare], features[..., extended:]], -1)
        result.set(keys.OBSERVATION, without)
    return result


def observe_history(policy: WarmPriorActor, windows: TensorDictBase) -> TensorDictBase:
    """Update the last actions in a network's observation after the history has changed."""
    return HistoryObservation()(windows) if policy.sees_history else windows


def check_flow(policy: WarmPriorActor, steps: int) -> None:
    """Raise ValueError if the field is not trained along a path of ``steps`` network evaluations."""
    check_whole_numbers(n_steps=steps)
    most = policy.sampling.max_nfe
    if most is not None and steps > most:
        raise ValueError(f"the policy is trained for at most {most} network evaluation(s), not {steps}")


@contextmanager
def evaluation_mode(policy: WarmPriorActor) -> Iterator[None]:
    """Turn off dropout and gradients, but not the source's noise; restore all modules' modes afterwards."""
    modes = [(module, module.training) for module in policy.modules()]
    policy.eval()
    try:
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            yield
    finally:
        for module, mode in modes:
            module.training = mode


def allowed_nfes(policy: WarmPriorActor, nfes: Sequence[int]) -> list[int]:
    """Return the NFEs that the policy is trained for, ascending; raise ValueError if there are none."""
    most = policy.sampling.max_nfe
    allowed = sorted({nfe for nfe in nfes if most is None or nfe <= most})
    if not allowed:
        raise ValueError(
            f"the policy is trained for at most NFE {most}, but {list(nfes)} has no such NFE: add {most}"
        )
    for nfe in allowed:
        policy.sampling.evaluations(nfe)
    return allowed


def predict(policy: WarmPriorActor, rows: TensorDictBase, a0: Tensor, nfe: int) -> Tensor:
    """Return the chunks ``[N, P, d_a]`` for windows ``[N]`` and sources, checked to be finite."""
    parts = rows.clone(recurse=False).set(keys.NOISE, a0).split(SPLIT)
    chunk = torch.cat([policy.integrate(part, nfe).get(keys.CHUNK) for part in parts])
    check_finite({f"a prediction at NFE {nfe}": chunk}, "the policy cannot be measured")
    return chunk


class RunningVariance:
    """Running mean and variance of tensors, per element (Welford)."""

    def __init__(self) -> None:
        self.count = 0
        self.mean = torch.zeros(())
        self.deviations = torch.zeros(())

    def add(self, value: Tensor) -> Tensor:
        """Include another tensor, and return it."""
        self.count += 1
        difference = value - self.mean
        self.mean = self.mean + difference / self.count
        self.deviations = self.deviations + difference * (value - self.mean)
        return value

    def variance(self, *, unbiased: bool = False) -> Tensor:
        """Return the variance, biased by default."""
        return self.deviations / (self.count - unbiased)


def deployed_history(
    policy: WarmPriorActor,
    previous: TensorDictBase,
    *,
    generator: torch.Generator | None = None,
) -> TensorDict:
    """Return ``[*B]`` with the ``"history"`` at deployment, after the policy's own previous prediction.

    ``previous`` are training windows ``[*B]``, ``H`` steps before those of interest in the same episodes.
    """
    data = previous.select(*policy.in_keys).to(flat_windows(policy, previous).device)
    with evaluation_mode(policy):
        chunk = policy(data, generator=generator).get(keys.CHUNK)
        steps = torch.full((*data.batch_size, 1), policy.prior.chunk_length, device=chunk.device)
        history = advance(data[keys.HISTORY], chunk, steps)
    return TensorDict({keys.HISTORY: history}, batch_size=data.batch_size, device=chunk.device)


class SharedObservations:
    """A set of observations with windows for policies of any prior with the same chunk length.

    It uses only steps with ``H`` earlier steps in their episode, so every history is complete.

    Args:
        data: contiguous normalised steps, see :class:`~warmprior.ActionWindow`; use held-out ones for a fair
            measure.
        chunk_length: ``H``.
        observation_steps: ``To``.

    Raises:
        KeyError: if the data lack a key.

    Examples:
        >>> from warmprior import PastPrior
        >>> from warmprior.diagnostics import SharedObservations
        >>> from warmprior.envs import navigation_demonstrations
        >>> shared = SharedObservations(navigation_demonstrations(), 4)  # 6 episodes of 64 steps
        >>> len(shared), shared.windows(PastPrior(4))["history", "actions"].shape
        (360, torch.Size([360, 4, 1]))
    """

    def __init__(self, data: TensorDictBase, chunk_length: int, *, observation_steps: int = 1) -> None:
        self.data, self.chunk_length = data, chunk_length
        self.observation_steps = observation_steps
        check_keys(data, [keys.EPISODE], "SharedObservations")
        episode = data.get(keys.EPISODE).flatten().cpu()
        first = torch.arange(len(episode)) - chunk_length
        self.frames = ((first >= 0) & (episode[first.clamp_min(0)] == episode)).nonzero().flatten()
        self.episodes = episode[self.frames]

    def __len__(self) -> int:
        return len(self.frames)

    def windows(self, prior: Prior, offset: int = 0, *, see_history: bool = False) -> TensorDictBase:
        """Return training windows ``[n]``, ``offset`` steps earlier, at most ``H``.

        Only the lengths of the prior matter. ``see_history`` is True if the network sees the last actions.
        Raises ValueError if the prior has another chunk length.
        """
        check_between(0, self.chunk_length, offset=offset)
        if prior.chunk_length != self.chunk_length:
            own = f"with the same chunk length: {self.chunk_length}"
            raise ValueError(f"compare policies {own}, but {prior} has {prior.chunk_length}")
        window = window_transforms(
            self.data, prior, observation_steps=self.observation_steps, see_history=see_history
        )
        frames = (self.frames - offset).to(self.data[keys.EPISODE].device)
        return window(TensorDict({keys.FRAME: frames}, [len(frames)]))

    def deployed(self, policy: WarmPriorActor, *, generator: torch.Generator | None = None) -> TensorDictBase:
        """Return windows as a policy meets them, with the history from its own previous prediction.

        See :func:`deployed_history`. A policy that does not depend on the history meets the training windows.
        Observations with images are encoded, see :func:`encoded_windows`.
        """
        see = policy.sees_history
        windows = self.windows(policy.prior, see_history=see)
        trained_on = encoded_windows(policy, windows)
        if not depends_on_history(policy, trained_on):
            return trained_on
        earlier = self.windows(policy.prior, offset=self.chunk_length, see_history=see)
        entries = deployed_history(policy, encoded_windows(policy, earlier), generator=generator)
        return encoded_windows(policy, observe_history(policy, windows.to(entries.device).update(entries)))

    def subset(self, index: Tensor) -> SharedObservations:
        """Return the observations with these indices, int64 ``[m]``."""
        part = copy.copy(self)
        part.frames, part.episodes = self.frames[index], self.episodes[index]
        return part
