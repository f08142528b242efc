"""Options of ``--policy.type=warm_smolvla`` and ``--policy.type=warm_pi05``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.pi05.configuration_pi05 import PI05Config
from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig

from warmprior import Prior
from warmprior.lerobot import history_indices
from warmprior.modules.option_text import build
from warmprior.modules.registry import registered

OWN_PRIORS = (
    "LeRobot imports your own by --policy.discover_packages_path=PACKAGE, and beside --policy.path by "
    "--env.discover_packages_path=PACKAGE"
)
"""How a prior gets its name: the option is read from files too, and imports nothing."""


@dataclass
class WarmConfigMixin:
    """Options of the source, beside those of the policy.

    Attributes:
        prior: its name, with options, such as ``past``, ``preview`` or ``past,sigma=0.3``.
        prior_chunk: ``H``, the actions that it remembers; by default as many as the chunk allows.
        sigma_unit: what sigma is in units of: ``model`` (normalised actions) or ``std`` (deviations of data).
        action_std: taken from the dataset for ``std``, and kept with the policy.
        cold_probability: share of the training windows whose history is withheld.
    """

    prior: str = "past"
    prior_chunk: int | None = None
    sigma_unit: str = "model"
    action_std: list[float] | None = None
    cold_probability: float = 0.0

    def make_prior(self) -> Prior:
        """The source distribution; a ``ValueError`` if there is none of that name and these options."""
        kind = registered(Prior, self.prior.partition(",")[0], OWN_PRIORS)
        chunk = super().action_delta_indices  # type: ignore[misc]  # LeRobot's configuration has it
        room = len(chunk) // kind.prediction_chunks
        return build(kind, self.prior, room if self.prior_chunk is None else self.prior_chunk)

    def meaning(self, *, training: bool) -> dict[str, Any]:
        """Options without which saved weights mean something else; a training may change the source."""
        if training:
            return {}
        unit = {"sigma_unit": self.sigma_unit, "action_std": self.action_std}
        return {"prior": self.make_prior().config(), **unit}

    @property
    def action_delta_indices(self) -> list[int]:
        """Steps that LeRobot loads of every action: the history, and the chunk."""
        chunk = super().action_delta_indices  # type: ignore[misc]
        return history_indices(self.make_prior().history_length, len(chunk))


@PreTrainedConfig.register_subclass("warm_smolvla")
@dataclass
class WarmSmolVLAConfig(WarmConfigMixin, SmolVLAConfig):
    """SmolVLA's options and those of the source."""


@PreTrainedConfig.register_subclass("warm_pi05")
@dataclass
class WarmPI05Config(WarmConfigMixin, PI05Config):
    """PI05's options and those of the source."""
