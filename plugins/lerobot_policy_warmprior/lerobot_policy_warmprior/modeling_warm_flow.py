"""``--policy.type=warm_flow``: a policy of this library as one of LeRobot."""

from __future__ import annotations

import gc
import json
from collections import deque
from collections.abc import Mapping
from typing import Any, Literal, cast

import torch
from lerobot.configs.types import FeatureType, NormalizationMode
from lerobot.datasets import LeRobotDataset
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.policies.utils import populate_queues
from lerobot.processor import NormalizerProcessorStep, TransitionKey
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn.functional import interpolate

from lerobot_policy_warmprior.configuration_warm_flow import WarmFlowConfig
from lerobot_policy_warmprior.loading import WholePolicy, check_known, check_statistics
from warmprior import (
    ChiTransformer,
    FlowMatchingLoss,
    ImageEncoder,
    PreconditionedNetwork,
    Prior,
    VelocityNetwork,
    VisionNetwork,
    WarmPriorActor,
    WithheldHistory,
    keys,
)
from warmprior.checks import check_choice
from warmprior.data import lerobot_steps
from warmprior.history import window_history
from warmprior.lerobot.adapter import with_width
from warmprior.lerobot.memory import ActionMemory
from warmprior.modules import load_imagenet
from warmprior.modules.registry import from_config
from warmprior.training import ema_of, precondition


def training_episodes(meta: Any) -> list[int] | None:
    """Numbers of the episodes that a training reads; ``None`` for all.

    LeRobot gives a policy the metadata, which is of all episodes: only its dataset, which holds them, knows.
    """
    datasets = (o for o in gc.get_objects() if issubclass(type(o), LeRobotDataset))
    dataset = next((o for o in datasets if o.meta is meta), None)
    return None if dataset is None else dataset.episodes


