"""Steps in memory as demonstrations."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, override

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from warmprior.checks import check_keys
from warmprior.data.demonstrations import Demonstrations
from warmprior.data.index import DatasetIndex
from warmprior.keys import ACTION, EPISODE, OBSERVATION, STATE


def demonstrations_of(
    steps: TensorDictBase, name: str = "demonstrations", *, style: str = "human", normalised: bool = False
) -> Demonstrations:
    """Return contiguous steps in memory as demonstrations, which a :class:`~warmprior.tasks.Task` takes.

    Args:
        steps: contiguous steps ``[N]``, with ``"observation"`` ``[N, d_o]``, ``"action"`` ``[N, d_a]`` and
            ``"episode"``, an integer ``[N]``. With images, ``"observation"`` has the entries ``"state"``
            ``[N, d_o]`` and each image, uint8 ``[N, 3, size, size]``.
        name: short name of the task.

    Keyword Args:
        style: style of the demonstrations.
        normalised: True if the steps are in normalised units; otherwise a task fits a normaliser to them.

    Raises:
        KeyError: if the steps lack an entry.
        ValueError: if an entry has another shape or type.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior.data import demonstrations_of
        >>> steps = {"observation": torch.rand(60, 3), "action": torch.rand(60, 1),
        ...          "episode": torch.arange(60) // 20}
        >>> demonstrations_of(TensorDict(steps, [60]), "pendulum").index().lengths
        (20, 20, 20)
    """
    return _Steps(steps, name, style=style, normalised=normalised)


class _Steps(Demonstrations):
    prefix = ""

    def __init__(self, steps: TensorDictBase, name: str, *, style: str, normalised: bool) -> None:
        super().__init__(name, style=style)
        self.normalised = normalised  # type: ignore[misc]
        if steps.ndim != 1:
            raise ValueError(f"the demonstrations of {name} must be flat steps [N], got {tuple(steps.shape)}")
        needed = (OBSERVATION, ACTION, EPISODE)
        check_keys(steps, needed, f"the demonstrations of {name}", f": they have {list(steps.keys())}")
        vector: NestedKey = OBSERVATION
        self._images: dict[str, int] = {}
        if isinstance(steps[OBSERVATION], TensorDictBase):
            vector = (OBSERVATION, STATE)
            check_keys(steps, [vector], f"the demonstrations of {name}", ", the robot's state next to images")
            sizes: set[int] = set()
            for key, image in steps[OBSERVATION].exclude(STATE).items():
                sizes.update(image.shape[2:])
                if image.dtype != torch.uint8 or image.ndim != 4 or image.shape[1] != 3 or len(sizes) > 1:
                    raise ValueError(
                        f"{key!r} of {name} has shape {tuple(image.shape)} of {image.dtype}, but images must "
                        "be uint8 [N, 3, size, size], of one size for all cameras: crop or resize them"
                    )
                self._images[key] = image.shape[-1]
        for key, shape in ((vector, "[N, d]"), (ACTION, "[N, d]"), (EPISODE, "[N]")):
            value = steps[key]
            found = f"{value.dtype} {tuple(value.shape)}" if isinstance(value, Tensor) else "text"
            if found == "text" or value.is_complex() or value.ndim != len(shape.split()):
                raise ValueError(f"{key!r} of {name} must be real numbers {shape}, got {found}")
        if steps[EPISODE].is_floating_point() or bool((steps[EPISODE] < 0).any()):
            raise ValueError(f"{EPISODE!r} of {name} must be whole numbers from 0 on, got {found}")
        self._values, self._vector = steps.select(*needed), vector

    @property
    @override
    def title(self) -> str:
        return str(self.place)

    @property
    @override
    def facts(self) -> dict[str, Any]:
        return {}

    @override
    def index(
        self, observations: Sequence[str] | None = None, images: Sequence[str] = (), *, poses: bool = False
    ) -> DatasetIndex:
        if observations is not None or images or poses:
            raise ValueError(
                f"observations and images of {self.title} are what its steps hold: leave these options out"
            )
        episodes, lengths = self._values[EPISODE].unique(return_counts=True)
        return DatasetIndex(
            path=Path(self.title),
            demos=tuple(map(str, episodes.tolist())),
            lengths=tuple(lengths.tolist()),
            observation_keys=(OBSERVATION,),
            observation_dims=(self._values[self._vector].shape[-1],),
            image_keys=tuple(self._images),
            image_size=next(iter(self._images.values()), 0),
            available_keys=(OBSERVATION, *self._images),
            action_dim=self._values[ACTION].shape[-1],
        )

    @override
    def steps(self, *_: Any, **__: Any) -> TensorDictBase:
        return self._values
