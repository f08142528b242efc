"""Options of ``python -m warmprior train``, in addition to those of sources, networks and trainings.

``train`` in ``warmprior/__main__.py`` passes each of them on.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from warmprior.options.data import Actions, Resizing
from warmprior.options.defaults import DEFAULT_NFE


@dataclass(frozen=True)
class Data(Resizing):
    """The options of the demonstrations, and of the task that is learnt from them.

    Attributes:
        observations: observations of the policy, in this order; by default the task's
        images: images of the policy, in addition to the robot's state, such as agentview_image
        demonstrations: number of demonstrations, from the first on; by default all
        mask: mask of the file, such as train, whose demonstrations to use; by default all
        joints: observation of the joint positions that absolute actions target; by default observation.state
            of a LeRobotDataset with the names of the actions, if the numbers are near; "" for none
        actions: actions of the policy: as recorded, or the absolute poses that robosuite's deltas target
        task: task of robosuite, for a LeRobotDataset that does not describe its environment
        style: style of the demonstrations, which decides robosuite's time limit; by default ph, and human
            outside robosuite
        horizon: time limit in control steps; by default the environment's own, or robosuite's for the style
        fast_rendering: render robosuite's images without reflections, shadows and smooth edges
    """

    observations: tuple[str, ...] | None = None
    images: tuple[str, ...] = ()
    demonstrations: int | None = None
    mask: str | None = None
    joints: str | None = None
    actions: Actions = "delta"
    task: str | None = None
    style: str | None = None
    horizon: int | None = None
    fast_rendering: bool = False


@dataclass(frozen=True)
class Evaluation:
    """The options of the evaluation.

    Attributes:
        nfe: network evaluations per chunk, saved with the policy; by default {DEFAULT_NFE},
            or 1 if times is start
        held_out: number of last demonstrations to leave out for measuring the error of actions; by default
            a tenth, or one of few, if no environment is known, else none
    """

    nfe: int | None = None
    held_out: int | None = None


Evaluation.__doc__ = str(Evaluation.__doc__).format(DEFAULT_NFE=DEFAULT_NFE)


@dataclass(frozen=True)
class Run:
    """The options of the computation, and of what it writes.

    Attributes:
        out: folder of training runs, in which an interrupted one continues
        device: device of the network, such as cuda
        compile: train with torch.compile, which needs a C++ compiler
    """

    out: Path = Path("policies")
    device: str = "cpu"
    compile: bool = False
