"""Decisions of the library over the evaluations of its network."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from torch import nn

from lab.speed.timing import D_A, NFES, PRIOR, Clock, H, one_decision
from lab.speed.training import default_network, paper_network
from warmprior import WarmPriorActor
from warmprior.deploy import export_policy, load_exported


@torch.no_grad()
def _passes(network: nn.Module, inputs: tuple[torch.Tensor, ...], nfe: int) -> None:
    for _ in range(nfe):
        network(*inputs)


@torch.no_grad()
def actor_over_network(clock: Clock, make: Callable[[], nn.Module] = paper_network) -> dict[str, float]:
    network = make().eval()
    actor = WarmPriorActor(network, PRIOR).eval()
    data, t, a = one_decision(), torch.rand(1), torch.randn(1, H, D_A)
    ratio_by_nfe = {}
    for nfe in NFES:
        ratio_by_nfe[str(nfe)] = clock.ratio(
            partial(actor, data, nfe=nfe),
            partial(_passes, network, (t, a, data["observation"]), nfe),
            calls=max(2, 18 // nfe),
        )
    return ratio_by_nfe


default_actor_over_network = partial(actor_over_network, make=default_network)


@torch.no_grad()
def exported_over_passes(clock: Clock) -> float:
    network = default_network().eval()
    with tempfile.TemporaryDirectory() as folder:
        path = export_policy(WarmPriorActor(network, PRIOR, nfe=3), Path(folder) / "policy.pt2")
        exported = load_exported(path)
    data, t, a = one_decision(), torch.rand(1), torch.randn(1, H, D_A)
    alone = data[0]  # an exported policy decides for one robot
    return clock.ratio(
        partial(exported.forward, alone), partial(_passes, network, (t, a, data["observation"]), 3), calls=20
    )
