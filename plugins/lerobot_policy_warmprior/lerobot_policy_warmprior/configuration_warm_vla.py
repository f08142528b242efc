"""Options of ``--policy.type=warm_smolvla`` and ``--policy.type=warm_pi05``."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.pi05.configuration_pi05 import PI05Config
from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig

from warmprior import Prior
from warmprior.lerobot import history_indices
from warmprior.modules.option_text import find, make


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
        kind = find(Prior, self.prior.partition(",")[0])
        room = len(super().action_delta_indices) // kind.prediction_chunks
        return make(Prior, self.prior, room if self.prior_chunk is None else self.prior_chunk)

    @property
    def action_delta_indices(self) -> list[int]:
        """Steps that LeRobot loads of every action: the history, and the chunk."""
        chunk = super().action_delta_indices
        return history_indices(self.make_prior().history_length, len(chunk))


@PreTrainedConfig.register_subclass("warm_smolvla")
@dataclass
class WarmSmolVLAConfig(WarmConfigMixin, SmolVLAConfig):
    """SmolVLA's options and those of the source."""


@PreTrainedConfig.register_subclass("warm_pi05")
@dataclass
class WarmPI05Config(WarmConfigMixin, PI05Config):
    """PI05's options and those of the source."""
