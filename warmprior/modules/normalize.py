"""Min-max normalisation, fitted once and applied to data and environments."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from warmprior import keys
from warmprior.checks import check_finite_steps, check_keys, check_shape

LEAST = 1e-5
"""Half the range up to which a dimension counts as constant, in its unit, or as a share of its middle."""


def check_width(key: NestedKey, shape: torch.Size, loc: Tensor) -> None:
    """Raise ValueError unless values ``[*B, d]`` have the width of their statistics ``[d]``."""
    if shape[len(shape) - loc.ndim :] != loc.shape:
        raise ValueError(
            f"{key!r} has the shape {list(shape)}, but the normaliser was fitted to {list(loc.shape)}: give "
            "the entries that the demonstrations had"
        )


def middle_and_half(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Return the middle of a range and half of it."""
    # Halved first, because the sum of large numbers may be infinite.
    first, last = (value.detach().to(torch.get_default_dtype()) / 2 for value in (low, high))
    return last + first, last - first


def is_constant(middle: Tensor, half: Tensor) -> Tensor:
    """Return which dimensions count as constant, given the middle of their range and half of it."""
    return half <= LEAST * middle.abs().clamp(1.0, 1 / LEAST)


def warn_of_constant(
    key: NestedKey, middle: Tensor, half: Tensor, names: Sequence[str] | None = None
) -> None:
    """Warn of dimensions that count as constant although half their range is more than rounding noise."""
    # A body at rest moves by up to LEAST in a simulator; the size of an action is what somebody chose.
    least = LEAST * 1e-3 if key == keys.ACTION else LEAST
    rounding = 4 * torch.finfo(torch.float32).eps * middle.abs()
    varies = is_constant(middle, half) & (half > rounding.clamp_min(least))
    if varies.any():
        numbers = varies.nonzero().flatten().tolist()
        parts = [f"{names[i] if names else f'[{i}]'} by {2 * float(half[i]):.3g}" for i in numbers]
        warnings.warn(
            f"{key!r} varies in {', '.join(parts)}, which counts as constant: if it matters, subtract an "
            "offset, or use a smaller unit, such as millimetres",
            stacklevel=3,
        )


def bound_of(actions: Tensor) -> float | list[float]:
    """Return a bound of normalised actions ``[N, d_a]``: 1, or one each if a dimension reaches another."""
    bound = actions.abs().amax(0)
    bound = torch.where((bound - 1).abs() < 1e-4, 1.0, bound)
    return 1.0 if bool((bound == 1).all()) else bound.tolist()


class RawUnits(nn.Module):
    """A module whose buffers are in raw units, and never lose precision when a policy is cast."""

    def _apply(self, fn: Any, recurse: bool = True) -> Self:
        # The precision of a network may be too low for raw units.
        def moved(value: Tensor) -> Tensor:
            result = fn(value)
            wide = torch.promote_types(result.dtype, value.dtype) == result.dtype
            return result if wide else value.to(result.device)

        return super()._apply(moved, recurse)


