"""SB-CFM: pairs from a Schroedinger bridge, and the noisy path between them."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import torch
from torch import Tensor

from warmprior import LinearInterpolant, OTCoupling
from warmprior.checks import check_positive
from warmprior.modules.interpolant import Interpolant


class BridgeInterpolant(Interpolant):
    r"""Brownian bridge: the straight line with noise between its ends (Tong et al., 2024, Sec. 3.4).

    .. math::
        a_t = (1 - t) a_0 + t a_1 + \sigma \sqrt{t (1 - t)} \, \varepsilon, \qquad
        u_t = a_1 - a_0 + \sigma \frac{1 - 2t}{2 \sqrt{t (1 - t)}} \, \varepsilon .

    On pairs from :class:`BridgeCoupling` the mean of :math:`u_t` given :math:`a_t` is the
    probability flow of the Schroedinger bridge. The velocity grows without bound towards the ends: times are
    kept 0.001 away from them.

    Args:
        sigma: standard deviation of the noise, > 0, in normalised action units.

    Raises:
        ValueError: if ``sigma`` is not a finite number > 0.

    Examples:
        >>> import torch
        >>> from lab.methods.bridge import BridgeInterpolant
        >>> a0, a1, t = torch.zeros(1, 1, 1), torch.ones(1, 1, 1), torch.tensor([0.5])
        >>> a_t, velocity = BridgeInterpolant(0.2)(a0, a1, t, torch.Generator().manual_seed(0))
        >>> bool(a_t != 0.5), velocity.item()
        (True, 1.0)
    """

    name = "bridge"

    def __init__(self, sigma: float) -> None:
        check_positive(sigma=sigma)
        self.sigma = float(sigma)

    coefficients = LinearInterpolant.coefficients

    def __call__(
        self, a0: Tensor, a1: Tensor, t: Tensor, generator: torch.Generator | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return the point on the path and its velocity, with noise from ``generator``."""
        point, velocity = super().__call__(a0, a1, t)
        t = t[..., None, None].clamp(1e-3, 1 - 1e-3)
        width = (t * (1 - t)).sqrt()
        noise = torch.randn(point.shape, generator=generator, dtype=point.dtype, device=point.device)
        noise = self.sigma * noise
        return point + width * noise, velocity + (1 - 2 * t) / (2 * width) * noise


class BridgeCoupling(OTCoupling):
    r"""SB-CFM: source and data are paired as in the Schroedinger bridge of Brownian motion.

    Every target draws its source sample from the entropic plan of the batch,

    .. math::
        \pi_{ij} \propto u_i v_j \exp\left(- c_{ij} / 2 \sigma^2\right), \qquad
        c_{ij} = \|a_0^i - a_1^j\|^2 + w \|o^i - o^j\|^2,

    with uniform marginals (Tong et al., 2024, Prop. 3.4), and the path between them is a Brownian bridge,
    :class:`BridgeInterpolant`, which the loss takes from here. For small ``sigma`` this is
    :class:`~warmprior.OTCoupling`; for large ``sigma`` pairs are independent.

    Args:
        sigma: standard deviation of the Brownian motion at ``t = 1``, > 0, in normalised action units.
        observation_weight: ``w``, see :class:`~warmprior.OTCoupling`.

    Raises:
        ValueError: as :class:`~warmprior.OTCoupling`, or if ``sigma`` is not a finite number > 0.

    Examples:
        >>> import torch
        >>> from lab.methods.bridge import BridgeCoupling
        >>> a0, a1 = torch.tensor([[[0.0]], [[1.0]]]), torch.tensor([[[5.0]], [[4.0]]])
        >>> [x.flatten().tolist() for x in BridgeCoupling(sigma=0.1, observation_weight=0.0)(a0, a1)]
        [[1.0, 0.0], [5.0, 4.0]]
    """

    ROUNDS: ClassVar[int] = 5  # Sinkhorn iterations at each noise level, five times as many at the last

    def __init__(self, sigma: float, observation_weight: float = 10.0) -> None:
        super().__init__(observation_weight)
        self.interpolant = BridgeInterpolant(sigma)

    def config(self) -> dict[str, Any]:
        """Return the options that the pairs depend on."""
        return {**super().config(), "name": "bridge", "sigma": self.interpolant.sigma}

    def assigned(self, cost: Tensor) -> Tensor:
        """Draw pairs from the plan by PyTorch's global generator, which a training seeds."""
        # The noise is halved step by step, because the iteration hardly moves at a small noise alone.
        noise = 2 * self.interpolant.sigma**2
        halvings = math.ceil(math.log2(max(1.0, float(cost.max()) / noise)))
        row = cost.new_zeros(len(cost), 1)
        for k in range(halvings, -1, -1):
            now = noise * 2**k
            # The first round at a noise takes logarithms, which cannot underflow; the others are products.
            column = -now * ((row - cost) / now).logsumexp(0, keepdim=True)
            row = -now * ((column - cost) / now).logsumexp(1, keepdim=True)
            plan = ((row + column - cost) / now).exp()
            u = torch.ones_like(row)
            for _ in range((self.ROUNDS if k else 5 * self.ROUNDS) - 1):
                v = 1 / (u.mT @ plan)
                u = 1 / (plan @ v.mT)
            column, row = column + now * v.log(), row + now * u.log()
        return torch.multinomial(((column - cost) / noise).softmax(1), 1).squeeze(1)
