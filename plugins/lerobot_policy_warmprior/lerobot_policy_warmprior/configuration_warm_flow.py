"""Options of ``--policy.type=warm_flow``."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any, get_args

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, NormalizationMode
from lerobot.optim.optimizers import AdamWConfig
from lerobot.optim.schedulers import LRSchedulerConfig
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from lerobot_policy_warmprior.configuration_warm_vla import OWN_PRIORS, check_given
from warmprior import Prior
from warmprior.checks import check_between, check_choice
from warmprior.lerobot import history_indices
from warmprior.modules.recording import Recording
from warmprior.modules.registry import registered
from warmprior.options.data import IMAGE_SIZE, Resize
from warmprior.options.defaults import DEFAULT_NFE
from warmprior.options.source import DEFAULT_PRIOR, PRIOR_OF_TARGETS
from warmprior.options.training import Encoder
from warmprior.training import warmup_cosine
from warmprior.training.option_text import build


@LRSchedulerConfig.register_subclass("warmup_ratio")
@dataclass
class WarmupRatioConfig(LRSchedulerConfig):
    """The paper's schedule: a linear warm-up over a share of the training, then a cosine to zero."""

    num_warmup_steps: int | None = None
    warmup_ratio: float = 0.2

    def build(self, optimizer: Optimizer, num_training_steps: int) -> LambdaLR:
        """Make the schedule of a training run with that many steps."""
        return warmup_cosine(optimizer, num_training_steps, self.warmup_ratio)


