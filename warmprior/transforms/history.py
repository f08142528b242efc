"""The environment's side of the history, and what networks see of it."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, expand_as_right, unravel_key
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Transform

from warmprior import keys
from warmprior.checks import check_between, check_finite_numbers, check_keys, check_whole_numbers
from warmprior.history import advance, cold_history, history_keys, without
from warmprior.transforms.inner_step import EnvTransform, check_unwritten, keep_resting


class ActionHistory(EnvTransform):
    """Writes the history for the next decision after each step, and a cold one at resets.

    It has no state, so it does the same in ``env.rollout``, collectors and batched environments, inside and
    outside of workers, and per sub-environment when some of them reset. :mod:`warmprior.history` has the
    layout.

    Args:
        history_length: how many executed actions are remembered, usually ``H``.
        chunk_key: key of the executed chunk.
        history_key: where the history is written; with keys of their own, several policies share an
            environment.

    Raises:
        ValueError: if ``history_length < 1``.
        KeyError: if :class:`ChunkStep` does not come before, or a step's input lacks the history.

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
        """Forget the environment that this one, or what it was cloned from, was in."""
        super().set_container(container)
        self._chunk = None

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        history = tensordict.get(self.history_key, None)
        if history is None:
            raise KeyError(
                f"ActionHistory found no {self.history_key!r} in a step's input: hand over what the reset or "
                "the step before gave, with the chunk"
            )
        executed = next_tensordict.get(keys.EXECUTED)
        if executed is None:
            raise KeyError(
                f"ActionHistory found no {keys.EXECUTED!r} after the step: append it after ChunkStep"
            )
        if history.ndim > next_tensordict.ndim:  # agents of a group, which execute alike
            executed = expand_as_right(executed.squeeze(-1), history["steps"])
        moved = advance(history, tensordict.get(self.in_keys[0]), executed)
        next_tensordict.set(self.history_key, moved)
        # The others' chunks were not executed.
        next_tensordict = keep_resting(tensordict, next_tensordict, self.out_keys)
        self._remember_ends(next_tensordict, [self.history_key])
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        # Everywhere: TorchRL merges these rows into the sub-environments that were reset only.
        chunk = self._chunk or self._check_chunk()
        return tensordict_reset.set(self.history_key, self._cold(chunk, tensordict_reset))

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the history."""
        check_unwritten(observation_spec, self.out_keys, "ActionHistory")
        for name, value in self._cold(self._check_chunk(), observation_spec).items():
            spec = Unbounded(value.shape, dtype=value.dtype, device=observation_spec.device)
            observation_spec[unravel_key((self.history_key, name))] = spec
        return observation_spec

    def _cold(self, chunk: TensorSpec, place: TensorDictBase | TensorSpec) -> TensorDictBase:
        agents = chunk.shape[len(place.shape) : -2]  # of a group, where there is one
        dtype = chunk.dtype if chunk.dtype.is_floating_point else torch.get_default_dtype()
        lengths, like = (self.history_length, *chunk.shape[-2:]), {"dtype": dtype, "device": place.device}
        return cold_history((*place.shape, *agents), *lengths, **like)

    def _check_chunk(self) -> TensorSpec:
        actions = self.parent.full_action_spec
        if self.in_keys[0] not in actions.keys(True, True):
            raise KeyError(
                f"ActionHistory found no {self.in_keys[0]} among the actions "
                f"{list(actions.keys(True, True))}: append it after ChunkStep"
            )
        # Kept because resets are frequent and TorchRL rebuilds specs on every access.
        self._chunk = actions[self.in_keys[0]]
        return self._chunk


class WithheldHistory(Transform):
    """Withholds the history of some training windows, so that the network also learns the cold start.

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
        check_finite_numbers(probability=probability)
        check_between(0.0, 1.0, probability=probability)
        self.probability = probability
        self.generator = generator

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Make some rows cold."""
        history = tensordict.get(keys.HISTORY, None)
        if history is None:
            raise KeyError("WithheldHistory found no history: append it after ActionWindow")
        if tensordict.get(keys.CONDITIONED, None) is not None:
            raise ValueError(
                "the history is in the observation already: put WithheldHistory before HistoryObservation, "
                "or take withhold= of window_replay_buffer"
            )
        device = history["actions"].device
        draw = torch.rand(history.batch_size, generator=self.generator, device=device)
        return tensordict.set(keys.HISTORY, without(history, draw < self.probability))


class HistoryObservation(EnvTransform):
    """Appends the last ``H`` actions to the observation, in environments and replay buffers alike.

    It writes ``keys.CONDITIONED``, ``[*B, To, d_o + H * d_a + 1]``: the actions, flattened (zero until there
    are ``H`` of them), and whether there are ``H``, repeated over the observation steps. Build the network
    with ``observation_dim = d_o + HistoryObservation.width(H, d_a)`` and the policy with
    ``observation_key=keys.CONDITIONED``. In an environment it comes after :class:`~warmprior.ActionHistory`.

    Args:
        observation_key: the observation, ``[*B, To, d_o]``, or one with images nested under the key, whose
            vector ``"state"`` is extended.
        history_key: key of the history.

    Raises:
        KeyError: if an input key is missing.
        ValueError: if the observation has several entries, but no vector ``"state"``.

    Examples:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from warmprior import GaussianPrior, HistoryObservation, policy_transforms
        >>> transforms = policy_transforms(GaussianPrior(2), observation_steps=1, see_history=True)
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), transforms)
        >>> seen = env.rollout(2)["prior", "observation"]  # 3 observations, 2 actions, whether there are 2
        >>> seen.shape, seen[:, 0, -1].tolist(), 3 + HistoryObservation.width(2, action_dim=1)
        (torch.Size([2, 1, 6]), [0.0, 1.0], 6)
    """

    def __init__(
        self, *, observation_key: NestedKey = keys.OBSERVATION, history_key: NestedKey = keys.HISTORY
    ) -> None:
        read = [unravel_key(observation_key), *history_keys(history_key)[:2]]
        super().__init__(in_keys=read, out_keys=[keys.CONDITIONED])

    @staticmethod
    def width(history_length: int, action_dim: int) -> int:
        """How much wider the observation becomes: ``H * d_a + 1``."""
        return history_length * action_dim + 1

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the extended observation."""
        observation, actions, steps = self._read(tensordict)
        known = steps >= actions.shape[-2]
        seen = torch.where(known.unsqueeze(-1), actions, 0.0).flatten(-2)
        context = torch.cat([seen, known.to(seen)], dim=-1).unsqueeze(-2)

        def extend(vector: Tensor) -> Tensor:
            added = context.expand(*vector.shape[:-1], context.shape[-1]).to(vector.dtype)
            return torch.cat([vector, added], dim=-1)

        return tensordict.set(self.out_keys[0], _with_vector(observation, extend))

    def _read(self, place: TensorDictBase | Composite) -> list[Any]:
        """The values or specs under the input keys."""
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
            return Unbounded(shape, dtype=vector.dtype, device=vector.device)

        observation_spec[self.out_keys[0]] = _with_vector(observation, extend)
        return observation_spec


def _with_vector(observation: Any, extend: Any) -> Any:
    """An observation or its spec, a vector or several entries, with its vector extended."""
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
