"""The one-dimensional navigation toy task: two obstacles, six demonstrations, two modes (Sec. 5.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from warmprior import keys
from warmprior.checks import check_between, check_finite_steps, check_shape, check_whole_numbers

STEPS = 64
OBSTACLES = (-0.45, 0.45)
HALF_WIDTH, HALF_HEIGHT = 0.12, 0.45
SCALES = (0.85, 1.0, 1.15)
OCTAVES = 4
"""The octaves of sines and cosines added to the position: without them small networks underfit."""
UNDECIDED = 0.05
"""The distance from the axis within which heights are on neither side (demonstrations keep 0.17)."""


def navigation_positions() -> Tensor:
    """Return the horizontal positions of the 64 steps, ``[64]``, from -1 to 1.

    Examples:
        >>> from warmprior.envs import navigation_positions
        >>> navigation_positions()[[0, -1]].tolist()
        [-1.0, 1.0]
    """
    return torch.linspace(-1.0, 1.0, STEPS)


def navigation_heights() -> Tensor:
    """Return the heights of the six demonstrations, ``[6, 64]``: three above both obstacles, three below.

    A demonstration is a scaled profile with a bump over each obstacle; the two sides come closest (0.35
    apart) at the start, between the obstacles, and at the end.

    Examples:
        >>> from warmprior.envs import navigation_heights
        >>> heights = navigation_heights()
        >>> bool((heights[:3] == -heights[3:]).all()), round(float(2 * heights[0].min()), 2)
        (True, 0.35)
    """
    x = navigation_positions()
    bumps = sum(torch.exp(-(((x - c) / 0.25) ** 2)) for c in OBSTACLES)
    profile = 0.2 + 0.6 * torch.as_tensor(bumps)
    return torch.stack([s * side * profile for side in (1.0, -1.0) for s in SCALES])


def _middles() -> list[int]:
    """Return the steps at the middles of the obstacles."""
    return [int((navigation_positions() - c).abs().argmin()) for c in OBSTACLES]


def _features(x: Tensor, octaves: int) -> Tensor:
    angle = x.unsqueeze(-1) * math.pi * 2.0 ** torch.arange(-1, octaves - 1, device=x.device)
    return torch.cat([x.unsqueeze(-1), angle.sin(), angle.cos()], dim=-1)


def navigation_demonstrations(octaves: int = OCTAVES) -> TensorDict:
    """Return the six demonstrations as contiguous steps ``[384]`` for :class:`~warmprior.ActionWindow`.

    ``"observation"`` ``[384, 1 + 2 * octaves]`` is the position with its sines and cosines, ``"action"``
    ``[384, 1]`` the height, in [-1, 1] without normalisation, and ``"episode"`` ``[384]`` the demonstration.

    Examples:
        >>> from warmprior.envs import navigation_demonstrations
        >>> navigation_demonstrations()["observation"].shape
        torch.Size([384, 9])
    """
    check_whole_numbers(0, octaves=octaves)
    heights = navigation_heights()
    count = len(heights)
    return TensorDict(
        {
            keys.OBSERVATION: _features(navigation_positions(), octaves).repeat(count, 1),
            keys.ACTION: heights.reshape(-1, 1),
            keys.EPISODE: torch.arange(count).repeat_interleave(STEPS),
        },
        batch_size=[count * STEPS],
    )


def navigation_collides(x: Tensor, y: Tensor) -> Tensor:
    """Return a mask of segments between consecutive points that enter an obstacle, bool ``[*B, T - 1]``.

    The points are at positions ``[*B, T]``, increasing, and heights ``[*B, T]``.
    """
    x0, x1, y0, y1 = x[..., :-1], x[..., 1:], y[..., :-1], y[..., 1:]
    hit = torch.zeros_like(y0, dtype=torch.bool)
    for c in OBSTACLES:
        # The part of the segment within the obstacle's width, as shares of its length.
        enter = ((c - HALF_WIDTH - x0) / (x1 - x0)).clamp(0, 1)
        leave = ((c + HALF_WIDTH - x0) / (x1 - x0)).clamp(0, 1)
        low, high = y0 + enter * (y1 - y0), y0 + leave * (y1 - y0)
        inside = (low.abs() < HALF_HEIGHT) | (high.abs() < HALF_HEIGHT) | (low * high < 0)
        hit |= (leave > enter) & inside
    return hit


class NavigationEnv(EnvBase):
    """An environment whose agent moves right at constant speed and chooses its height at every step.

    There are no dynamics: the action *is* the height, the position advances by itself, and an episode lasts
    64 steps. The environment holds no state; it reads everything from the tensordict.

    =================  ===================  ===============================================
    key                shape                meaning
    =================  ===================  ===============================================
    ``"observation"``  ``[*B, d_o]`` float  position in [-1, 1], its sines and cosines
    ``"action"``       ``[*B, 1]`` float    height, in units of the normalised action space
    ``"reward"``       ``[*B, 1]`` float    1 at the end of an episode that succeeds
    ``"step_index"``   ``[*B, 1]`` int64    steps done, 0 to 64
    ``"height"``       ``[*B, 1]`` float    the last action
    ``"collided"``     ``[*B, 1]`` bool     True if the path entered an obstacle
    ``"success"``      ``[*B, 1]`` bool     True if it ended without collision, on the route
    =================  ===================  ===============================================

    With a route it is a small task with a sparse reward: an episode ends at the first collision, and at the
    first obstacle passed on the wrong side, with reward 0. The demonstrations are independent of the route,
    so a policy cloned from them succeeds in a share of the episodes, and reinforcement learning can improve
    it.

    Args:
        route: for each of the two obstacles ``1`` (pass above) or ``-1`` (below); any side by default.
        octaves: octaves of sines and cosines added to the position, ``d_o = 1 + 2 * octaves``; the paper has
            none.
        batch_size: ``*B``, independent agents.
        device: device of all tensors.

    Raises:
        ValueError: if the route is not two of these numbers, or ``octaves`` is not a whole number >= 0.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from warmprior import GaussianPrior, VelocityMLP, WarmPriorActor, policy_transforms
        >>> from warmprior.envs import NavigationEnv
        >>> actor = WarmPriorActor(VelocityMLP(1, 9, 4, observation_steps=1), GaussianPrior(4))
        >>> env = TransformedEnv(NavigationEnv(batch_size=[32]), policy_transforms(actor))
        >>> env.rollout(100, actor).shape  # 64 steps are 16 decisions
        torch.Size([32, 16])
    """

    strided_seeds = True
    """True, since every seed starts the same episode, and so any row can play any seed."""

    def __init__(
        self,
        route: Sequence[int] | None = None,
        *,
        octaves: int = OCTAVES,
        batch_size: tuple[int, ...] | list[int] | torch.Size = (),
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__(device=device, batch_size=torch.Size(batch_size))
        check_whole_numbers(0, octaves=octaves)
        self.octaves = octaves
        if route is not None and (len(route) != len(OBSTACLES) or any(side not in (1, -1) for side in route)):
            raise ValueError(f"a route is {len(OBSTACLES)} numbers 1 or -1, got {tuple(route)}")
        self.route = None if route is None else dict(zip(_middles(), route, strict=True))
        shape = (*self.batch_size, 1)

        flag = Categorical(2, shape=shape, dtype=torch.bool, device=device)
        carried = {
            "step_index": Unbounded(shape, dtype=torch.int64, device=device),
            "height": Unbounded(shape, device=device),
            "collided": flag,
        }
        self.state_spec = Composite(carried, shape=self.batch_size).clone()
        position = Bounded(-1, 1, (*self.batch_size, 1 + 2 * octaves), device=device)
        entries = {keys.OBSERVATION: position, "success": flag, **carried}
        self.observation_spec = Composite(entries, shape=self.batch_size).clone()
        # Unbounded, because a policy that leaves the corridor of the demonstrations is a valid result.
        self.action_spec = Unbounded(shape, device=device)
        self.reward_spec = Unbounded(shape, device=device)

    def _at(self, step: Tensor) -> Tensor:
        """Return the position of a step; steps after the end have the last one's."""
        return -1.0 + 2.0 / (STEPS - 1) * step.clamp(max=STEPS - 1)

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: object) -> TensorDictBase:
        zero = torch.zeros(*self.batch_size, 1, device=self.device)
        return self._tell(zero.long(), zero, zero.bool(), zero.bool(), zero.bool())

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        step, height = tensordict["step_index"], tensordict[keys.ACTION]
        here = self._at(step)
        # Before the first action there is no segment; the start is far from the obstacles.
        before = torch.where(step > 0, tensordict["height"], height)
        x = torch.cat([here - 2.0 / (STEPS - 1), here], dim=-1)
        collided = tensordict["collided"] | navigation_collides(x, torch.cat([before, height], dim=-1))
        done, failed = step + 1 >= STEPS, collided
        if self.route is not None:
            for middle, side in self.route.items():
                failed = failed | (step == middle) & (height * side <= 0)
            done = done | failed
        success = done & ~failed
        result = self._tell(step + 1, height.clone(), collided, success, done)
        return result.set("reward", success.to(height.dtype))

    def _tell(
        self, step: Tensor, height: Tensor, collided: Tensor, success: Tensor, done: Tensor
    ) -> TensorDict:
        return TensorDict(
            {
                keys.OBSERVATION: _features(self._at(step).squeeze(-1), self.octaves),
                "success": success,
                "step_index": step,
                "height": height,
                "collided": collided,
                "done": done,
                "terminated": done.clone(),
            },
            batch_size=self.batch_size,
            device=self.device,
        )

    def _set_seed(self, seed: int | None) -> None:
        """Do nothing, because nothing in the environment is random."""


