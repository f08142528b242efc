"""Steps in memory as demonstrations."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, override

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from warmprior.checks import LARGEST, all_usable, check_finite_steps, check_keys
from warmprior.data.checks import check_kept
from warmprior.data.demonstrations import Demonstrations
from warmprior.data.index import BLOCK, DatasetIndex
from warmprior.keys import ACTION, EPISODE, OBSERVATION, STATE
from warmprior.modules.resize import resized
from warmprior.options.data import Resize


def demonstrations_of(
    steps: TensorDictBase,
    name: str = "demonstrations",
    *,
    style: str = "human",
    normalised: bool = False,
    image_size: int | None = None,
    resize: Resize = "squeeze",
) -> Demonstrations:
    """Return contiguous steps in memory as demonstrations, which a :class:`~warmprior.tasks.Task` takes.

    Args:
        steps: contiguous steps ``[N]``, with ``"observation"`` ``[N, d_o]``, ``"action"`` ``[N, d_a]`` and
            ``"episode"``, an integer ``[N]``. With images, ``"observation"`` has the entries ``"state"``
            ``[N, d_o]`` and each image, uint8 ``[N, 3, h, w]``.
        name: short name of the task.

    Keyword Args:
        style: style of the demonstrations.
        normalised: True if the steps are in normalised units; otherwise a task fits a normaliser to them.
        image_size: side to which images are resized, see :class:`Demonstrations`.
        resize: how they are resized.

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
    sized = {"image_size": image_size, "resize": resize}
    return _Steps(steps, name, style=style, normalised=normalised, **sized)


_NO_OBSERVATIONS = ("frame", "next", "done", "terminated", "truncated", "reward", "success", "is_init")
"""Entries of steps that are read nowhere, and that nobody expects a policy to see."""


class _Steps(Demonstrations):
    prefix = ""

    def __init__(self, steps: TensorDictBase, name: str, *, normalised: bool, **options: Any) -> None:
        super().__init__(name, **options)
        self.normalised = normalised  # type: ignore[misc]
        if steps.ndim != 1:
            raise ValueError(f"the demonstrations of {name} must be flat steps [N], got {tuple(steps.shape)}")
        needed = (OBSERVATION, ACTION, EPISODE)
        check_keys(steps, needed, f"the demonstrations of {name}", f": they have {list(steps.keys())}")
        vector: NestedKey = OBSERVATION
        self._images: dict[str, tuple[int, int]] = {}
        if isinstance(steps[OBSERVATION], TensorDictBase):
            vector = (OBSERVATION, STATE)
            check_keys(steps, [vector], f"the demonstrations of {name}", ", the robot's state next to images")
            for key, image in steps[OBSERVATION].exclude(STATE).items():
                if image.dtype != torch.uint8 or image.ndim != 4 or image.shape[1] != 3 or not image.numel():
                    raise ValueError(
                        f"{key!r} of {name} has shape {tuple(image.shape)} of {image.dtype}, but images must "
                        "be uint8 [N, 3, h, w]"
                    )
                self._images[key] = image.shape[-2:]
        for key, shape in ((vector, "[N, d]"), (ACTION, "[N, d]"), (EPISODE, "[N]")):
            value = steps[key]
            found = f"{value.dtype} {tuple(value.shape)}" if isinstance(value, Tensor) else "text"
            if found == "text" or value.is_complex() or value.ndim != len(shape.split()):
                raise ValueError(f"{key!r} of {name} must be real numbers {shape}, got {found}")
        if steps[EPISODE].is_floating_point() or bool((steps[EPISODE] < 0).any()):
            raise ValueError(f"{EPISODE!r} of {name} must be whole numbers from 0 on, got {found}")
        self._values, self._vector = steps.select(*needed), vector
        others = map(str, steps.exclude(*needed, *_NO_OBSERVATIONS).keys())
        self._others = [name for name in others if name not in self._images]

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
            **self.image_entries(list(self._images), self._images),
            available_keys=(OBSERVATION, *self._images, *self._others),
            taken_by=dict.fromkeys(self._others, ""),
            action_dim=self._values[ACTION].shape[-1],
        )

    @override
    def check_targets(self, *_: Any, **__: Any) -> None:
        """Accept any observation: whoever made the steps chose it."""

    @override
    def steps(
        self, observations: Sequence[str] | None = None, images: Sequence[str] | None = None, **_: Any
    ) -> TensorDictBase:
        """Return the steps, with all images resized, or only those that are named."""
        index, values = self.index(), self._values.clone(False)
        for key in (self._vector, ACTION):
            exact = values[key] = values[key].detach()
            check_finite_steps(key, exact)
            if not all_usable(exact):
                raise ValueError(f"{key!r} of {self.title} has numbers above {LARGEST:g}: subtract an offset")
            exact = exact.cpu()
            if not self.normalised:
                check_kept(exact.double().numpy(), exact.float().numpy(), f"{key!r} of {self.title}")
        for key in index.image_keys if images is None else images:
            size, blocks = (index.image_size,) * 2, values[OBSERVATION, key].split(BLOCK)
            if self._images[key] != size:
                values[OBSERVATION, key] = torch.cat([resized(block, size, self.resize) for block in blocks])
        return values
