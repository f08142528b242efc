"""The history in environments, and its part in a network's observation."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Transform
from torchrl.envs.utils import make_composite_from_td

from warmprior import keys
from warmprior.checks import check_between, check_keys, check_whole_numbers
from warmprior.history import advance, cold_history, history_keys, without
from warmprior.transforms.inner_step import EnvTransform, check_real, check_unwritten, keep_resting


class ActionHistory(EnvTransform):
    """A transform that writes the next decision's history after each step, and a cold history at resets.

    It has no state, so it works in ``env.rollout``, collectors and batched environments, inside and outside
    workers, and when only some sub-environments reset. :mod:`warmprior.history` describes the layout.

    Args:
        history_length: number of executed actions that are remembered, that of the prior (usually ``H``).
        chunk_key: key of the executed chunk.
        history_key: where the history is written. Policies that share an environment need different keys.

    Raises:
        ValueError: if ``history_length < 1``.
        KeyError: if :class:`ChunkStep` does not precede it, or a step's input lacks the history.
        TypeError: if the environment's actions are integers or flags.

    Examples:
        >>> from torchrl.envs import Compose, GymEnv, TransformedEnv
        >>> from warmprior import ActionHistory, ChunkStep
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), Compose(ChunkStep(4), ActionHistory(4)))
        >>> rollout = env.rollout(3)
        >>> rollout["history", "steps"].flatten().tolist()
        [0, 4, 4]
        >>> bool((rollout["history", "actions"][1:] == rollout["vla_action", "chunk"][:-1]).all())
        True
    """

    def __init__(
        self,
        history_length: int,
        *,
        chunk_key: NestedKey = keys.CHUNK,
        history_key: NestedKey = keys.HISTORY,
    ) -> None:
        super().__init__(in_keys=[unravel_key(chunk_key)], out_keys=history_keys(history_key))
        check_whole_numbers(history_length=history_length)
        self.history_length, self.history_key = history_length, unravel_key(history_key)
        self._chunk: TensorSpec | None = None

    def set_container(self, container: Transform | EnvBase) -> None:
        """Set the container, and forget the previous environment's action spec."""
        super().set_container(container)
        self._chunk = None

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        hint = " in a step's input: step with the tensordict of the last reset or step, and the chunk"
        check_keys(tensordict, [self.history_key], "ActionHistory", hint)
        check_keys(
            next_tensordict, [keys.EXECUTED], "ActionHistory", " after a step: append it after ChunkStep"
        )
        history, chunk = tensordict.get(self.history_key), tensordict.get(self.in_keys[0])
        next_tensordict.set(self.history_key, advance(history, chunk, next_tensordict.get(keys.EXECUTED)))
        # Rows that were not stepped have executed nothing.
        next_tensordict = keep_resting(tensordict, next_tensordict, self.out_keys)
        self._remember_ends(next_tensordict, [self.history_key])
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        # Written to all rows: TorchRL keeps those of the sub-environments that were reset.
        chunk = self._chunk or self._check_chunk()
        return tensordict_reset.set(self.history_key, self._cold(chunk, tensordict_reset))

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the history."""
        check_unwritten(observation_spec, self.out_keys, "ActionHistory")
        cold = self._cold(self._check_chunk(), observation_spec)
        observation_spec[self.history_key] = make_composite_from_td(cold)
        return observation_spec

    def _cold(self, chunk: TensorSpec, place: TensorDictBase | TensorSpec) -> TensorDictBase:
        lengths = self.history_length, *chunk.shape[-2:]
        like = {"dtype": chunk.dtype, "device": place.device}
        return cold_history(place.shape, *lengths, **like)

    def _check_chunk(self) -> TensorSpec:
        actions = self.parent.full_action_spec
        hint = f" of the actions {list(actions.keys(True, True))}: append it after ChunkStep"
        check_keys(actions, self.in_keys, "ActionHistory", hint)
        # Kept because resets are frequent and TorchRL rebuilds specs on every access.
        (key,) = self.in_keys
        check_real(key, actions[key], "ChunkStep")
        self._chunk = actions[key]
        return self._chunk


class WithheldHistory(Transform):
    """A transform that withholds the history of some training windows, to teach the network cold starts.

    Append it to a replay buffer (``withhold`` of :func:`~warmprior.window_replay_buffer`). The paper's
    Algorithm 1 withholds nothing.

    Args:
        probability: share of the windows, in [0, 1].
        generator: source of randomness on the windows' device; PyTorch's global one by default.

    Raises:
        ValueError: if the probability is not in [0, 1].

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import WithheldHistory
        >>> from warmprior.history import window_history
        >>> ones = torch.ones(1000, 2, 1)
        >>> history = window_history(ones, torch.full((1000, 1), 2), ones, chunk_length=2)
        >>> withheld = WithheldHistory(0.25, generator=torch.Generator().manual_seed(0))
        >>> batch = withheld(TensorDict({"history": history}, [1000]))
        >>> 0.2 < float((batch["history", "steps"] == 0).float().mean()) < 0.3
        True
    """

    def __init__(self, probability: float, *, generator: torch.Generator | None = None) -> None:
        super().__init__(in_keys=[keys.HISTORY], out_keys=[keys.HISTORY])
        check_between(0.0, 1.0, probability=probability)
        self.probability = probability
        self.generator = generator

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Make some rows cold."""
        check_keys(tensordict, self.in_keys, "WithheldHistory", ": append it after ActionWindow")
        history = tensordict.get(keys.HISTORY)
        if tensordict.get(keys.CONDITIONED, None) is not None:
            raise ValueError(
                "the history is in the observation already: put WithheldHistory before HistoryObservation, "
                "or use the argument withhold= of window_replay_buffer"
            )
        device = history["actions"].device
        draw = torch.rand(history.batch_size, generator=self.generator, device=device)
        return tensordict.set(keys.HISTORY, without(history, draw < self.probability))


