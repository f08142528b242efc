"""``--policy.type=warm_flow``: this library's policy for LeRobot."""

from __future__ import annotations

import gc
import json
import logging
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, Literal, cast

import torch
from lerobot.configs.types import FeatureType, NormalizationMode
from lerobot.datasets import LeRobotDataset, StreamingLeRobotDataset
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.policies.utils import populate_queues
from lerobot.processor import NormalizerProcessorStep, TransitionKey
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from lerobot_policy_warmprior.check_observed import check_observed
from lerobot_policy_warmprior.configuration_warm_flow import WarmFlowConfig
from lerobot_policy_warmprior.loading import WholePolicy, check_known, check_statistics
from lerobot_policy_warmprior.used import check_used, recording_of
from warmprior import (
    ChiTransformer,
    FlowMatchingLoss,
    ImageEncoder,
    Normalizer,
    PreconditionedNetwork,
    Prior,
    RestingJoints,
    RestingTrend,
    VelocityNetwork,
    VisionNetwork,
    WarmPriorActor,
    WithheldHistory,
    keys,
)
from warmprior.checks import check_choice, check_keys
from warmprior.data import open_demonstrations
from warmprior.history import window_history
from warmprior.lerobot.adapter import with_width
from warmprior.lerobot.memory import ActionMemory
from warmprior.lerobot.names import named_joints
from warmprior.modules import load_imagenet
from warmprior.modules.registry import from_config
from warmprior.modules.resize import resized
from warmprior.training import ema_of, precondition


def training_episodes(meta: Any) -> list[int] | None:
    """Return the numbers of the episodes that training reads; ``None`` for all.

    LeRobot gives a policy only the metadata of all episodes, so the dataset that holds them is searched.
    """
    kinds = LeRobotDataset, StreamingLeRobotDataset
    datasets = (o for o in gc.get_objects() if issubclass(type(o), kinds))
    dataset = next((o for o in datasets if o.meta is meta), None)
    return None if dataset is None else dataset.episodes


class WarmFlowActor(WarmPriorActor):
    """The actor of :class:`WarmFlowPolicy`; ``execute`` is the number of actions per decision."""

    def __init__(self, network: nn.Module, prior: Prior, *, execute: int, **options: Any) -> None:
        super().__init__(network, prior, **options)
        self.execute = execute


