"""WarmPrior: temporally grounded source distributions for flow-matching policies, in TorchRL.

The public names of :mod:`warmprior.modules`, :mod:`warmprior.transforms`,
:mod:`warmprior.objectives` and :mod:`warmprior.rl` are available here. :mod:`warmprior.data`,
:mod:`warmprior.envs`, :mod:`warmprior.training` and :mod:`warmprior.diagnostics` are imported by
name; parts of them need the extra ``warmprior[sim]``.
"""

from importlib.metadata import version

from warmprior.io.renderer import leave_out_broken_renderer

leave_out_broken_renderer()  # before TorchRL is imported

# isort: split
from warmprior import modules, objectives, rl, transforms  # noqa: E402
from warmprior.modules import *  # noqa: F403, E402
from warmprior.objectives import *  # noqa: F403, E402
from warmprior.rl import *  # noqa: F403, E402
from warmprior.transforms import *  # noqa: F403, E402

__version__ = version("warmprior")

# A public name is declared once, where it lives.
__all__ = ["__version__"]
__all__ += modules.__all__
__all__ += objectives.__all__
__all__ += rl.__all__
__all__ += transforms.__all__
