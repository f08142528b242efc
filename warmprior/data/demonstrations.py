"""What a place holds: demonstrations in any format, raw as recorded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, get_args

import numpy as np
from tensordict import TensorDictBase

from warmprior.checks import check_between, check_choice, check_whole_numbers, given
from warmprior.data.checks import DatasetError
from warmprior.data.image_cache import cached_images
from warmprior.data.index import DatasetIndex, DemonstrationReader
from warmprior.data.steps import Storage, StoredActions, read_steps
from warmprior.io.files import digest_of
from warmprior.keys import ACTION, EPISODE, OBSERVATION
from warmprior.modules.recording import AS_RECORDED, Recording, image_words
from warmprior.modules.trend import vector_of
from warmprior.options.data import IMAGE_SIZE, IMAGE_SIZES, Resize

ROWS = 2_000  # number of steps that decide if an observation is an action
LATER = 16  # number of steps, from the same one on, whose actions are compared


class Demonstrations:
    """The demonstrations at one place, raw as recorded: the base class of formats.

    :func:`open_demonstrations` makes one. Nothing is read before it is asked for.

    Args:
        place: the place, without the prefix of its format.

    Keyword Args:
        demos: number of demonstrations to take, from the first on; all by default.
        mask: a mask of the place, such as ``"train"``, which selects some demonstrations.
        style: style of the recording, such as ``"ph"`` or ``"human"``, which decides robosuite's time limit.
        task: the task of robosuite, or its ``env_args``, for a place that does not describe its environment.
        image_size: side in pixels to which images are resized; by default squares of one size stay as they
            are, and others are resized to 84.
        resize: how images are resized, see :func:`~warmprior.modules.resize.resized`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior.data import demonstrations_of
        >>> steps = {"observation": torch.rand(60, 3), "action": torch.rand(60, 1),
        ...          "episode": torch.arange(60) // 20}
        >>> demonstrations_of(TensorDict(steps, [60]), "pendulum")
        pendulum: data pendulum: 3 demonstrations, 60 steps; observations observation [3]; images none; ...
    """

    prefix: ClassVar[str]
    """What a place in this format begins with."""

    normalised: ClassVar[bool] = False
    """True if the numbers are in normalised units."""

    @classmethod
    def reads(cls, place: str) -> bool:
        """Return whether a place is in this format."""
        return place.startswith(cls.prefix)

    def __init__(
        self,
        place: str | Path,
        *,
        demos: int | None = None,
        mask: str | None = None,
        style: str | None = None,
        task: str | Mapping[str, Any] | None = None,
        image_size: int | None = None,
        resize: Resize = "squeeze",
    ) -> None:
        check_whole_numbers(**given(image_size=image_size))
        check_between(*IMAGE_SIZES, **given(image_size=image_size))
        check_choice("resize", resize, get_args(Resize))
        self.place, self.demos, self.mask, self.style, self.task = place, demos, mask, style, task
        self.image_size, self.resize = image_size, resize

    @property
    def title(self) -> str:
        """The short name of the place, such as ``"square"``."""
        return Path(self.place).resolve().name

    @property
    def name(self) -> str:
        """The name of the place in results, such as ``"square.hdf5"``."""
        name = f"{self.prefix}{self.title}" if self.prefix else Path(self.place).absolute().name
        return name if self.mask is None else f"{name} (mask {self.mask})"

    @property
    def facts(self) -> dict[str, Any]:
        """Facts about the place for results, as JSON."""
        return {"source": "file", "file": self.name}

    def __str__(self) -> str:
        return f"{self.prefix}{self.place}"

    def __repr__(self) -> str:
        try:
            index = self.index()
        except (OSError, ValueError, ImportError) as error:
            return f"{self}: {error}"
        parts = [" ".join(line) for line in self.recording(index).lines().items()]
        for kind, described in self.environment(index).items():
            parts.append(f"recorded in {kind}'s {described.get('env_name', described.get('id'))}")
        return f"{self}: {'; '.join(parts)}"

    def recording(self, index: DatasetIndex, actions: str | None = None) -> Recording:
        """Return what is read of the demonstrations, what is left out, and what ``actions`` are, in words."""
        shapes = dict(zip(index.image_keys, index.image_shapes, strict=True))
        return Recording(
            self.name,
            len(index.demos),
            sum(index.lengths),
            actions or f"[{index.action_dim}]{AS_RECORDED}",
            dict(zip(index.observation_keys, index.observation_dims, strict=True)),
            {key: image_words(shape, index.image_size, index.resize) for key, shape in shapes.items()},
            {key: index.images[key] for key in index.image_keys if key in index.images},
            index.left_out,
            index.rate,
            numbers=index.numbers,
        )

    def check(self) -> None:
        """Check that the place may hold demonstrations; nothing is read or downloaded.

        Raises FileNotFoundError if there is no such file or folder, and ImportError if the package that reads
        it is not installed.
        """
        raise NotImplementedError

    def resolved(self) -> str:
        """Return the place with an absolute path, so that it holds in any working directory."""
        return str(self) if self.prefix else str(Path(self.place).resolve())

    def index(
        self,
        observations: Sequence[str] | None = None,
        images: Sequence[str] = (),
        *,
        poses: bool = False,
    ) -> DatasetIndex:
        """Return the index, from names and shapes alone; with ``poses`` every arm's pose must be there."""
        raise NotImplementedError

    def image_entries(self, images: Sequence[str], shapes: Mapping[str, tuple[int, int]]) -> dict[str, Any]:
        """Return the entries of an index for images, given their heights and widths as they are stored."""
        found = tuple(shapes[key] for key in images)
        sides = {side for shape in found for side in shape}
        size = self.image_size or (IMAGE_SIZE if len(sides) > 1 else max(sides, default=0))
        return {
            "image_keys": tuple(images),
            "image_shapes": found,
            "image_size": size if images else 0,
            "resize": self.resize,
        }

    def reader(self, index: DatasetIndex) -> AbstractContextManager[DemonstrationReader]:
        """Return a reader of the values, which is open until the context ends."""
        raise NotImplementedError

    def contents(self, index: DatasetIndex) -> str:
        """Return the SHA-256 of what the place holds for an index."""
        raise NotImplementedError

    def environment(self, index: DatasetIndex) -> dict[str, Any]:
        """Return the recorded environment by its kind, ``"robosuite"`` or ``"gymnasium"``; {} if unknown."""
        return {"robosuite": index.env_args} if index.env_args else {}

    def origin(self, index: DatasetIndex) -> tuple[dict[str, Any] | None, np.ndarray | None]:
        """Return the rendering options of the images, and the first simulator state, if they are known."""
        return None, None

    def check_targets(
        self, index: DatasetIndex, steps: TensorDictBase, named: Any = None, *, option: str = "observations"
    ) -> None:
        """Check all observations but the named one: none may hold an action of the same or a later step.

        A number that equals one dimension of the action at every step, and changes, is refused. A state that
        reaches the last target equals an earlier action. The error tells the ``option`` that chooses.
        """
        keys, first = np.repeat(index.observation_keys, index.observation_dims).tolist(), steps[:ROWS]
        seen, action, episode = vector_of(first[OBSERVATION]), first[ACTION], first[EPISODE]
        found: dict[str, int] = {}
        for later in range(LATER):
            rows = episode[later:] == episode[: len(episode) - later]
            if 2 * int(rows.sum()) < len(episode):  # too few are left to compare
                break
            now, then = seen[: len(rows)][rows], action[later:][rows]
            for target in then.mT[(then != then[:1]).any(0)]:
                equal = (now == target.unsqueeze(-1)).all(0).tolist()
                for key in (key for key, same in zip(keys, equal, strict=True) if same and key != named):
                    found.setdefault(key, later)
        if found:
            others = [key for key in index.observation_keys if key not in found]
            held = " and ".join(
                f"{key!r} holds the action {f'of step t + {later}' if later else 'of the same step'}"
                for key, later in found.items()
            )
            raise DatasetError(
                f"{self}: the observation {held}, its own target: "
                f"name {option} without it ({', '.join(others) or 'none'}), or with it to keep it"
            )

    def digest(self, index: DatasetIndex) -> str:
        """Return the SHA-256 of the contents, and of the mask."""
        whole = self.contents(index)
        return whole if self.mask is None else digest_of(whole, self.mask)

    def steps(
        self,
        observations: Sequence[str] | None = None,
        images: Sequence[str] = (),
        *,
        actions: StoredActions = "delta",
        storage: Storage = "memory",
    ) -> TensorDictBase:
        """Read the demonstrations as one flat, contiguous TensorDict of ``N`` steps.

        - ``"observation"`` ``[N, d_o]`` float32, the concatenated observations; with images it is nested:
          ``("observation", "state")`` ``[N, d_s]``, and each image uint8 ``[N, 3, size, size]``,
          resized as the demonstrations' options say;
        - ``"action"`` ``[N, d_a]`` float32, as recorded (not normalised);
        - ``("next", "reward")`` ``[N, 1]`` float32, zeros if none is recorded;
        - ``("next", "done")``, ``("next", "terminated")``, ``("next", "truncated")`` ``[N, 1]`` bool: done
          on the last step of each demo; terminated there as recorded, or if its reward is that of a solved
          task (robosuite's ``reward_scale``, 1 by default), else truncated;
        - ``"episode"`` ``[N]`` int64, counted from 0, and ``"frame"`` ``[N]`` int64, the row number.

        Names, shapes and masks are checked before values are read.

        Args:
            observations: observations to concatenate; by default those of the task, or those that the format
                chooses (:doc:`/data`).
            images: images to read as well, such as ``"agentview_image"``; they stay bytes.

        Keyword Args:
            actions: pose deltas as recorded; or ``"absolute"``, the poses that they target, of 10 numbers per
                arm (see :func:`warmprior.envs.absolute_actions`); or ``"stored"``, the numbers of the file
                also where these are poses that it declares as deltas (``low_dim_abs.hdf5``).
            storage: where images are: in ``"memory"``, or as a ``"memmap"`` of the cache, in which the next
                reader finds them (see :func:`~warmprior.data.image_cache.cached_images`).

        Raises:
            FileNotFoundError: if there is no such place.
            DatasetError: if it is invalid; the message names the file, demo and key.
            ValueError: if ``storage`` is unknown, or actions of a controller without pose deltas are to be
                absolute.
            OSError: if a download fails, or there is no space for images in the cache.
        """
        index = self.index(observations, images, poses=actions == "absolute")
        least, largest = IMAGE_SIZES
        if index.image_keys and not least <= index.image_size <= largest:
            raise DatasetError(
                f"{self}: {index.image_keys[0]} has {index.image_size} pixels a side, and policies see "
                f"{least} to {largest}: choose image_size, such as {IMAGE_SIZE}"
            )
        contents = partial(self.contents, index)
        digest = contents() if storage == "memmap" and index.image_keys else ""
        options: Any = {"actions": actions, "storage": storage}
        with self.reader(index) as reader:
            cached = partial(cached_images, index, reader, digest=digest, contents=contents)
            return read_steps(index, reader, cached, **options)
