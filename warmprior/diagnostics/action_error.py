"""Distance of actions from the demonstrations, without a simulator."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import TensorDictBase

from warmprior.diagnostics.flow import allowed_nfes, drawn, evaluation_mode, inputs_and_targets, predict
from warmprior.modules.actor import WarmPriorActor


def action_error(
    policy: WarmPriorActor,
    windows: TensorDictBase,
    *,
    nfes: Sequence[int] = (1, 9),
) -> dict[int, float]:
    r"""Mean squared error of the executed actions on windows of demonstrations.

    The conditional mean :math:`E[a_1 \mid a_0, o]`, which one step of an exact field returns, has the
    smallest error; samples from the data's own distribution have up to twice that. So compare policies at one
    NFE, not one policy at several.

    Args:
        policy: the policy; its state does not change.
        windows: normalised windows ``[*B]`` for the policy's own prior, see :class:`~warmprior.ActionWindow`;
            use held-out ones for a fair error.
        nfes: network evaluations per chunk to measure at; those beyond the policy's maximum are skipped.

    Returns:
        The error by NFE, ascending and from the same source samples: the mean over windows, dimensions and
        the first ``H`` positions inside the episode, in squared normalised action units.

    Raises:
        KeyError: if the windows lack a key.
        ValueError: if the windows are invalid, or the policy allows none of the NFEs.
        FloatingPointError: if a prediction is NaN or infinite.

    Examples:
        >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior.diagnostics import SharedObservations, action_error
        >>> from warmprior.envs import navigation_demonstrations
        >>> untrained = WarmPriorActor(VelocityMLP(1, 9, 4, observation_steps=1), PastPrior(4))
        >>> windows = SharedObservations(navigation_demonstrations(), 4).windows(untrained.prior)
        >>> sorted(action_error(untrained, windows))
        [1, 9]
    """
    prior, allowed = policy.prior, allowed_nfes(policy, nfes)
    flat, target, rows, generator = inputs_and_targets(policy, windows)
    counted = flat["counted"][:, : prior.chunk_length, 0]
    errors = {}
    with evaluation_mode(policy):
        a0 = drawn(policy, rows, generator)
        for nfe in allowed:
            chunk = predict(policy, rows, a0, nfe)
            error = (chunk - target)[:, : prior.chunk_length].square()
            errors[nfe] = float(error[counted].mean())
    return errors
