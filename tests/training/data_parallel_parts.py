"""What each of several processes does in the tests of data parallel training."""

import dataclasses
import os
import signal

import torch

from tests.toy_env import Learned
from tests.training.cloning_parts import CONFIG, actor_for, mlp, run_until, training, weights
from warmprior import PastPrior
from warmprior.io.distributed import rank

STEPS = dataclasses.replace(
    CONFIG, iterations=20, learning_rate=1e-3, save_every=5, checkpoints=1, cold_probability=0.0
)


CLIPPED = 0.1
CASES = {
    "plain": ({}, {}, lambda: actor_for(PastPrior(4), mlp())),
    "dropout, withheld": ({"cold_probability": 0.5}, {}, actor_for),
    "clipped": ({"max_grad_norm": CLIPPED}, {}, lambda: actor_for(Learned(4), mlp())),
    "learning prior": ({}, {}, lambda: actor_for(Learned(4), mlp())),
}
"""Recipes, options and policies."""


def cloning(folder, case, **changes):
    recipe, options, make = CASES[case]
    config = dataclasses.replace(STEPS, **recipe, **changes)
    return training(folder, config, actor=make(), **options)


def first_step(folder, case):
    """Its loss and gradients, and the points at which the network was evaluated."""
    points = []
    part = cloning(folder / "first" / f"{case} {rank()}", case)
    part.actor.network.register_forward_pre_hook(
        lambda network, inputs: points.append(inputs[1].detach().clone())
    )
    loss = part.step()
    if part._prefetch is not None:
        part._prefetch.close()
    return loss, {n: p.grad.clone() for n, p in part.update.trained.named_parameters()}, points


def trained(folder, case):
    part = cloning(folder / case, case)
    part.run(None)
    torch.save((weights(part), part.losses), folder / f"{case} {rank()}.pt")


def whole(folder):
    """Everything that ends well, in one go: processes start slowly."""
    torch.save({case: first_step(folder, case) for case in CASES}, folder / f"first {rank()}.pt")
    for case in CASES:
        trained(folder, case)
    for name in ("one", "two"):  # the same from the same state
        run_until(cloning(folder / name / "plain", "plain"), 12)
        trained(folder / name, "plain")
    diverges(folder)


def dies(folder):
    """The second process is killed at the twelfth step."""
    part = cloning(folder / "plain", "plain")
    step = part.step

    def dying():
        if part.iteration == 12 and rank():
            os.kill(os.getpid(), signal.SIGKILL)
        return step()

    part.step = dying
    part.run(None)


def diverges(folder):
    """Windows of the second process alone lead to NaN."""
    part = cloning(folder / "diverges", "plain")
    if rank():
        times = part.update.loss_module.times
        part.update.loss_module.times = lambda *args: times(*args) * float("nan")
    try:
        part.run(None)
    except FloatingPointError as error:
        (folder / f"diverged {rank()}").write_text(str(error))
