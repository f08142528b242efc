"""Transforms of replay buffers and environments."""

from warmprior.transforms.absolute_actions import AbsoluteActions
from warmprior.transforms.chunk import ChunkStep
from warmprior.transforms.delay import InferenceDelay, executed_chunk
from warmprior.transforms.history import ActionHistory, HistoryObservation, WithheldHistory
from warmprior.transforms.images import CameraImages, EncodeObservation
from warmprior.transforms.normalize import normalizing_transforms
from warmprior.transforms.policy import policy_transforms
from warmprior.transforms.stack import ObservationStack
from warmprior.transforms.window import ActionWindow, window_replay_buffer, window_transforms

__all__ = [
    "AbsoluteActions",
    "ActionHistory",
    "ActionWindow",
    "CameraImages",
    "ChunkStep",
    "EncodeObservation",
    "HistoryObservation",
    "InferenceDelay",
    "ObservationStack",
    "WithheldHistory",
    "executed_chunk",
    "normalizing_transforms",
    "policy_transforms",
    "window_replay_buffer",
    "window_transforms",
]