class WarmFlowPolicy(WholePolicy, PreTrainedPolicy):
    """Flow matching from a prior: :class:`~warmprior.WarmPriorActor` and its loss as a policy of LeRobot.

    In training, preconditioning is fitted to the training episodes of the dataset of ``dataset_meta``, even
    if the training continues from a saved policy.

    Raises:
        ValueError: if the network does not fit the dataset, the dataset has no statistics, the prior is
            learned, which LeRobot would not train, or an observation that ``--policy.input_features`` does
            not name holds the action of the same or a later step.
    """

    config_class = WarmFlowConfig
    name = "warm_flow"
    has_all_weights = True
    config: WarmFlowConfig
    _memory: ActionMemory
    _fitted: dict[str, Tensor]
    _queues: dict[str, deque[Tensor]]

    def __init__(
        self, config: WarmFlowConfig, *, dataset_meta: Any = None, dataset_stats: Any = None
    ) -> None:
        super().__init__(config)
        config.validate_features()
        steps = None
        if dataset_meta is not None:
            check_statistics(config, dataset_meta)
            check_used(config)
            steps = self._training_steps(dataset_meta)
        prior = config.make_prior()
        if isinstance(prior, nn.Module):
            raise ValueError(
                f"prior={config.prior!r} is learned, and lerobot-train trains no prior: choose past, preview "
                "or gaussian"
            )
        features = {**config.input_features, **config.output_features}
        self._widths = {name: features[name].shape[0] for name in (*config.observed, keys.ACTION)}
        width = sum(self._widths[name] for name in config.observed)
        self._cameras, encoder = list(config.image_features), None
        if self._cameras:
            backbone, _, pretrained = config.encoder.partition("-")
            encoder = ImageEncoder(
                self._cameras,
                width,
                backbone=cast(Any, backbone),  # checked by the configuration
                image_size=config.image_size,
                crop_size=config.crop_size,
                resize=cast(Any, config.resize),
            )
            # A saved policy's weights are in its file.
            if pretrained and dataset_meta is not None and not config.pretrained_path:
                load_imagenet(encoder)
            width = encoder.observation_dim
        sizes = (config.action_feature.shape[0], width, prior.prediction_length, config.n_obs_steps)
        if config.network:
            try:
                network = from_config(VelocityNetwork, json.loads(config.network))
            except (ValueError, TypeError, AttributeError) as error:
                raise ValueError(
                    "--policy.network is the JSON of VelocityNetwork.config(), got "
                    f"{config.network!r} ({error})"
                ) from error
            network.check_sizes(*sizes)
        else:
            network = ChiTransformer(
                *sizes,
                hidden_dim=config.hidden_dim,
                num_layers=config.num_layers,
                num_heads=config.num_heads,
                dropout=config.dropout,
            )
        preconditioned = isinstance(network, PreconditionedNetwork)
        if encoder is not None:
            network = VisionNetwork(encoder, network)
        if config.precondition and not preconditioned:
            network = self._preconditioned(network, dataset_meta, steps)
        config.prior = config.source  # the preconditioning recognised absolute targets, if there are any
        prior = config.make_prior()
        if dataset_meta is not None:
            used = recording_of(config, dataset_meta, training_episodes(dataset_meta))
            logging.info("%s\n%-13s %s (--policy.prior)", used.text("--policy.{}"), "source", config.prior)
            config.recording = json.dumps(asdict(used))
        # With MIN_MAX the data span [-1, 1], so actions are clipped to it before they are executed and
        # remembered. In other units the span is unknown.
        spans = config.normalization_mapping.get("ACTION") == NormalizationMode.MIN_MAX
        self.actor = WarmFlowActor(
            network,
            prior,
            execute=config.n_action_steps,
            nfe=config.nfe,
            clip=1.0 if spans else None,
            recording=config.make_recording(),
        )
        self.averaged = ema_of(network, config.ema_rate)
        self._withheld = WithheldHistory(config.cold_probability)
        # A saved policy's moments are those of other data with another normalisation.
        fitted = {n: v for n, v in self.state_dict().items() if ".moments." in n or ".trend." in n}
        self.__dict__["_fitted"] = {} if dataset_meta is None else {n: v.clone() for n, v in fitted.items()}
        # The loss shares the actor's weights; outside of the module it is not saved a second time.
        self.__dict__["_loss_of_actor"] = None
        self.reset()

    def _training_steps(self, dataset_meta: Any) -> TensorDictBase | None:
        """Return the raw steps of the training, if this machine has them, and check observations by them."""
        config, root = self.config, dataset_meta.root
        if config.names_observations and not config.precondition:
            return None  # nothing depends on them
        if not any(root.glob("data/*/*.parquet")):
            if not config.names_observations:
                logging.warning(
                    "%s has no steps: it is not checked if an observation holds the action of the same or a "
                    "later step, its own target (--policy.input_features names observations)",
                    root,
                )
            return None
        demonstrations = open_demonstrations(f"lerobot:{root}", episodes=training_episodes(dataset_meta))
        steps = demonstrations.steps(config.observed)
        if not config.names_observations:
            index = demonstrations.index(config.observed)
            # Who names the joints wants to see them.
            demonstrations.check_targets(index, steps, config.joints, option="--policy.input_features")
        return steps

    def _preconditioned(
        self, network: VelocityNetwork, dataset_meta: Any, steps: TensorDictBase | None
    ) -> PreconditionedNetwork:
        """Precondition the network by the moments of source and data; a saved policy's are in its file."""
        key, trend = self.config.joints, None
        if dataset_meta is None:
            if key not in ("", "auto"):
                resting = RestingJoints(self.config.joint_columns(key))
                trend = RestingTrend.zero(resting.config(), network.prediction_length)
            return PreconditionedNetwork(network, trend=trend)
        mode = self.config.normalization_mapping.get("ACTION")
        if mode != NormalizationMode.MIN_MAX:
            raise ValueError(
                f"the preconditioning is fitted to actions that are normalised by MIN_MAX, not by {mode}: "
                "choose that, or --policy.precondition=false"
            )
        if steps is None:
            raise ValueError(
                f"the preconditioning is fitted to the steps of a dataset, and {dataset_meta.root} has none: "
                "set --dataset.streaming=false, or --policy.precondition=false"
            )
        # LeRobot's own step, because it maps a constant dimension to -1.
        names = (*self.config.observed, keys.ACTION)
        features = {**self.config.input_features, **self.config.output_features}
        modes = {FeatureType[kind]: mode for kind, mode in self.config.normalization_mapping.items()}
        norm = NormalizerProcessorStep(
            {name: features[name] for name in names}, modes, stats=dataset_meta.stats
        )
        parts = steps[keys.OBSERVATION].split([self._widths[name] for name in self.config.observed], -1)
        observed = dict(zip(self.config.observed, parts, strict=True))
        normalised = norm({TransitionKey.OBSERVATION: observed, TransitionKey.ACTION: steps[keys.ACTION]})
        steps[keys.ACTION] = normalised[TransitionKey.ACTION]
        vectors = [normalised[TransitionKey.OBSERVATION][name] for name in self.config.observed]
        steps[keys.OBSERVATION] = torch.cat(vectors, -1)
        rest = self._resting_joints(steps, dataset_meta)
        prior, withhold = self.config.make_prior(), self.config.cold_probability
        return precondition(network, steps, prior, withhold=withhold, rest=rest)

    def _resting_joints(self, steps: TensorDictBase, dataset_meta: Any) -> RestingJoints | None:
        """Return the resting action of absolute joint targets, and write their key into the configuration."""
        config, asked = self.config, self.config.joints
        key = asked
        if asked == "auto":
            key = named_joints(dataset_meta.features, config.observed)
        kinds = {config.input_features[name].type.value for name in config.observed}
        other = kinds - {k for k, m in config.normalization_mapping.items() if m == NormalizationMode.MIN_MAX}
        if key and other:
            why = f"joint targets need {' and '.join(sorted(other))} to be normalised by MIN_MAX"
            if asked != "auto":
                raise ValueError(f"{why}: change --policy.normalization_mapping, or set --policy.joints=")
            logging.warning("%s: the actions count as no targets of %s", why, key)
            key = ""
        if key:
            ends = []
            for end in ("min", "max"):
                numbers = {
                    n: torch.as_tensor(dataset_meta.stats[n][end]).float().flatten() for n in self._widths
                }
                vector = torch.cat([numbers[name] for name in config.observed])
                ends.append({keys.OBSERVATION: vector, keys.ACTION: numbers[keys.ACTION]})
            rest = RestingJoints(torch.tensor(config.joint_columns(key)), Normalizer(*ends))
            worst = rest.farthest(steps[keys.OBSERVATION], steps[keys.ACTION])
            if worst is None:
                config.joints = key
                return rest
            if asked != "auto":
                raise ValueError(
                    f"the actions are not near {key}, which they should set, least of all action {worst}: "
                    "use the same order and units, or --policy.joints="
                )
        config.joints = ""
        return None

    def load_state_dict(self, state_dict: Mapping[str, Tensor], *args: Any, **kwargs: Any) -> Any:
        """Load weights, and keep moments that were fitted to the training data."""
        return super().load_state_dict({**state_dict, **self._fitted}, *args, **kwargs)

    def update(self) -> None:
        """Average the weights; LeRobot calls this after every training step."""
        self.averaged.update_parameters(self.actor.network)

    @property
    def acting(self) -> WarmPriorActor:
        """Return the actor for decisions, which has the averaged weights, once there are any."""
        return self.actor.replace(network=self.averaged.module) if self.averaged.n_averaged else self.actor

    def get_optim_params(self) -> Any:
        """Return the weights with decay, and those without."""
        return cast(VelocityNetwork, self.actor.network).parameter_groups(self.config.optimizer_weight_decay)

    def reset(self) -> None:
        """Start new episodes in all environments."""
        names = (*self.config.observed, *self._cameras)
        self._queues = {name: deque(maxlen=self.config.n_obs_steps) for name in names}
        self._queues["action"] = deque(maxlen=self.config.n_action_steps)
        prior = self.actor.prior
        self.__dict__["_memory"] = ActionMemory(prior, self.config.action_feature.shape[0])

    def forward(
        self, batch: dict[str, Tensor], reduction: Literal["mean", "none"] = "mean"
    ) -> tuple[Tensor, dict[str, float]]:
        """Return the conditional flow-matching loss (Algorithm 1).

        ``batch`` has ``"action"``, ``[B, H + P, d_a]``, with the remembered actions first,
        ``"action_is_pad"``, observations ``[B, To, d]``, and images in [0, 1], ``[B, To, 3, h, w]``. The
        reduction ``"none"`` gives the loss of each sample, ``[B]``, averaged over positions that are not
        padded.
        """
        check_choice("reduction", reduction, ("mean", "none"))
        if "action_is_pad" not in batch:
            raise KeyError(
                "the batch lacks action_is_pad: pass it, because LeRobot pads the history before an episode "
                "with its first action, which is the target"
            )
        batch = with_width(batch, self._widths)
        prior = self.actor.prior
        lengths = [prior.history_length, prior.prediction_length]
        before, target = batch["action"].split(lengths, dim=1)
        valid, inside = (~batch["action_is_pad"].bool()).split(lengths, dim=1)
        before = torch.where(valid.unsqueeze(-1), before, 0.0)
        steps = valid.sum(1, keepdim=True)
        data = TensorDict(
            {
                keys.OBSERVATION: self._observation(batch),
                keys.HISTORY: window_history(before, steps, target, prior.chunk_length),
                keys.CHUNK: target,
                keys.IS_PAD: ~inside,
            },
            [len(target)],
        )
        if self.config.cold_probability > 0:
            data = self._withheld(data)
        loss_module = self._loss()
        loss_module.reduction = reduction
        loss = loss_module(data)["loss_flow_matching"]
        if reduction == "none":
            loss = loss.sum((1, 2)) / (inside.sum(1) * loss.shape[-1]).clamp_min(1)
        return loss, {"flow_matching": loss.mean().item()}

    def _loss(self) -> FlowMatchingLoss:
        """Return the loss of the policy's present weights."""
        loss = self.__dict__["_loss_of_actor"]
        weights = {id(weight) for weight in self.actor.network.parameters()}
        # A copied policy, or one whose weights were replaced, needs a new loss.
        if loss is None or {id(weight) for weight in loss.parameters()} != weights:
            loss = self.__dict__["_loss_of_actor"] = FlowMatchingLoss(self.actor)
        return loss

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return a new chunk, ``[B, P, d_a]``, normalised.

        It depends on the present observations ``[B, d]`` and images ``[B, 3, h, w]``, and on those since
        :meth:`reset`. ``executed_steps=`` is the number of executed actions of the last chunk, by default as
        many as :meth:`select_action` returned.
        """
        executed = kwargs.pop("executed_steps", None)
        check_known("predict_action_chunk", kwargs, ["executed_steps"])
        if executed is not None:
            self._memory.executed(executed)
        self._remember(batch)
        return self._chunk()

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return the next action of every environment, ``[B, d_a]``, normalised."""
        check_known("select_action", kwargs, [])
        self._remember(batch)
        if not self._queues["action"]:
            self._queues["action"].extend(self._chunk().transpose(0, 1)[: self.config.n_action_steps])
        self._memory.step()
        return self._queues["action"].popleft()

    def _remember(self, batch: dict[str, Tensor]) -> None:
        needed = *self.config.observed, *self._cameras
        check_keys(batch, needed, "the policy", "; its config.json names them in input_features")
        check_observed(batch, self.config.observed, self._cameras)
        observations = {name: batch[name] for name in needed}
        self._memory.expect(len(batch[self.config.observed[0]]))
        self._queues = populate_queues(self._queues, observations)

    def _chunk(self) -> Tensor:
        self.eval()
        queued = {n: torch.stack(list(q), dim=1) for n, q in self._queues.items() if n != "action"}
        observation = self._observation(queued)
        first = queued[self.config.observed[0]]
        history = self._memory.decide(len(first), first.device)
        data = TensorDict({keys.OBSERVATION: observation, keys.HISTORY: history}, history.shape)
        chunk = self.acting(data)[keys.CHUNK]
        self._memory.record(chunk)
        return chunk

    def _observation(self, batch: dict[str, Tensor]) -> Tensor | TensorDict:
        """Return the observation ``[B, To, d_o]``, or a TensorDict with images for the encoder."""
        vector = torch.cat([batch[name] for name in self.config.observed], dim=-1)
        if not self._cameras:
            return vector
        images = {name: self._pixels(batch[name]) for name in self._cameras}
        return TensorDict({keys.STATE: vector, **images}, [len(vector)])

    def _pixels(self, images: Tensor) -> Tensor:
        """Return images in [0, 1], ``[B, To, 3, h, w]``, as uint8 squares."""
        if not images.is_floating_point():
            raise ValueError(
                f"warm_flow sees images as numbers in [0, 1], as LeRobot loads them, got {images.dtype}"
            )
        pixels = (255 * images).round().clamp(0, 255).to(torch.uint8)
        return resized(pixels, (self.config.image_size,) * 2, cast(Any, self.config.resize))
