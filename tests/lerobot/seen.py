from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import torch

from tests.lerobot.tiny import LENGTH


@contextmanager
def watch(family: str, policy: Any) -> Any:
    """Inputs ``x`` and outputs of the network (velocities, or actions), and ``t`` where it has that name."""
    seen, handles = SimpleNamespace(x=[], out=[], t=[]), []

    def before(module: Any, take: Any) -> None:
        def hook(module: Any, args: Any, kwargs: Any) -> None:
            seen.x.append(take(args, kwargs).detach().clone())
            seen.t.append(kwargs.get("t"))

        handles.append(module.register_forward_pre_hook(hook, with_kwargs=True))

    def after(module: Any, take: Any = lambda out: out) -> None:
        handles.append(module.register_forward_hook(lambda m, a, out: seen.out.append(take(out).detach())))

    if family in ("smolvla", "pi0", "pi05"):
        before(policy.model.action_in_proj, lambda args, kwargs: args[0])
        after(policy.model.action_out_proj)
    elif family == "groot":
        head = policy._groot_model.action_head
        before(head.action_encoder, lambda args, kwargs: args[0])
        after(head.action_decoder, lambda out: out[:, -LENGTH:])
    elif family == "multi_task_dit":
        before(policy.noise_predictor, lambda args, kwargs: args[0])
        after(policy.noise_predictor)
    else:
        before(policy.model.transformer, lambda args, kwargs: kwargs["action_with_noise"])
        after(policy.model.transformer)
    try:
        yield seen
    finally:
        for handle in handles:
            handle.remove()


@contextmanager
def at_times(family: str, policy: Any, t: torch.Tensor) -> Any:
    """Training at these times, as the family counts them."""
    owner, name = {
        "groot": lambda: (policy._groot_model.action_head, "sample_time"),
        "multi_task_dit": lambda: (policy.objective, "_sample_timesteps"),
    }.get(family, lambda: (policy.model, "sample_time"))()
    vars(owner)[name] = lambda *args, **kwargs: t
    try:
        yield
    finally:
        del vars(owner)[name]