class HistoryObservation(EnvTransform):
    """A transform that appends the last ``n`` actions to the observation, in environments and replay buffers.

    ``n`` is the prior's ``history_length``, usually ``H``. It writes ``keys.CONDITIONED``, ``[*B, To, d_o + n
    * d_a + 1]``: the flattened actions (zero until there are ``n``) and a flag that is 1 once there are
    ``n``, repeated over the observation steps. Build the network with ``observation_dim = d_o +
    HistoryObservation.width(n, d_a)`` and the policy with
    ``observation_key=keys.CONDITIONED``. In an environment, append it after
    :class:`~warmprior.ActionHistory`.

    Args:
        observation_key: key of the observation, ``[*B, To, d_o]``; if it has several entries, such as images,
            the vector ``"state"`` is extended.
        history_key: key of the history.

    Raises:
        KeyError: if an input key is missing.
        ValueError: if the observation has several entries, but no vector ``"state"``.

    Examples:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from warmprior import GaussianPrior, HistoryObservation, policy_transforms
        >>> transforms = policy_transforms(GaussianPrior(2), observation_steps=1, see_history=True)
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), transforms)
        >>> conditioned = env.rollout(2)["prior", "observation"]  # 3 observations, 2 actions, and the flag
        >>> conditioned.shape, conditioned[:, 0, -1].tolist(), 3 + HistoryObservation.width(2, action_dim=1)
        (torch.Size([2, 1, 6]), [0.0, 1.0], 6)
    """

    def __init__(
        self, *, observation_key: NestedKey = keys.OBSERVATION, history_key: NestedKey = keys.HISTORY
    ) -> None:
        read = [unravel_key(observation_key), *history_keys(history_key)[:2]]
        super().__init__(in_keys=read, out_keys=[keys.CONDITIONED])

    @staticmethod
    def width(history_length: int, action_dim: int) -> int:
        """Return the number of entries added to the observation, ``n * d_a + 1``."""
        return history_length * action_dim + 1

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the extended observation."""
        observation, actions, steps = self._read(tensordict)
        full = steps >= actions.shape[-2]
        flat = torch.where(full.unsqueeze(-1), actions, 0.0).flatten(-2)
        context = torch.cat([flat, full.to(flat)], dim=-1).unsqueeze(-2)

        def extend(vector: Tensor) -> Tensor:
            dtype = vector.dtype if vector.is_floating_point() else context.dtype
            added = context.expand(*vector.shape[:-1], context.shape[-1])
            return torch.cat([vector.to(dtype), added.to(dtype)], dim=-1)

        return tensordict.set(self.out_keys[0], _with_vector(observation, extend))

    def _read(self, place: TensorDictBase | Composite) -> list[Any]:
        """Return the values or specs under the input keys."""
        check_keys(
            place, self.in_keys, "HistoryObservation", ". In an environment append it after ActionHistory"
        )
        return [place[key] for key in self.in_keys]

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.forward(next_tensordict)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the extended observation."""
        check_unwritten(observation_spec, self.out_keys, "HistoryObservation")
        observation, actions, _ = self._read(observation_spec)

        def extend(vector: Unbounded) -> Unbounded:
            shape = (*vector.shape[:-1], vector.shape[-1] + self.width(*actions.shape[-2:]))
            dtype = vector.dtype if vector.dtype.is_floating_point else actions.dtype
            return Unbounded(shape, dtype=dtype, device=vector.device)

        observation_spec[self.out_keys[0]] = _with_vector(observation, extend)
        return observation_spec


def _with_vector(observation: Any, extend: Any) -> Any:
    """Extend the vector of an observation or of its spec, which may have several entries."""
    if not isinstance(observation, TensorDictBase | Composite):
        return extend(observation)
    if keys.STATE not in observation.keys():  # noqa: SIM118
        raise ValueError(
            "HistoryObservation appends the last actions to an observation vector [*B, To, d_o], but it has "
            f"the entries {sorted(map(str, observation.keys(True, True)))}: concatenate them before, or "
            f"call one {keys.STATE!r}"
        )
    whole = observation.clone() if isinstance(observation, Composite) else observation.copy()
    whole[keys.STATE] = extend(observation[keys.STATE])
    return whole
