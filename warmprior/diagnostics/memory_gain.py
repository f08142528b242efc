"""Memory gain: how far a policy follows what it was doing, whatever it observes."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from warmprior.diagnostics.flow import (
    allowed_nfes,
    encoded_windows,
    evaluation_mode,
    flat_windows,
    predict,
)
from warmprior.modules.actor import WarmPriorActor
from warmprior.transforms.mean_observation import MeanObservation

__all__ = ["memory_gain"]


def memory_gain(
    policy: WarmPriorActor,
    windows: TensorDictBase,
    *,
    nfes: Sequence[int] = (1, 9),
    shift: float = 0.05,
    split: int = 4096,
    generator: torch.Generator | None = None,
) -> dict[int, float]:
    r"""How much of a shift of the remembered mean reappears in the executed actions.

    At the same observation and the same noise of the source, the mean is moved by
    :math:`\pm\delta e`, alike at all warm positions, with a random direction :math:`e` of unit length per
    window. The gain is

    .. math::
        \sqrt{E\,\Big\lVert \frac{a_\tau(\mu + \delta e) - a_\tau(\mu - \delta e)}{2\delta} \Big\rVert^2}

    over windows, directions and the executed positions :math:`\tau` inside the episode: 0 for a policy that
    does not depend on what was done before, 1 for one that repeats it. It is a property of the policy, not
    a fault: the mean may know what the observation does not tell. But what demonstrations never contain, an
    action of the policy's own that was wrong, is carried on by as much. One Euler step of an exact field is a
    regression on the source, and the noise of the source's average over the chunk,
    :math:`\sigma\sqrt{\rho + (1 - \rho)/H}` with a ``correlation`` of :math:`\rho`, lowers the gain: if past
    and next actions are one height that varies by :math:`s` at an observation, it is
    :math:`s^2 / (s^2 + \sigma^2 (\rho + (1 - \rho)/H))`.

    Args:
        policy: the policy; its state stays as it is.
        windows: ``[*B]`` of the policy's own prior, normalised, see :class:`~warmprior.ActionWindow` and
            :meth:`SharedObservations.windows`; images as they are, not encoded.

    Keyword Args:
        nfes: network evaluations per chunk to measure at; those beyond the prior's maximum are skipped.
        shift: :math:`\delta`, in normalised action units.
        split: network batch size, for bounded memory; it changes nothing else.
        generator: source of randomness on the policy's device; by default one of its own with a fixed
            seed. One direction and sample of the source per window, the same for every NFE.

    Returns:
        By NFE, ascending; 0 if nothing of the windows is warm.

    Raises:
        KeyError: if the windows lack a key.
        ValueError: if the windows are empty, hold NaN or Inf, or belong to another prediction length, if
            ``shift`` is not positive, or the prior allows none of the NFEs.
        FloatingPointError: if a prediction is NaN or infinite.

    See Also:
        - :func:`~warmprior.diagnostics.source_leak`: the same for the noise of the source.
        - :class:`~warmprior.diagnostics.HistoryShift`: plays a policy with a disturbed memory.

    Examples:
        >>> from warmprior import GaussianPrior, PastPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior.diagnostics import SharedObservations
        >>> from warmprior.envs import navigation_demonstrations
        >>> shared = SharedObservations(navigation_demonstrations(), 4)
        >>> def measured(prior):
        ...     untrained = WarmPriorActor(VelocityMLP(1, 9, 4, observation_steps=1), prior)
        ...     return memory_gain(untrained, shared.windows(prior))[1]
        >>> measured(PastPrior(4)) > 0.5, measured(GaussianPrior(4))
        (True, 0.0)
    """
    if not (math.isfinite(shift) and shift > 0):
        raise ValueError(f"shift must be a finite number > 0, got {shift}")
    prior, allowed = policy.prior, allowed_nfes(policy, nfes)
    _, loc_key, warm_key = policy.in_keys
    seen = encoded_windows(policy, windows)
    flat = flat_windows(policy, seen)
    device, n = flat.loc.device, len(flat)
    if generator is None:
        generator = torch.Generator(device).manual_seed(0)
    normal = torch.randn(
        n, 1, flat.loc.shape[-1], generator=generator, dtype=flat.loc.dtype, device=device
    )
    moved = shift * flat.warm * torch.nn.functional.normalize(normal, dim=-1)
    drawn = generator.get_state()
    # A network that sees the mean encodes it together with the images.
    plain = (windows if prior.conditions_network else seen).reshape(n).to(device)

    def predicted(loc: Tensor) -> dict[int, Tensor]:
        generator.set_state(drawn)  # the same noise on both sides
        a0 = prior.start(loc, flat.warm, generator, flat.observation)
        rows = plain.clone(recurse=False).set(loc_key, loc)
        if prior.conditions_network:
            rows = encoded_windows(
                policy, MeanObservation(loc_key=loc_key, warm_key=warm_key)(rows)
            )
        rows = rows.select(*policy.in_keys)
        return {nfe: predict(policy, rows, a0, nfe=nfe, split=split) for nfe in allowed}

    with evaluation_mode(policy):
        up, down = predicted(flat.loc + moved), predicted(flat.loc - moved)
    executed = slice(prior.chunk_length)
    counted = flat.counted[:, executed, 0]
    gains = {}
    for nfe in allowed:
        response = torch.linalg.vector_norm(up[nfe] - down[nfe], dim=-1)[:, executed] / (2 * shift)
        gains[nfe] = float(response[counted].square().mean().sqrt())
    return gains
