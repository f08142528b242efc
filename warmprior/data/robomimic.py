"""robomimic's and MimicGen's demonstrations, as a TorchRL replay buffer."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

from warmprior.data.hdf5 import RobomimicReader, open_robomimic, read_index
from warmprior.data.replay import DemonstrationReplay, Opened


class RobomimicDemonstrations(DemonstrationReplay):
    """The demonstrations of a robomimic or MimicGen HDF5 file, as one immutable TorchRL replay buffer.

    The whole selection becomes a flat, contiguous :class:`~tensordict.TensorDict` of ``N`` steps, in
    the order of the demos' numbers:

    - ``"observation"`` ``[N, d_o]`` float32, the concatenated observation keys; with images it is nested:
      ``("observation", "state")`` ``[N, d_s]``, and each image uint8 ``[N, 3, size, size]``;
    - ``"action"`` ``[N, d_a]`` float32, as recorded (not normalised);
    - ``("next", "reward")`` ``[N, 1]`` float32, zeros if none is recorded;
    - ``("next", "done")``, ``("next", "terminated")``, ``("next", "truncated")`` ``[N, 1]`` bool: done
      on the last step of each demo; terminated there if its reward is that of a solved task (robosuite's
      ``reward_scale``, 1 by default), else truncated;
    - ``"episode"`` ``[N]`` int64, counted from 0, and ``"frame"`` ``[N]`` int64, the row number.

    Names, shapes and masks are checked before values are read.

    Args:
        place: an HDF5 file.
        filter_key: a mask of the file, such as ``"train"``; all demos if ``None``.
        demos: number of demos to take, the first ones by their numbers; all if ``None``.
        observation_keys: observations to concatenate; by default those of the task, or for an
            unknown environment the object, every robot's pose and gripper, and all other vectors but
            those of a robot with such a pose or gripper (``robot0_...``).
        image_keys: images to read as well, such as ``"agentview_image"``. They stay bytes; use
            ``storage="memmap"`` for many images.
        absolute_actions: True turns the recorded pose deltas into absolute poses
            (see :func:`warmprior.envs.absolute_actions`); ``d_a`` becomes 10 per arm. Recorded poses that
            the file declares as deltas (``low_dim_abs.hdf5``) are not changed.
        as_recorded: True reads such poses without ``absolute_actions`` too, as stored in the file.
        storage: ``"memory"``, or ``"memmap"`` for temporary files on a disk.
        scratch_dir: a folder for these files; by default the system's (``TMPDIR``).
        **kwargs: TorchRL's ``batch_size``, ``sampler``, ``transform``, ``prefetch``, ``pin_memory`` and
            ``generator``.

    Raises:
        FileNotFoundError: if there is no such file.
        DatasetError: if the file is invalid; the message names the demo and key.
        ValueError: if ``storage`` is unknown, or ``absolute_actions`` is True for a controller without pose
            deltas.
        OSError: if there is no space for memory maps.

    Examples:
        >>> from warmprior.data import RobomimicDemonstrations
        >>> data = RobomimicDemonstrations("square.hdf5", batch_size=256)  # doctest: +SKIP
        >>> data.sample()["observation"].shape  # doctest: +SKIP
        torch.Size([256, 23])
        >>> RobomimicDemonstrations("nowhere.hdf5")
        Traceback (most recent call last):
            ...
        FileNotFoundError: nowhere.hdf5: no such file; check the path
    """

    def _opened(self, stack: ExitStack, place: Any, **chosen: Any) -> Opened:
        index = read_index(place, **chosen)
        return index, RobomimicReader(stack.enter_context(open_robomimic(place)))