@dataclass(frozen=True)
class NavigationMetrics:
    """The statistics of a set of rollouts.

    Attributes:
        switch_rate: share of chunk boundaries at which the side changes, among those with a side before and
            after; NaN if there is none.
        commit_rate: share of rollouts that are never on both sides.
        collision_rate: share of rollouts that enter an obstacle.
        route_entropy: entropy in bits of the four routes (above or below each obstacle): 1 if only the two
            demonstrated ones occur equally often, 2 if all four do.
        recombination_rate: share of rollouts on the two routes that were not demonstrated.
        distance: mean distance to the nearest demonstration's height.
        jump: mean change of height at chunk boundaries.

    Examples:
        >>> import torch
        >>> from warmprior.envs import navigation_metrics
        >>> through = navigation_metrics(torch.zeros(2, 64), chunk_length=4)  # neither above nor below
        >>> through.collision_rate, through.commit_rate, through.jump, through.switch_rate
        (1.0, 1.0, 0.0, nan)
    """

    switch_rate: float
    commit_rate: float
    collision_rate: float
    route_entropy: float
    recombination_rate: float
    distance: float
    jump: float


def navigation_metrics(heights: Tensor, chunk_length: int) -> NavigationMetrics:
    """Compute the statistics of executed heights ``[n, 64]``, with ``chunk_length`` steps per decision.

    Raises:
        ValueError: if the heights have another shape, are not finite, or a chunk spans the whole episode.

    Examples:
        >>> from warmprior.envs import navigation_heights, navigation_metrics
        >>> metrics = navigation_metrics(navigation_heights(), chunk_length=4)
        >>> metrics.switch_rate, metrics.collision_rate, metrics.route_entropy, metrics.distance
        (0.0, 0.0, 1.0, 0.0)
    """
    check_shape("heights", heights, (max(1, heights.numel() // STEPS), STEPS))
    check_finite_steps("heights", heights)
    check_between(1, STEPS - 1, chunk_length=chunk_length)
    x, demonstrations = navigation_positions().to(heights.device), navigation_heights()
    side = torch.where(heights.abs() > UNDECIDED, heights.sign(), 0.0)
    boundary = torch.arange(chunk_length - 1, STEPS - 1, chunk_length)
    both = side[:, boundary] * side[:, boundary + 1]
    above = (heights[:, _middles()] > 0).long()
    routes = torch.bincount(2 * above[:, 0] + above[:, 1], minlength=4).double() / len(heights)
    taken = routes[routes > 0]
    hit = navigation_collides(x.expand_as(heights), heights).any(1)
    gap = (heights[:, None] - demonstrations.to(heights.device)).abs().amin(1)
    return NavigationMetrics(
        switch_rate=float((both < 0).sum() / (both != 0).sum()) if both.any() else math.nan,
        commit_rate=float((~((side > 0).any(1) & (side < 0).any(1))).double().mean()),
        collision_rate=float(hit.double().mean()),
        route_entropy=abs(float((taken * taken.log2()).sum())),
        recombination_rate=float(routes[1] + routes[2]),
        distance=float(gap.mean()),
        jump=float(heights.diff(dim=1)[:, boundary].abs().mean()),
    )