class Normalizer(RawUnits):
    """Maps every dimension of every key to ``[-1, 1]`` with the data's minimum and maximum (Table 3).

    A dimension counts as constant, as the rounding noise of a body at rest is, if half its range is at most 1
    and at most ``1e-5 * max(1, |midpoint|)``; it is only shifted. The statistics are buffers; they keep their
    precision where a policy is cast to a lower one.

    Args:
        low: minimum per key (or nested key, a tuple), each ``[d]``, raw units.
        high: maximum per key, each ``[d]``, raw units.

    Raises:
        ValueError: if the keys or shapes of ``low`` and ``high`` differ, values are not finite, or a
            minimum is above its maximum.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import Normalizer
        >>> data = TensorDict({"observation": torch.tensor([[0.0, 5.0], [4.0, 5.0]]),
        ...                    "action": torch.tensor([[-0.5], [1.0]])}, [2])
        >>> Normalizer.fit(data).normalize(data)["observation"].tolist()
        [[-1.0, 0.0], [1.0, 0.0]]
    """

    def __init__(self, low: dict[NestedKey, Tensor], high: dict[NestedKey, Tensor]) -> None:
        super().__init__()
        if low.keys() != high.keys():
            one, two = (sorted(map(str, value)) for value in (low, high))
            raise ValueError(f"low has the keys {one}, high has {two}")
        self.keys = list(low)
        for key in self.keys:
            check_shape(f"high of {key}", high[key], low[key].shape)
            if not (torch.isfinite(low[key]).all() and torch.isfinite(high[key]).all()):
                raise ValueError(f"{key}: the minimum or maximum is NaN or infinite")
            if (low[key] > high[key]).any():
                raise ValueError(f"{key}: a minimum is above its maximum")
            loc, half = middle_and_half(low[key], high[key])
            constant = is_constant(loc, half)
            self.register_buffer(_name(key, "loc"), loc)
            self.register_buffer(_name(key, "scale"), torch.where(constant, 1.0, half))

    @classmethod
    def fit(
        cls,
        data: TensorDictBase,
        keys: tuple[NestedKey, ...] = (keys.OBSERVATION, keys.ACTION),
        *,
        units: Mapping[NestedKey, Tensor] | None = None,
        names: Mapping[NestedKey, Sequence[str]] | None = None,
    ) -> Normalizer:
        """Return a normaliser with the minimum and maximum over all steps of a dataset.

        Args:
            data: flat steps ``[N]`` with raw ``[N, d]`` entries.
            keys: the entries to normalise.
            units: raw sizes ``[d]`` of one normalised unit, per key; 0 stands for half the range. Values
                are still centred on the range, and may leave ``[-1, 1]``.
            names: names of the dimensions of keys, for a warning of those that vary and count as constant.

        Raises:
            KeyError: if a key is missing.
            ValueError: if there are no steps, or an entry is not finite.
        """
        if not len(data):
            raise ValueError("cannot fit a normaliser to an empty dataset")
        check_keys(data, keys, "Normalizer.fit")
        for key in keys:
            if not isinstance(data[key], Tensor):
                raise ValueError(
                    f"cannot fit a normaliser to {key!r}, with the entries {sorted(data[key].keys())}: name "
                    f'each with keys=, such as ("{key}", "state")'
                )
            check_finite_steps(key, data[key])
        low, high = ({key: f(data[key], 0).clone() for key in keys} for f in (torch.amin, torch.amax))
        for key, unit in (units or {}).items():
            middle, half = (high[key] + low[key]) / 2, (high[key] - low[key]) / 2
            half = torch.where(unit > 0, unit.to(half), half)
            low[key], high[key] = middle - half, middle + half
        for key in keys:
            warn_of_constant(key, *middle_and_half(low[key], high[key]), (names or {}).get(key))
        return cls(low, high)

    @property
    def positive(self) -> list[str]:
        """The names of the buffers that are scales."""
        return [_name(key, "scale") for key in self.keys]

    def loc(self, key: NestedKey) -> Tensor:
        """Return the middle of the range of ``key``, ``[d]``, raw units."""
        self.check_has(key)
        return self.get_buffer(_name(key, "loc"))

    def scale(self, key: NestedKey) -> Tensor:
        """Return half the range of ``key`` (1 where it is constant), ``[d]``, raw units."""
        self.check_has(key)
        return self.get_buffer(_name(key, "scale"))

    def check_has(self, *needed: NestedKey) -> None:
        """Raise ValueError if the normaliser was not fitted to one of these keys."""
        if lacking := [key for key in needed if key not in self.keys]:
            raise ValueError(f"the normaliser has {self.keys}, but not {lacking}: fit it to data with them")

    def normalize(self, data: TensorDictBase) -> TensorDictBase:
        """Return a shallow copy in which the keys that are present are normalised."""
        return self._mapped(data, lambda value, loc, scale: (value - loc) / scale)

    def denormalize(self, data: TensorDictBase) -> TensorDictBase:
        """Return a shallow copy in which the keys that are present are in raw units again."""
        return self._mapped(data, lambda value, loc, scale: value * scale + loc)

    def _mapped(self, data: TensorDictBase, affine: Callable[..., Tensor]) -> TensorDictBase:
        data = data.clone(False)
        for key in self.keys:
            value, loc = data.get(key, None), self.loc(key)
            if value is not None:
                check_width(key, value.shape, loc)
                value = value if value.is_floating_point() else value.to(loc.dtype)
                data.set(key, affine(value, loc, self.scale(key)))
        return data

    def config(self) -> dict[str, Any]:
        """Return the keys and their shapes in JSON form; the values themselves are buffers."""
        return {"shapes": [[key, list(self.loc(key).shape)] for key in self.keys]}

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> Normalizer:
        """Return an unfitted normaliser with the keys and shapes of :meth:`config`, to load buffers into."""
        shapes = ((tuple(key) if isinstance(key, list) else key, shape) for key, shape in config["shapes"])
        zero: dict[NestedKey, Tensor] = {key: torch.zeros(shape) for key, shape in shapes}
        return cls(zero, zero)


def _name(key: NestedKey, part: str) -> str:
    name = key if isinstance(key, str) else "/".join(key)
    return f"{name.replace('.', ':')}_{part}"  # names of buffers have no dots
