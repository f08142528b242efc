"""MimicGen's tasks under robosuite 1.5, although their package is written for 1.4."""

from __future__ import annotations

import io
import re
import sys
from contextlib import redirect_stdout
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

_TASKS = ("stack", "coffee", "threading")
_INSTALL = "git clone https://github.com/NVlabs/mimicgen ~/mimicgen && pip install --no-deps -e ~/mimicgen"
_SINGLE_ARM = "robosuite.environments.manipulation.single_arm_env"


def is_mimicgen(env_name: str) -> bool:
    """Return True if a name is that of a MimicGen environment, which ends in a variant: ``Stack_D0``."""
    return re.search(r"_[DO]\d$", env_name) is not None


def find_mimicgen() -> Path:
    """Return the folder of NVlabs' package, without running its code; raise ImportError without one."""
    spec = find_spec("mimicgen")
    folders = [Path(folder) for folder in (spec and spec.submodule_search_locations) or ()]
    for folder in folders:
        if all((folder / "envs" / "robosuite" / f"{task}.py").is_file() for task in _TASKS):
            return folder
    # A folder with this name but no package in it, such as a clone in the working directory, is not enough.
    if spec is None or spec.origin is None:
        raise ImportError(f"MimicGen's tasks need NVlabs' package, not the package index's; run: {_INSTALL}")
    where = ", ".join(map(str, folders)) or spec.origin
    raise ImportError(
        f"the package mimicgen in {where} is not NVlabs': it has no envs/robosuite/{{{','.join(_TASKS)}}}.py "
        f"and was not imported; pip uninstall mimicgen, then run: {_INSTALL}"
    )


def register_mimicgen() -> None:
    """Register MimicGen's tasks for ``robosuite.make``. A second call changes nothing.

    The package must be that of https://github.com/NVlabs/mimicgen, which is not on the package index; the
    package of that name there is another project, and is rejected without being imported.

    Raises:
        ImportError: if the package is missing, another one, or cannot be imported.

    Examples:
        >>> from warmprior.envs.mimicgen import register_mimicgen
        >>> register_mimicgen()  # doctest: +SKIP
        >>> import robosuite  # doctest: +SKIP
        >>> robosuite.make("Coffee_D0", "Panda")  # doctest: +SKIP
    """
    folder = find_mimicgen()
    _restore_robosuite_14()
    try:
        # The import prints the packages that other tasks need.
        with redirect_stdout(io.StringIO()):
            for task in _TASKS:
                import_module(f"mimicgen.envs.robosuite.{task}")
    except ImportError as error:
        raise ImportError(f"MimicGen's tasks in {folder} cannot be imported: {error}") from error


def _restore_robosuite_14() -> None:
    """Add the parts of robosuite 1.4 that MimicGen uses, and robosuite's own tasks do not."""
    if _SINGLE_ARM in sys.modules:
        return
    from robosuite.environments.manipulation.manipulation_env import ManipulationEnv
    from robosuite.robots.robot import Robot

    class SingleArmEnv(ManipulationEnv):
        def __init__(self, *args: Any, mount_types: Any = "default", **kwargs: Any) -> None:
            kwargs.setdefault("base_types", mount_types)
            # The physics step of robosuite 1.4, with which MimicGen's data were recorded.
            super().__init__(*args, **kwargs | {"lite_physics": False})

    module = ModuleType(_SINGLE_ARM)
    vars(module)["SingleArmEnv"] = SingleArmEnv
    sys.modules[_SINGLE_ARM] = module
    Robot.controller = property(
        lambda robot: SimpleNamespace(eef_name=robot.composite_controller.part_controllers["right"].ref_name)
    )
