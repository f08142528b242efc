"""Policies of this library, TorchRL and LeRobot: training and decisions on the same windows."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any
from unittest import mock

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from lab.speed.timing import D_A, D_O, NFES, PRIOR, TO, Clock, H, one_decision, steps
from warmprior import (
    AdaLNTransformer,
    ChiTransformer,
    FlowMatchingLoss,
    VelocityMLP,
    VelocityNetwork,
    WarmPriorActor,
    window_replay_buffer,
)

VECTOR, OBJECTS = 9, D_O - 9  # widths of the robot's own state and of the objects'

type Batch = TensorDictBase


@dataclass
class Peer:
    """A policy to measure."""

    name: str
    module: nn.Module  # the module that is trained
    loss: Callable[[Batch], torch.Tensor]  # the loss of a batch of windows
    decide: Callable[[int], object]  # makes a chunk for one observation, at a number of network evaluations
    own_steps: int  # network evaluations per chunk by default in its package
    network_pass: Callable[[Batch], torch.Tensor] | None = None  # counted in place of the loss

    @property
    def parameters(self) -> int:
        """Return the number of trained parameters."""
        return sum(p.numel() for p in self.module.parameters() if p.requires_grad)


def ours(kind: Callable[..., VelocityNetwork], width: int, device: str) -> Peer:
    """Return FlowMatchingLoss on one of this library's networks."""
    network = kind(D_A, D_O, H, TO, hidden_dim=width).to(device)
    actor = WarmPriorActor(network, PRIOR)
    loss = FlowMatchingLoss(actor)
    data = one_decision(device)
    return Peer(
        f"warmprior: FlowMatchingLoss, {type(network).__name__}",
        network,
        lambda batch: loss(batch)["loss_flow_matching"],
        lambda nfe: actor(data, nfe=nfe),
        1,
        lambda batch: network(
            torch.rand(len(batch), device=device), batch["vla_action", "chunk"], batch["observation"]
        ),
    )


def torchrl(width: int, device: str) -> Peer:
    """Return DiffusionBCLoss and DiffusionActor with an MLP; the chunk is one vector."""
    from torchrl.modules import MLP, DiffusionActor
    from torchrl.objectives import DiffusionBCLoss

    chunk, observed = H * D_A, TO * D_O
    inputs = chunk + observed + 1
    network = MLP(inputs, chunk, num_cells=[width] * 5, activation_class=nn.SiLU, device=device)

    def actor(num_steps: int) -> nn.Module:
        return DiffusionActor(chunk, score_network=network, num_steps=num_steps).to(device)

    loss = DiffusionBCLoss(actor(100))
    actors = {nfe: actor(nfe) for nfe in (*NFES, 100)}
    data = TensorDict({"observation": torch.randn(1, observed)}, [1]).to(device)

    def chunk_loss(batch: Batch) -> torch.Tensor:
        action = batch["vla_action", "chunk"].flatten(1)
        flat = {"observation": batch["observation"].flatten(1), "action": action}
        return loss(TensorDict(flat, batch.batch_size))["loss_diffusion_bc"]

    return Peer(
        "torchrl: DiffusionBCLoss, MLP",
        network,
        chunk_loss,
        lambda nfe: actors[nfe](data.copy()),
        100,
        lambda batch: network(torch.zeros(len(batch), inputs, device=device)),
    )


def features(objects: bool, device: str) -> dict[str, Any]:
    """Return the features and lengths that LeRobot's configurations take."""
    from lerobot.configs.types import FeatureType, PolicyFeature

    state = VECTOR if objects else D_O
    inputs = {"observation.state": PolicyFeature(type=FeatureType.STATE, shape=(state,))}
    if objects:
        shape = (OBJECTS,)
        inputs["observation.environment_state"] = PolicyFeature(type=FeatureType.ENV, shape=shape)
    outputs = {"action": PolicyFeature(type=FeatureType.ACTION, shape=(D_A,))}
    length = {"n_obs_steps": TO, "horizon": H, "n_action_steps": H - TO + 1}
    return {"input_features": inputs, "output_features": outputs, "device": device, **length}


def lerobot(
    name: str,
    policy: Any,
    to_batch: Callable[[torch.Tensor], dict[str, torch.Tensor]],
    set_steps: Callable[[int], None],
    device: str,
) -> Peer:
    """Return a policy of LeRobot; ``to_batch`` maps observations to its keys."""
    observation = to_batch(torch.randn(1, D_O, device=device))

    def loss(batch: Batch) -> torch.Tensor:
        target = {"action": batch["vla_action", "chunk"], "action_is_pad": batch["action_is_pad"]}
        return policy(to_batch(batch["observation"]) | target)[0]

    def decide(nfe: int) -> None:
        set_steps(nfe)
        policy.reset()
        policy.select_action(dict(observation))

    return Peer(name, policy, loss, decide, 100)


