"""WarmPrior: temporally grounded source distributions for flow-matching policies, in TorchRL.

The public names of :mod:`warmprior.modules`, :mod:`warmprior.transforms`,
:mod:`warmprior.objectives` and :mod:`warmprior.rl` are available here. :mod:`warmprior.data`,
:mod:`warmprior.envs`, :mod:`warmprior.training` and :mod:`warmprior.diagnostics` are imported by
name; parts of them need the extra ``warmprior[sim]``.
"""

from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from warmprior.io.renderer import leave_out_broken_renderer

if TYPE_CHECKING:
    from warmprior.modules import *  # noqa: F403
    from warmprior.objectives import *  # noqa: F403
    from warmprior.rl import *  # noqa: F403
    from warmprior.transforms import *  # noqa: F403

leave_out_broken_renderer()  # before TorchRL is imported

__version__ = version("warmprior")


def __getattr__(name: str) -> Any:
    """Return a room, or import the public names when the first is used: PyTorch and TorchRL take seconds."""
    if name.startswith("__") and name != "__all__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if find_spec(f"{__name__}.{name}"):
        return import_module(f"{__name__}.{name}")
    public = {"__version__": __version__}
    for room in ("modules", "objectives", "rl", "transforms"):
        module = import_module(f"{__name__}.{room}")
        public |= {each: getattr(module, each) for each in module.__all__}
    globals().update(public, __all__=[*public])
    if name not in globals():
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return globals()[name]


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted({*globals(), *__getattr__("__all__")})