@PreTrainedConfig.register_subclass("warm_flow")
@dataclass
class WarmFlowConfig(PreTrainedConfig):
    """Options of the paper's policy for states and images: a ChiTransformer with the source of a prior.

    The recipe is the paper's (Table 3), except for preconditioning, which `precondition=false` turns off.

    Attributes:
        n_obs_steps: ``To``, observations per decision.
        n_action_steps: actions executed per decision, at most ``H``.
        prior_chunk: ``H``, actions that the prior remembers; by default ``n_action_steps``.
        prior: name of the prior with its options, such as ``past``, ``preview`` or ``past,sigma=0.3``; by
            default ``past,correlation=0.5``, or ``gaussian`` if the preconditioning recognises absolute
            targets. Training writes what it chose.
        cold_probability: share of the training windows whose history is withheld.
        nfe: network evaluations per chunk; 1 is one-step inference.
        precondition: precondition the network by the moments of source and data, see PreconditionedNetwork.
        joints: the observation whose numbers absolute actions set, such as ``observation.state``; empty if
            there is none. By default ``auto``: ``observation.state`` if the dataset gives it the names of the
            actions, and the numbers are near. Training replaces ``auto`` by what it found.
        ema_rate: decay of the averaged weights, which are used at decisions.
        network: configuration of another velocity network, as JSON (``VelocityNetwork.config()``).
        hidden_dim: width of the transformer.
        num_layers: number of layers of the transformer.
        num_heads: number of attention heads of the transformer.
        dropout: dropout of the transformer.
        encoder: image encoder, one per camera: ``resnet18-imagenet`` starts from ImageNet's weights, which
            torchvision downloads once; ``resnet18`` and ``small`` start from random ones.
        image_size: side in pixels to which images are resized.
        resize: how images become square: `squeeze`, or `pad` with black.
        crop_size: side in pixels of the crop, which is random in training and central at decisions; by
            default 76 of 84, in proportion.
        recording: what the policy was trained on, as JSON (:class:`~warmprior.modules.recording.Recording`);
            training writes it, and the executor takes the names and the rate from it.
    """

    n_obs_steps: int = 2
    n_action_steps: int = 8
    prior_chunk: int | None = None
    prior: str | None = None
    cold_probability: float = 0.0
    nfe: int = DEFAULT_NFE
    precondition: bool = True
    joints: str = "auto"
    ema_rate: float = 0.995
    network: str = ""
    hidden_dim: int = 384
    num_layers: int = 8
    num_heads: int = 6
    dropout: float = 0.1
    encoder: str = "resnet18-imagenet"
    image_size: int = IMAGE_SIZE
    resize: str = "squeeze"
    crop_size: int | None = None
    recording: str = ""
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "STATE": NormalizationMode.MIN_MAX,
            "ENV": NormalizationMode.MIN_MAX,
            "VISUAL": NormalizationMode.IDENTITY,  # the encoder has ImageNet's statistics
            "ACTION": NormalizationMode.MIN_MAX,
        }
    )
    optimizer_lr: float = 1e-4
    optimizer_betas: tuple[float, float] = (0.9, 0.999)
    optimizer_weight_decay: float = 1e-5
    scheduler_warmup_ratio: float = 0.2

    def __post_init__(self) -> None:
        super().__post_init__()
        # LeRobot fills in all features of a dataset later, but only where there are none yet.
        self.names_observations = bool(self.input_features)
        if self.prior_chunk is None:  # saved as well, so that fewer actions can be executed later
            self.prior_chunk = self.n_action_steps

    @property
    def source(self) -> str:
        """Return the name of the prior with its options, given what is known of the actions so far."""
        # LeRobot asks which steps to load before it shows the data: both defaults need the same ones.
        return self.prior or (DEFAULT_PRIOR if self.joints in ("", "auto") else PRIOR_OF_TARGETS)

    def make_prior(self) -> Prior:
        """Make the source; a ``ValueError`` if the name or an option is unknown."""
        kind = registered(Prior, self.source.partition(",")[0], OWN_PRIORS)
        return build(kind, self.source, self.prior_chunk)

    def make_recording(self) -> Recording | None:
        """Return what the policy was trained on; ``None`` if it is unknown."""
        return Recording(**json.loads(self.recording)) if self.recording else None

    def meaning(self, *, training: bool) -> dict[str, Any]:
        """Return the options that saved weights depend on; a training run may change the source."""
        names = ["n_obs_steps", "precondition", "joints", "network", "hidden_dim", "num_layers"]
        names += ["num_heads", "image_size", "resize", "crop_size", "normalization_mapping"]
        return {
            **{name: getattr(self, name) for name in names},
            "input_features": [*self.observed, *self.image_features],
            "encoder": self.encoder.partition("-")[0],
            "prior": None if training else self.make_prior().config(),
        }

    @property
    def observed(self) -> list[str]:
        """Return the observation's entries in the network's order: objects, then the robot."""
        features = self.input_features.items()
        kinds = (FeatureType.ENV, FeatureType.STATE)
        return [name for kind in kinds for name, entry in features if entry.type is kind]

    def joint_columns(self, key: str) -> list[int]:
        """Return for each action the column of the observation, within ``key``, that it sets, or -1."""
        check_choice("--policy.joints", key, self.observed)
        widths = [self.input_features[name].shape[0] for name in self.observed]
        first, width = sum(widths[: self.observed.index(key)]), widths[self.observed.index(key)]
        return [first + i if i < width else -1 for i in range(self.action_feature.shape[0])]

    def validate_features(self) -> None:
        """Raise ValueError for a dataset that the policy cannot learn from."""
        check_given(type(self), self)
        check_choice("--policy.encoder", self.encoder, get_args(Encoder))
        check_choice("--policy.resize", self.resize, get_args(Resize))
        mode = self.normalization_mapping.get("VISUAL", NormalizationMode.IDENTITY)
        if self.image_features and mode != NormalizationMode.IDENTITY:
            raise ValueError(
                f"warm_flow scales pixels by itself: set its VISUAL normalisation to IDENTITY, not "
                f"{mode.value}"
            )
        for name, feature in self.image_features.items():
            if feature.shape[0] != 3:
                raise ValueError(
                    f"warm_flow sees images [3, h, w], and {name} is {list(feature.shape)}: leave it out of "
                    "--policy.input_features"
                )
        if not self.observed:
            raise ValueError("warm_flow needs observation.state or observation.environment_state: add one")
        if self.action_feature is None:
            raise ValueError("warm_flow needs the feature 'action': add it to the dataset")
        if self.joints not in ("", "auto"):
            self.joint_columns(self.joints)
            if not self.precondition:
                raise ValueError("--policy.joints needs --policy.precondition=true")
        check_between(1, self.make_prior().chunk_length, n_action_steps=self.n_action_steps)

    def get_optimizer_preset(self) -> AdamWConfig:
        """Return the paper's AdamW."""
        return AdamWConfig(
            lr=self.optimizer_lr,
            betas=self.optimizer_betas,
            weight_decay=self.optimizer_weight_decay,
            grad_clip_norm=0.0,
        )

    def get_scheduler_preset(self) -> WarmupRatioConfig:
        """Return the paper's warm-up and cosine."""
        return WarmupRatioConfig(warmup_ratio=self.scheduler_warmup_ratio)

    @property
    def observation_delta_indices(self) -> list[int]:
        """Return the steps of every observation that LeRobot loads."""
        return list(range(1 - self.n_obs_steps, 1))

    @property
    def action_delta_indices(self) -> list[int]:
        """Return the steps of every action that LeRobot loads: the history, and the chunk."""
        prior = self.make_prior()
        return history_indices(prior.history_length, prior.prediction_length)

    @property
    def reward_delta_indices(self) -> None:
        """Return None, because no rewards are loaded."""
        return None