def lerobot_diffusion(width: int, device: str) -> Peer:
    """Return LeRobot's Diffusion Policy: a U-Net over the chunk, conditioned on state vectors."""
    from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
    from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy

    dims = (width, 2 * width, 4 * width)
    policy = DiffusionPolicy(DiffusionConfig(**features(True, device), down_dims=dims)).to(device)

    def to_batch(observation: torch.Tensor) -> dict[str, torch.Tensor]:
        parts = observation.split((VECTOR, OBJECTS), dim=-1)
        return dict(zip(("observation.state", "observation.environment_state"), parts, strict=True))

    set_steps = partial(setattr, policy.diffusion, "num_inference_steps")
    return lerobot("lerobot: diffusion (U-Net)", policy, to_batch, set_steps, device)


def lerobot_multi_task_dit(width: int, device: str) -> Peer:
    """Return LeRobot's multi_task_dit with flow matching and a tiny language encoder."""
    from lerobot.policies.multi_task_dit import modeling_multi_task_dit as modeling
    from lerobot.policies.multi_task_dit.configuration_multi_task_dit import MultiTaskDiTConfig
    from transformers import CLIPTextConfig

    # Its own encoder needs weights from a hub; this one has two layers of width 32 and random weights.
    sizes: dict[str, Any] = {
        "vocab_size": 64,
        "hidden_size": 32,
        "intermediate_size": 64,
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
        "eos_token_id": 2,
    }
    small = CLIPTextConfig(**sizes)
    encoder = classmethod(lambda kind, *args, **kwargs: kind(small))
    flow = {"objective": "flow_matching", "hidden_dim": width}
    with mock.patch.object(modeling.CLIPTextModel, "from_pretrained", encoder):
        config = MultiTaskDiTConfig(**features(False, device), **flow)
        policy = modeling.MultiTaskDiTPolicy(config).to(device)

    def to_batch(observation: torch.Tensor) -> dict[str, torch.Tensor]:
        token = torch.ones(len(observation), 1, dtype=torch.bool, device=device)
        language = {"tokens": 0 * token.long(), "attention_mask": token}
        named = {f"observation.language.{name}": value for name, value in language.items()}
        return {"observation.state": observation, **named}

    set_steps = partial(setattr, policy.config, "num_integration_steps")
    return lerobot("lerobot: multi_task_dit", policy, to_batch, set_steps, device)


warmprior_transformer = partial(ours, ChiTransformer)  # the paper's network
warmprior_adaln = partial(ours, AdaLNTransformer)
warmprior_mlp = partial(ours, VelocityMLP)


def training_step(peer: Peer, sample: Callable[[], Batch]) -> Callable[[], object]:
    """Return a training step: sample windows, loss, backward, optimiser."""
    trained = [p for p in peer.module.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(trained, fused=True)

    def step() -> None:
        peer.module.train()
        loss = peer.loss(sample())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    return step


def flop_of(peer: Peer, batch: Batch) -> int:
    """Return the floating-point operations of a training step, without the optimiser."""
    compute = peer.loss if peer.network_pass is None else peer.network_pass
    with FlopCounterMode(display=False) as counter:
        compute(batch).sum().backward()
    return counter.get_total_flops()


def measure(peers: Sequence[Peer], device: str, batch: int, clock: Clock) -> list[dict[str, Any]]:
    """Return a row per policy: training speed, operations, and the time of a chunk by NFE."""
    data = steps(400, 200).to(device)
    sample = window_replay_buffer(data, PRIOR, batch_size=batch, observation_steps=TO).sample
    training = clock.times(*(training_step(peer, sample) for peer in peers))
    rows: list[dict[str, Any]] = []
    for peer, seconds in zip(peers, training, strict=True):
        speed, work = batch / statistics.median(seconds), flop_of(peer, sample()) / batch / 1e9
        row = {"policy": peer.name, "parameters": peer.parameters, "own_steps": peer.own_steps}
        rows.append(
            row | {"samples_per_second": speed, "gflop_per_sample": work, "gflop_per_second": speed * work}
        )
    for peer in peers:
        peer.module.eval()
    with torch.no_grad():
        for nfe in NFES:
            decisions = [partial(peer.decide, nfe) for peer in peers]
            for row, seconds in zip(rows, clock.times(*decisions, calls=5), strict=True):
                row[f"latency_nfe_{nfe}"] = 1000 * statistics.median(seconds)
        for row, peer in zip(rows, peers, strict=True):
            (seconds,) = clock.times(partial(peer.decide, peer.own_steps))
            row["latency_own"] = 1000 * statistics.median(seconds)
    return rows
