"""Options of ``--policy.type=warm_smolvla`` and ``--policy.type=warm_pi05``."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, fields
from typing import Any

from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.pi05.configuration_pi05 import PI05Config
from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig

from warmprior import Prior
from warmprior.lerobot import history_indices
from warmprior.modules.registry import registered
from warmprior.options.source import DEFAULT_PRIOR
from warmprior.training.option_text import build

OWN_PRIORS = (
    "LeRobot imports your own by --policy.discover_packages_path=PACKAGE, and with --policy.path by "
    "--env.discover_packages_path=PACKAGE"
)
"""Hint for unknown priors: names may come from files, so they never import anything."""


def check_given(options: Any, config: Any) -> None:
    """Raise ValueError for options of a dataclass without a value, where JSON held null in its place."""
    for option in fields(options):
        default = option.default if option.default_factory is MISSING else option.default_factory()
        if getattr(config, option.name) is None and default not in (None, MISSING):
            raise ValueError(f"--policy.{option.name} needs a value, such as {default!r}")


@dataclass
class WarmConfigMixin:
    """Options of the source, in addition to those of the policy.

    Attributes:
        prior: name of the prior with its options, such as ``past``, ``preview`` or ``past,sigma=0.3``.
        prior_chunk: ``H``, actions that the prior remembers; by default as many as the chunk allows.
        sigma_unit: unit of sigma: ``model`` (normalised actions) or ``std`` (standard deviations of the
            data).
        action_std: standard deviations of actions for ``std``; taken from the dataset, and saved.
        cold_probability: share of the training windows whose history is withheld.
    """

    prior: str = DEFAULT_PRIOR
    prior_chunk: int | None = None
    sigma_unit: str = "model"
    action_std: list[float] | None = None
    cold_probability: float = 0.0

    def make_prior(self) -> Prior:
        """Make the source; a ``ValueError`` if the name or an option is unknown, or an option is null."""
        check_given(WarmConfigMixin, self)  # LeRobot asks for the steps to load before it validates
        kind = registered(Prior, self.prior.partition(",")[0], OWN_PRIORS)
        chunk = super().action_delta_indices  # type: ignore[misc]  # LeRobot's configuration has it
        room = len(chunk) // kind.prediction_chunks
        return build(kind, self.prior, room if self.prior_chunk is None else self.prior_chunk)

    def meaning(self, *, training: bool) -> dict[str, Any]:
        """Return the options that saved weights depend on; a training run may change the source."""
        if training:
            return {}
        unit = {"sigma_unit": self.sigma_unit, "action_std": self.action_std}
        return {"prior": self.make_prior().config(), **unit}

    @property
    def action_delta_indices(self) -> list[int]:
        """Return the steps of every action that LeRobot loads: the history, and the chunk."""
        chunk = super().action_delta_indices  # type: ignore[misc]
        return history_indices(self.make_prior().history_length, len(chunk))


@PreTrainedConfig.register_subclass("warm_smolvla")
@dataclass
class WarmSmolVLAConfig(WarmConfigMixin, SmolVLAConfig):
    """SmolVLA's options, and those of the source."""


@PreTrainedConfig.register_subclass("warm_pi05")
@dataclass
class WarmPI05Config(WarmConfigMixin, PI05Config):
    """PI05's options, and those of the source."""
