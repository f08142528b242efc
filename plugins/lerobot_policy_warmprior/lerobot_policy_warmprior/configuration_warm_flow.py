"""Options of ``--policy.type=warm_flow``."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, NormalizationMode
from lerobot.optim.optimizers import AdamWConfig
from lerobot.optim.schedulers import DiffuserSchedulerConfig

from warmprior import Prior
from warmprior.lerobot import history_indices
from warmprior.modules.registry import make

__all__ = ["WarmFlowConfig"]


@PreTrainedConfig.register_subclass("warm_flow")
@dataclass
class WarmFlowConfig(PreTrainedConfig):
    """The paper's policy from state: a ChiTransformer that carries the prior's source to a chunk.

    Attributes:
        n_obs_steps: ``To``, observations per decision.
        n_action_steps: ``H``, actions executed per decision, and remembered by the prior.
        prior: its name, with options, such as ``past``, ``preview`` or ``past,sigma=0.3``.
        cold_probability: share of the training windows whose history is withheld.
        nfe: network evaluations per chunk.
        network: configuration of another velocity network, as JSON (``VelocityNetwork.config()``).
        embedding_dim: width of the transformer.
        num_layers: its depth.
        num_heads: its attention heads.
        dropout: of its layers.
    """

    n_obs_steps: int = 2
    n_action_steps: int = 8
    prior: str = "past"
    cold_probability: float = 0.0
    nfe: int = 9
    network: str = ""
    embedding_dim: int = 384
    num_layers: int = 8
    num_heads: int = 6
    dropout: float = 0.1
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "STATE": NormalizationMode.MIN_MAX,
            "ENV": NormalizationMode.MIN_MAX,
            "ACTION": NormalizationMode.MIN_MAX,
        }
    )
    optimizer_lr: float = 1e-4
    optimizer_betas: tuple[float, float] = (0.9, 0.95)
    optimizer_weight_decay: float = 1e-3
    scheduler_name: str = "cosine"
    scheduler_warmup_steps: int = 1_000

    def make_prior(self) -> Prior:
        """The source distribution.

        Raises:
            ValueError: if there is none of that name and these options.
        """
        return make(Prior, self.prior, self.n_action_steps)

    @property
    def observed(self) -> list[str]:
        """The observation's entries, in the order in which the network sees them: objects, then the robot."""
        features = self.input_features.items()
        kinds = (FeatureType.ENV, FeatureType.STATE)
        return [name for kind in kinds for name, entry in features if entry.type is kind]

    def validate_features(self) -> None:
        """Refuse datasets that the policy cannot learn from.

        Raises:
            ValueError: if there is no state, or there are images.
        """
        images = [n for n, e in self.input_features.items() if e.type is FeatureType.VISUAL]
        if images:
            raise ValueError(
                f"warm_flow sees no images, and the dataset has {', '.join(images)}: take warm_smolvla or "
                "warm_pi05, or name --policy.input_features without them"
            )
        if not self.observed:
            raise ValueError("warm_flow needs observation.state or observation.environment_state")
        if self.action_feature is None:
            raise ValueError("warm_flow needs the feature 'action'")

    def get_optimizer_preset(self) -> AdamWConfig:
        """The paper's AdamW."""
        return AdamWConfig(
            lr=self.optimizer_lr,
            betas=self.optimizer_betas,
            weight_decay=self.optimizer_weight_decay,
        )

    def get_scheduler_preset(self) -> DiffuserSchedulerConfig:
        """The paper's warm-up and cosine."""
        return DiffuserSchedulerConfig(name=self.scheduler_name, num_warmup_steps=self.scheduler_warmup_steps)

    @property
    def observation_delta_indices(self) -> list[int]:
        """Steps that LeRobot loads of every observation."""
        return list(range(1 - self.n_obs_steps, 1))

    @property
    def action_delta_indices(self) -> list[int]:
        """Steps that LeRobot loads of every action: the history, and the chunk."""
        prior = self.make_prior()
        return history_indices(prior.history_length, prior.prediction_length)

    @property
    def reward_delta_indices(self) -> None:
        """None are loaded."""
        return None
