"""A normaliser's transforms of an environment."""

from __future__ import annotations

from typing import Self

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import ActionScaling, ObservationNorm, Transform

from warmprior import keys
from warmprior.checks import check_keys
from warmprior.modules.normalize import Normalizer, check_width
from warmprior.transforms.inner_step import check_real


class FollowsNormalizer(Transform):
    """A transform by the statistics of a normaliser, which takes them anew at every reset.

    They are the normaliser's own tensors, until others take their place there: where a policy is moved or
    cast, or its weights are loaded with ``assign=True``.
    """

    loc: Tensor
    scale: Tensor
    _source: tuple[Normalizer, NestedKey]

    def following(self, normalizer: Normalizer, key: NestedKey) -> Self:
        """Follow a normaliser, and return the transform."""
        self._source = normalizer, key  # not as a part, which would move with the environment
        return self

    def follow(self) -> None:
        """Take the normaliser's statistics."""
        normalizer, key = self._source
        for name, theirs in (("loc", normalizer.loc(key)), ("scale", normalizer.scale(key))):
            mine = getattr(self, name)
            # Not copied into mine, which others may hold. Collectors pickle policies without their numbers.
            if mine is not theirs and not theirs.is_meta:
                setattr(self, name, theirs.to(mine))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        self.follow()
        return super()._reset(tensordict, tensordict_reset)


class FloatNorm(FollowsNormalizer, ObservationNorm):
    """TorchRL's transform, for integers and flags too: its specs would keep their type, and buffers cut."""

    def _apply_transform(self, obs: Tensor) -> Tensor:
        return super()._apply_transform(obs if obs.is_floating_point() else obs.to(self.loc.dtype))

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Set the spec of what is normalised, which has the precision of the statistics, or a higher one."""
        present = sorted(map(str, observation_spec.keys(True, True)))
        hint = f", the environment writes {present}: rename its entry, or fit the normaliser to data with it"
        check_keys(observation_spec, self.in_keys, "the normaliser of the demonstrations", hint)
        for key in self.in_keys:
            leaf = observation_spec[key]
            check_width(key, leaf.shape, self.loc)
            dtype = torch.promote_types(leaf.dtype, self.loc.dtype)
            if leaf.dtype != dtype:
                observation_spec[key] = Unbounded(leaf.shape, dtype=dtype, device=leaf.device)
        return super().transform_observation_spec(observation_spec)


class FloatScaling(FollowsNormalizer, ActionScaling):
    """TorchRL's transform, in the precision of the actions and not in that of the statistics."""

    def _inv_apply_transform(self, action: Tensor) -> Tensor:
        return super()._inv_apply_transform(action).to(action.dtype)

    def transform_action_spec(self, action_spec: Composite) -> Composite:
        """Set the spec of the normalised action, which has the width of the statistics."""
        for key in self.in_keys_inv:
            if key in action_spec.keys(True, True):
                leaf = action_spec[key]
                check_real(key, leaf, "the normaliser")
                check_width(key, leaf.shape, self.loc)  # one number would fit any width
        return super().transform_action_spec(action_spec)


def normalizing_transforms(normalizer: Normalizer, action_key: NestedKey = keys.ACTION) -> list[Transform]:
    """Return TorchRL transforms that (de)normalise directly after the base environment.

    Append them before :class:`~warmprior.ChunkStep`, so that they act on every control step. They share the
    normaliser's statistics, and follow it where others are loaded into it, from the next reset on: of
    simulators that restart rows themselves (``native_autoreset``), from the next call of ``reset``. Workers
    in other processes keep those of their start.

    Raises:
        TypeError: at the environment, if its actions are integers.
        ValueError: at the environment, if its actions or observations have another width.

    Examples:
        >>> import torch
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from warmprior import Normalizer, normalizing_transforms
        >>> least = {"observation": torch.full((3,), -8.0), "action": torch.full((1,), -2.0)}
        >>> normalizer = Normalizer(least, {key: -value for key, value in least.items()})
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), *normalizing_transforms(normalizer))
        >>> bool((env.rollout(5)["observation"].abs() <= 1).all())
        True
    """
    transforms: list[Transform] = []
    for key in normalizer.keys:
        loc, scale = normalizer.loc(key), normalizer.scale(key)
        if key == action_key:
            scaling = FloatScaling(in_keys_inv=[key], in_keys=[], loc=loc, scale=scale)
            transforms.append(scaling.following(normalizer, key))
        else:
            norm = FloatNorm(in_keys=[key], loc=loc, scale=scale, standard_normal=True)
            transforms.append(norm.following(normalizer, key))
    return transforms
