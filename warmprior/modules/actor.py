"""The policy: prior sampler and ODE actor as one stateless TensorDict module."""

from __future__ import annotations

import json
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import nn

from warmprior import keys
from warmprior._files import load_file, save_file, write_atomic
from warmprior.modules.network import VelocityNetwork
from warmprior.modules.ode import ODEActor, Solver
from warmprior.modules.prior import Prior
from warmprior.modules.sampler import PriorSampler

if TYPE_CHECKING:
    from warmprior.transforms.normalize import Normalizer

__all__ = ["WarmPriorActor"]

FORMAT = 3
"""Version of the layout that :meth:`WarmPriorActor.save_pretrained` writes."""

_SAVED_KEYS = ("observation_key", "loc_key", "warm_key", "chunk_key")


class WarmPriorActor(TensorDictModuleBase):
    """Flow-matching policy with a choice of source: ``(observation, loc, warm) -> (noise, chunk)``.

    Composes :class:`PriorSampler` and :class:`ODEActor`. It holds no state between calls: the mean
    arrives under keys (written by :class:`~warmprior.ActionHistory` in an environment and by
    :class:`~warmprior.ActionWindow` in a replay buffer) and everything it predicts leaves under keys,
    so it works unchanged in ``env.rollout``, collectors, batched environments and replay buffers.

    Args:
        network: velocity network, see :class:`ODEActor`.
        prior: the source distribution.

    Keyword Args:
        nfe: network evaluations per chunk; per call: ``actor(data, nfe=1)``. 9 by default, or the
            prior's maximum (:attr:`Prior.max_nfe`).
        solver: see :func:`~warmprior.modules.ode.integrate`.
        clip: see :class:`ODEActor`.
        normalizer: the normaliser of the data, kept here so that it is saved with the policy; its
            :meth:`~warmprior.Normalizer.env_transforms` go next to the base environment.
        generator: source of randomness of the sampler.
        observation_key: key of the observation, ``[*B, To, d_o]``, or of several, nested under it.
        loc_key: key of the mean, ``[*B, P, d_a]``.
        warm_key: key of the warm mask, bool ``[*B, P, 1]``.
        chunk_key: key of the chunk, ``[*B, P, d_a]``.
        path_key: if given, the integration path is written there.

    Raises:
        ValueError: if the network was built for another prediction length than the prior's, or ``nfe``
            exceeds what the prior allows.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor
        >>> prior = PastPrior(chunk_length=8)
        >>> actor = WarmPriorActor(VelocityMLP(7, 23, prior.prediction_length), prior, nfe=1)
        >>> data = TensorDict({
        ...     "observation": torch.zeros(2, 23),  # [To, d_o]: one environment
        ...     "prior": {"loc": torch.zeros(8, 7), "warm": torch.zeros(8, 1, dtype=torch.bool)},
        ... }, [])
        >>> actor(data)["vla_action", "chunk"].shape
        torch.Size([8, 7])
    """

    def __init__(
        self,
        network: nn.Module,
        prior: Prior,
        *,
        nfe: int | None = None,
        solver: Solver = "euler",
        clip: float | None = None,
        normalizer: Normalizer | None = None,
        generator: torch.Generator | None = None,
        observation_key: NestedKey = keys.OBSERVATION,
        loc_key: NestedKey = keys.LOC,
        warm_key: NestedKey = keys.WARM,
        chunk_key: NestedKey = keys.CHUNK,
        path_key: NestedKey | None = None,
    ) -> None:
        super().__init__()
        built_for = getattr(network, "prediction_length", prior.prediction_length)
        if built_for != prior.prediction_length:
            raise ValueError(
                f"the network was built for prediction_length={built_for}, but {prior} needs "
                f"{prior.prediction_length}"
            )
        self.sampler = PriorSampler(prior, loc_key=loc_key, warm_key=warm_key, generator=generator)
        self.ode = ODEActor(
            network,
            prior=prior,
            nfe=nfe,
            solver=solver,
            clip=clip,
            loc_key=loc_key,
            warm_key=warm_key,
            observation_key=observation_key,
            chunk_key=chunk_key,
            path_key=path_key,
        )
        self.normalizer = normalizer
        self.in_keys = [observation_key, *self.sampler.in_keys]
        self.out_keys = [*self.sampler.out_keys, *self.ode.out_keys]

    @property
    def prior(self) -> Prior:
        """The source distribution."""
        return self.sampler.prior

    @property
    def chunk_key(self) -> NestedKey:
        """Key of the chunk."""
        return self.ode.out_keys[0]

    @property
    def network(self) -> nn.Module:
        """The velocity network."""
        return self.ode.network

    def forward(self, tensordict: TensorDictBase, nfe: int | None = None) -> TensorDictBase:
        """Sample the source and integrate it to the chunk."""
        return self.ode(self.sampler(tensordict), nfe=nfe)

    def save_pretrained(self, directory: str | Path) -> None:
        """Write ``config.json`` and ``model.safetensors``.

        Args:
            directory: created if needed.

        Raises:
            OSError: if the folder cannot be written to.
            TypeError: if the network is not a :class:`VelocityNetwork` (its configuration is needed).
        """
        if not isinstance(self.network, VelocityNetwork):
            raise TypeError(
                f"cannot save {type(self.network).__name__}: only VelocityNetwork subclasses carry the "
                "configuration that from_pretrained needs"
            )
        config = {
            "format": FORMAT,
            "warmprior": version("warmprior"),
            "prior": self.prior.config(),
            "network": self.network.config(),
            "actor": {
                "nfe": self.ode.nfe,
                "solver": self.ode.solver,
                "clip": self.ode.clip,
                **dict(zip(_SAVED_KEYS, (*self.in_keys, self.chunk_key), strict=True)),
            },
            "normalizer": None if self.normalizer is None else self.normalizer.config(),
        }
        directory = Path(directory)
        text = json.dumps(config, indent=2) + "\n"
        tensors = {name: value.contiguous() for name, value in self.state_dict().items()}
        write_atomic(directory / "model.safetensors", lambda path: save_file(tensors, path))
        write_atomic(directory / "config.json", lambda path: path.write_text(text))

    @classmethod
    def from_pretrained(
        cls,
        directory: str | Path,
        *,
        prior: Prior | None = None,
        device: torch.device | str = "cpu",
        generator: torch.Generator | None = None,
    ) -> WarmPriorActor:
        """Load a policy that :meth:`save_pretrained` wrote; it returns bit-identical chunks.

        Args:
            directory: where ``config.json`` and ``model.safetensors`` lie.

        Keyword Args:
            prior: the prior that the environment carries, if any: it must be the policy's own.
            device: where to put the weights.
            generator: source of randomness of the sampler.

        Raises:
            FileNotFoundError: if a file is missing.
            ValueError: if the files are damaged, of another format version, do not fit each other, or
                belong to a policy with another prior.
        """
        from warmprior.transforms.normalize import Normalizer

        directory = Path(directory)
        config = _read_config(directory / "config.json")
        if prior is not None and prior.config() != config["prior"]:
            raise ValueError(
                f"the policy at {directory} was trained with {Prior.from_config(config['prior'])}, not "
                f"with {prior}"
            )
        try:
            options: dict[str, Any] = dict(config["actor"])
            for name in _SAVED_KEYS:
                if isinstance(options.get(name), list):  # JSON's form of a nested key
                    options[name] = tuple(options[name])
            normalizer = config["normalizer"]
            actor = cls(
                VelocityNetwork.from_config(config["network"]),
                Prior.from_config(config["prior"]),
                normalizer=None if normalizer is None else Normalizer.from_config(normalizer),
                generator=generator,
                **options,
            )
        except (AttributeError, KeyError, TypeError) as error:
            raise ValueError(
                f"{directory / 'config.json'} is damaged or of another version: {error!r}"
            ) from error
        weights = directory / "model.safetensors"
        if not weights.exists():
            raise FileNotFoundError(f"no policy weights at {weights}")
        try:
            actor.load_state_dict(load_file(weights))
        except Exception as error:
            raise ValueError(
                f"{weights} does not fit {directory / 'config.json'}: it is damaged or belongs to "
                f"another network ({error})"
            ) from error
        return actor.to(device).eval()


def _read_config(path: Path) -> dict[str, Any]:
    if not path.exists():
        raise FileNotFoundError(f"no policy at {path.parent}: {path.name} is missing")
    try:
        config = json.loads(path.read_text())
    except json.JSONDecodeError as error:
        raise ValueError(f"{path} is not valid JSON: {error}") from error
    found = config.get("format") if isinstance(config, dict) else None
    if found != FORMAT:
        raise ValueError(
            f"{path} has format {found}, this version of warmprior reads {FORMAT}: "
            "save the policy again with a matching version"
        )
    missing = [part for part in ("prior", "network", "actor", "normalizer") if part not in config]
    if missing:
        raise ValueError(f"{path} is incomplete: it lacks {', '.join(missing)}")
    return config