class WarmFlowPolicy(WholePolicy, PreTrainedPolicy):
    """Flow matching from a prior: :class:`~warmprior.WarmPriorActor` and its loss as a policy of LeRobot.

    A training's ``dataset_meta`` is of the dataset to whose training episodes the preconditioning is fitted,
    also where it goes on from a saved policy. A ``ValueError`` if the network does not fit it, it has no
    statistics, or the prior has networks of its own, which LeRobot would not train.
    """

    config_class = WarmFlowConfig
    name = "warm_flow"
    config: WarmFlowConfig
    _memory: ActionMemory
    _fitted: dict[str, Tensor]
    _queues: dict[str, deque[Tensor]]

    def __init__(
        self, config: WarmFlowConfig, *, dataset_meta: Any = None, dataset_stats: Any = None
    ) -> None:
        super().__init__(config)
        config.validate_features()
        if dataset_meta is not None:
            check_statistics(config, dataset_meta)
        prior = config.make_prior()
        if isinstance(prior, nn.Module):
            raise ValueError(
                f"prior={config.prior!r} is trained beside the flow: lerobot-train does not; take past, "
                "preview or gaussian"
            )
        seen = {**config.input_features, **config.output_features}
        self._widths = {name: seen[name].shape[0] for name in (*config.observed, keys.ACTION)}
        width = sum(self._widths[name] for name in config.observed)
        self._cameras, encoder = list(config.image_features), None
        if self._cameras:
            backbone, _, pretrained = config.encoder.partition("-")
            encoder = ImageEncoder(
                self._cameras,
                width,
                backbone=cast(Any, backbone),  # which the configuration has checked
                image_size=config.image_size,
                crop_size=config.crop_size,
            )
            # A saved policy has its weights in its file.
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
            names = ("action_dim", "observation_dim", "prediction_length", "observation_steps")
            built = tuple(getattr(network, name) for name in names)
            if built != sizes:
                raise ValueError(
                    f"the network was built for {dict(zip(names, built, strict=True))}, but features and "
                    f"prior need {dict(zip(names, sizes, strict=True))}"
                )
        else:
            network = ChiTransformer(
                *sizes,
                embedding_dim=config.embedding_dim,
                num_layers=config.num_layers,
                num_heads=config.num_heads,
                dropout=config.dropout,
            )
        preconditioned = isinstance(network, PreconditionedNetwork)
        if encoder is not None:
            network = VisionNetwork(encoder, network)
        if config.precondition and not preconditioned:
            network = self._preconditioned(network, prior, dataset_meta)
        # What the data span is [-1, 1]; nothing beyond it is executed, nor remembered. In other units than
        # those of the extremes it is not known.
        spans = config.normalization_mapping.get("ACTION") == NormalizationMode.MIN_MAX
        self.actor = WarmPriorActor(network, prior, nfe=config.nfe, clip=1.0 if spans else None)
        self.averaged = ema_of(network, config.ema_rate)
        self._withheld = WithheldHistory(config.cold_probability)
        # A saved policy's moments are those of other data, which were normalised otherwise.
        fitted = {n: v for n, v in self.state_dict().items() if ".moments." in n}
        self.__dict__["_fitted"] = {} if dataset_meta is None else {n: v.clone() for n, v in fitted.items()}
        # Of the same weights, so that it is no part of the module and is not saved again.
        self.__dict__["_made"] = None
        self.reset()

    def _preconditioned(
        self, network: VelocityNetwork, prior: Prior, dataset_meta: Any
    ) -> PreconditionedNetwork:
        """The network in the moments of source and demonstrations; a saved policy has its own in its file."""
        if dataset_meta is None:
            return PreconditionedNetwork(network)
        mode = self.config.normalization_mapping.get("ACTION")
        if mode != NormalizationMode.MIN_MAX:
            raise ValueError(
                f"the preconditioning is fitted to actions that are normalised by MIN_MAX, not by {mode}: "
                "choose that, or --policy.precondition=false"
            )
        episodes = training_episodes(dataset_meta)
        steps = lerobot_steps(dataset_meta.root, self.config.observed, episodes=episodes)
        # LeRobot's own arithmetic: a dimension that never changes is -1.
        features = {keys.ACTION: self.config.action_feature}
        norm = NormalizerProcessorStep(features, {FeatureType.ACTION: mode}, stats=dataset_meta.stats)
        steps[keys.ACTION] = norm({TransitionKey.ACTION: steps[keys.ACTION]})[TransitionKey.ACTION]
        return precondition(
            network,
            steps,
            prior,
            observation_steps=self.config.n_obs_steps,
            withhold=self.config.cold_probability,
        )

    def load_state_dict(self, state_dict: Mapping[str, Tensor], *args: Any, **kwargs: Any) -> Any:
        """Load weights; moments that were fitted to a training's data stay."""
        return super().load_state_dict({**state_dict, **self._fitted}, *args, **kwargs)

    def update(self) -> None:
        """Average the weights: LeRobot calls it after every step of a training."""
        self.averaged.update_parameters(self.actor.network)

    @property
    def acting(self) -> WarmPriorActor:
        """The actor with the weights that play: the averaged ones, once there are any."""
        return self.actor.replace(network=self.averaged.module) if self.averaged.n_averaged else self.actor

    def get_optim_params(self) -> Any:
        """Weights that decay, and those that do not."""
        return cast(VelocityNetwork, self.actor.network).parameter_groups(self.config.optimizer_weight_decay)

    def reset(self) -> None:
        """New episodes in all environments."""
        seen = (*self.config.observed, *self._cameras)
        self._queues = {name: deque(maxlen=self.config.n_obs_steps) for name in seen}
        self._queues["action"] = deque(maxlen=self.config.n_action_steps)
        prior = self.actor.prior
        self.__dict__["_memory"] = ActionMemory(prior, self.config.action_feature.shape[0])

    def forward(
        self, batch: dict[str, Tensor], reduction: Literal["mean", "none"] = "mean"
    ) -> tuple[Tensor, dict[str, float]]:
        """Conditional flow matching (Algorithm 1).

        ``batch`` has ``"action"`` ``[B, H + P, d_a]`` and ``"action_is_pad"``, with the actions before in
        front, the observations ``[B, To, d]``, and images in [0, 1] ``[B, To, 3, h, w]``. The reduction
        ``"none"`` gives the loss of each sample, ``[B]``, its mean over what is not padded.
        """
        check_choice("reduction", reduction, ("mean", "none"))
        if "action_is_pad" not in batch:
            raise KeyError(
                "the batch lacks action_is_pad: the history before an episode is its first action, the "
                "target, and must be masked"
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
        made = self._loss()
        made.reduction = reduction
        loss = made(data)["loss_flow_matching"]
        if reduction == "none":
            loss = loss.sum((1, 2)) / (inside.sum(1) * loss.shape[-1]).clamp_min(1)
        return loss, {"flow_matching": loss.mean().item()}

    def _loss(self) -> FlowMatchingLoss:
        """The loss of the weights that the policy has now."""
        made = self.__dict__["_made"]
        mine = {id(weight) for weight in self.actor.network.parameters()}
        # The loss of a copied policy, or of one whose weights were replaced, trains others.
        if made is None or {id(weight) for weight in made.parameters()} != mine:
            made = self.__dict__["_made"] = FlowMatchingLoss(self.actor)
        return made

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """A new chunk, ``[B, P, d_a]``, normalised.

        From present observations ``[B, d]`` and images ``[B, 3, h, w]``, and those since :meth:`reset`.
        ``executed_steps=`` tells how much of the last chunk was executed, by default as much as
        :meth:`select_action` returned.
        """
        executed = kwargs.pop("executed_steps", None)
        check_known("predict_action_chunk", kwargs, ["executed_steps"])
        if executed is not None:
            self._memory.executed(executed)
        self._remember(batch)
        return self._chunk()

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """The next action of every environment, ``[B, d_a]``, normalised."""
        check_known("select_action", kwargs, [])
        self._remember(batch)
        if not self._queues["action"]:
            self._queues["action"].extend(self._chunk().transpose(0, 1)[: self.config.n_action_steps])
        self._memory.step()
        return self._queues["action"].popleft()

    def _remember(self, batch: dict[str, Tensor]) -> None:
        seen = {name: batch[name] for name in (*self.config.observed, *self._cameras)}
        self._memory.expect(len(batch[self.config.observed[0]]))
        self._queues = populate_queues(self._queues, seen)

    def _chunk(self) -> Tensor:
        self.eval()
        seen = {n: torch.stack(list(q), dim=1) for n, q in self._queues.items() if n != "action"}
        observation = self._observation(seen)
        first = seen[self.config.observed[0]]
        history = self._memory.decide(len(first), first.device)
        data = TensorDict({keys.OBSERVATION: observation, keys.HISTORY: history}, history.shape)
        chunk = self.acting(data)[keys.CHUNK]
        self._memory.record(chunk)
        return chunk

    def _observation(self, batch: dict[str, Tensor]) -> Tensor | TensorDict:
        """``[B, To, d_o]``, with images as the entries of an encoder."""
        vector = torch.cat([batch[name] for name in self.config.observed], dim=-1)
        if not self._cameras:
            return vector
        images = {name: self._pixels(batch[name]) for name in self._cameras}
        return TensorDict({keys.STATE: vector, **images}, [len(vector)])

    def _pixels(self, images: Tensor) -> Tensor:
        """Images in [0, 1], ``[B, To, 3, h, w]``, as uint8 squares."""
        if not images.is_floating_point():
            raise ValueError(
                f"warm_flow sees images as numbers in [0, 1], as LeRobot loads them, got {images.dtype}"
            )
        side = self.config.image_size
        flat = images.flatten(0, 1)
        if flat.shape[-2:] != (side, side):
            flat = interpolate(flat, (side, side), mode="bilinear", antialias=True)
        return (255 * flat).round().clamp(0, 255).to(torch.uint8).unflatten(0, images.shape[:2])
