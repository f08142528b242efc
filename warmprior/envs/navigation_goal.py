"""The navigation toy with a goal: one route of four, and a reward for it alone."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase

from warmprior import keys
from warmprior.envs.navigation1d import OBSTACLES, NavigationEnv, navigation_positions

__all__ = ["GoalNavigationEnv"]


class GoalNavigationEnv(NavigationEnv):
    """:class:`NavigationEnv` that is solved on one route only: a small task with a sparse reward.

    The demonstrations know the goal as little as a policy cloned from them does, so that such a policy
    succeeds on a share of the episodes and reinforcement learning has something to find. An episode ends
    at the first collision and at the first obstacle passed on the wrong side, with reward 0; at the end
    of the route the reward is 1.

    Args:
        route: for each of the two obstacles ``1`` (pass above) or ``-1`` (below).

    Keyword Args:
        batch_size: ``*B``, independent agents.
        device: of all tensors.

    Raises:
        ValueError: if the route is not two of these numbers.

    Examples:
        >>> import torch
        >>> from warmprior.envs import GoalNavigationEnv
        >>> env = GoalNavigationEnv((1, -1), batch_size=[2])
        >>> below = torch.full((2, 64, 1), -0.6)
        >>> data = env.reset()
        >>> for step in range(64):
        ...     data = env.step(data.set("action", below[:, step]))["next"]
        ...     if data["done"].any():
        ...         break
        >>> step, bool(data["success"].any())  # below the first obstacle, in its middle
        (17, False)
    """

    def __init__(
        self,
        route: Sequence[int] = (1, 1),
        *,
        batch_size: tuple[int, ...] | list[int] | torch.Size = (),
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__(batch_size=batch_size, device=device)
        if len(route) != len(OBSTACLES) or any(side not in (1, -1) for side in route):
            raise ValueError(f"a route is {len(OBSTACLES)} numbers 1 or -1, got {tuple(route)}")
        x = navigation_positions()
        self.route = {int((x - c).abs().argmin()): s for c, s in zip(OBSTACLES, route, strict=True)}

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        out = super()._step(tensordict)
        here, height = tensordict["step_index"], tensordict[keys.ACTION]
        failed = out["collided"].clone()
        for step, side in self.route.items():
            failed |= (here == step) & (height * side <= 0)
        success = out["success"] & ~failed
        done = out["done"] | failed
        return out.update(
            {"success": success, "reward": success.to(height.dtype), "done": done, "terminated": done.clone()}
        )
