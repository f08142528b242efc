"""How much of everything a comparison spends: presets from a quick look to the paper's recipe."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from warmprior.modules import ChiTransformer, VelocityMLP, VelocityNetwork
from warmprior.modules.prior import Prior
from warmprior.training.training_config import TrainingConfig

__all__ = ["PRESETS", "Preset"]

_NETWORKS: dict[str, type[VelocityNetwork]] = {
    "mlp": VelocityMLP,
    "chi_transformer": ChiTransformer,
}


@dataclass(frozen=True)
class Preset:
    """One budget.

    Attributes:
        summary: one line for ``--help``.
        demonstrations: scripted demonstrations to generate, per data style.
        training: the recipe.
        network: ``"mlp"`` or ``"chi_transformer"``.
        network_options: constructor options of the network.
        precondition: wrap the network in a :class:`~warmprior.PreconditionedNetwork`.
        trained_after: by prior, the iterations up to which success was measured to rise at this network and
            batch size. A table names the priors that are still short of it.
        seeds: number of training seeds.
        episodes: evaluation episodes per cell.
        top_k: checkpoints averaged per seed.
        envs: worker processes that train and play; ``None`` for one per core.
        observation_steps: ``To``.
    """

    summary: str
    demonstrations: dict[str, int]
    training: TrainingConfig
    network: str
    seeds: int
    episodes: int
    top_k: int
    envs: int | None = None
    observation_steps: int = 2
    network_options: dict[str, Any] = field(default_factory=dict)
    precondition: bool = True
    trained_after: dict[str, int] = field(default_factory=dict)

    def short_of_training(self, priors: Iterable[Prior]) -> list[str]:
        """Names of the priors whose success still rises with training at this budget.

        Args:
            priors: what is compared.
        """
        names = dict.fromkeys(prior.name for prior in priors)
        return [n for n in names if self.training.iterations < self.trained_after.get(n, 0)]

    def make_network(
        self, action_dim: int, observation_dim: int, prediction_length: int
    ) -> VelocityNetwork:
        """A network with fresh weights for the given widths."""
        return _NETWORKS[self.network](
            action_dim,
            observation_dim,
            prediction_length,
            self.observation_steps,
            **self.network_options,
        )


_SMALL_TRAINED_AFTER = {"preview": 40_000}
# Chosen from success against iterations on square (docs/evidence.md, "Training budget"). Half the batch at
# twice the iterations is as good.
_SMALL = TrainingConfig(
    iterations=10_000, batch_size=128, learning_rate=1e-3, warmup_ratio=0.1, checkpoints=1
)

PRESETS: dict[str, Preset] = {
    "quick": Preset(
        summary="one seed, small network: a first table within 15 minutes on two cores",
        demonstrations={"ph": 150, "mh": 150},
        training=_SMALL,
        network="mlp",
        network_options={"hidden_dim": 384},
        trained_after=_SMALL_TRAINED_AFTER,
        seeds=1,
        episodes=25,
        top_k=1,
    ),
    "cpu": Preset(
        summary="three seeds, twice the iterations: a table with seeds within two hours on two cores",
        demonstrations={"ph": 150, "mh": 300},
        training=_SMALL.with_iterations(20_000),
        network="mlp",
        network_options={"hidden_dim": 384},
        trained_after=_SMALL_TRAINED_AFTER,
        seeds=3,
        episodes=50,
        top_k=1,
    ),
    "paper": Preset(
        summary="the paper's recipe (Table 4): 20M parameters, 200k iterations, three seeds",
        demonstrations={"ph": 200, "mh": 300},
        training=TrainingConfig(),
        network="chi_transformer",
        precondition=False,
        seeds=3,
        episodes=200,
        top_k=3,
    ),
}
