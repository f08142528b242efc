"""The policy: prior sampler and ODE actor as one stateless TensorDict module."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from warmprior import keys
from warmprior.io.files import (
    as_json,
    check_regular,
    load_file,
    save_file,
    tensor_shapes,
    write_atomic,
)
from warmprior.modules.blueprint import BlueprintError, blueprint
from warmprior.modules.compiled import uncompiled, without_compilation
from warmprior.modules.network import VelocityNetwork
from warmprior.modules.normalize import Normalizer
from warmprior.modules.ode import DEFAULT_NFE, ODEActor, Solver
from warmprior.modules.pretrained import (
    CONFIG,
    FORMAT,
    WEIGHTS,
    pretrained_digest,
    pretrained_folder,
    push,
    read_config,
)
from warmprior.modules.prior import Prior
from warmprior.modules.real_time_chunking import RealTimeChunking
from warmprior.modules.sampler import PriorSampler

__all__ = ["WarmPriorActor"]

_PRECISIONS = {name: getattr(torch, name) for name in ("float16", "bfloat16", "float32", "float64")}

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
        nfe: network evaluations per chunk; per call: ``actor(data, nfe=1)``. 9 by default, or 1 where the
            prior's field is no flow (:attr:`Prior.is_flow`).
        solver: see :func:`~warmprior.modules.ode.integrate`.
        grid: likewise.
        clip: see :class:`ODEActor`.
        guidance: leads to chunks that continue the one being executed; it knows the source's standard
            deviation position by position. None by default.
        normalizer: the normaliser of the data, kept here so that it is saved with the policy; its
            :meth:`~warmprior.Normalizer.env_transforms` go next to the base environment.
        environment: description of the environment that the policy was made for, as JSON holds it; kept
            here so that it is saved with the policy (``python -m warmprior evaluate FOLDER``).
        generator: source of randomness of the sampler; per call: ``actor(data, generator=...)``.
        observation_key: key of the observation, ``[*B, To, d_o]``, or of several, nested under it.
            ``"observation"`` by default, or what :class:`~warmprior.MeanObservation` makes of it
            (:attr:`Prior.conditions_network`).
        loc_key: key of the mean, ``[*B, P, d_a]``.
        warm_key: key of the warm mask, bool ``[*B, P, 1]``.
        chunk_key: key of the chunk, ``[*B, P, d_a]``.
        path_key: if given, the integration path is written there.

    Raises:
        ValueError: if the network was built for another prediction length than the prior's, ``nfe``
            exceeds what the prior allows, there is no such grid, or the guidance is of what is no flow.

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
        grid: str = "uniform",
        clip: float | Sequence[float] | None = None,
        guidance: RealTimeChunking | None = None,
        normalizer: Normalizer | None = None,
        environment: Mapping[str, Any] | None = None,
        generator: torch.Generator | None = None,
        observation_key: NestedKey | None = None,
        loc_key: NestedKey = keys.LOC,
        warm_key: NestedKey = keys.WARM,
        chunk_key: NestedKey = keys.CHUNK,
        path_key: NestedKey | None = None,
    ) -> None:
        super().__init__()
        if observation_key is None:
            observation_key = _following(prior)["observation_key"]
        built_for = getattr(network, "prediction_length", prior.prediction_length)
        if built_for != prior.prediction_length:
            raise ValueError(
                f"the network was built for prediction_length={built_for}, but {prior} needs "
                f"{prior.prediction_length}"
            )
        self.sampler = PriorSampler(
            prior,
            observation_key=observation_key,
            loc_key=loc_key,
            warm_key=warm_key,
            generator=generator,
        )
        self.ode = ODEActor(
            network,
            nfe=nfe,
            max_nfe=None if prior.is_flow else 1,
            start_time=prior.start_time,
            solver=solver,
            grid=grid,
            clip=clip,
            guidance=guidance,
            observation_key=observation_key,
            chunk_key=chunk_key,
            path_key=path_key,
        )
        self.normalizer = normalizer
        self.environment = environment
        self.in_keys = [observation_key, *self.sampler.in_keys, *self.ode.in_keys[2:]]
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

    def forward(
        self,
        tensordict: TensorDictBase,
        nfe: int | None = None,
        generator: torch.Generator | None = None,
    ) -> TensorDictBase:
        """Sample the source and integrate it to the chunk."""
        return self.integrate(self.sampler(tensordict, generator=generator), nfe=nfe)

    def integrate(self, tensordict: TensorDictBase, nfe: int | None = None) -> TensorDictBase:
        """Integrate a source that was drawn before to the chunk, guided where the policy is.

        Args:
            tensordict: with the input keys and the source, ``[*B, P, d_a]``, under ``ode.in_keys[0]``.
            nfe: network evaluations of this call; the policy's own by default.
        """
        return self.ode(tensordict, nfe=nfe, sigma=self._sigma(tensordict))

    def _sigma(self, tensordict: TensorDictBase) -> Tensor | None:
        """Standard deviation of the source, broadcastable to ``[*B, P, d_a]``, where guidance asks for it."""
        if self.ode.guidance is None:
            return None
        observation, loc, warm = (tensordict.get(key) for key in self.in_keys[:3])
        return self.prior.distribution(loc, warm, observation)[1]

    def replace(self, **changes: Any) -> WarmPriorActor:
        """A policy of the same parts and options, but for those given.

        Args:
            changes: constructor arguments, such as ``nfe`` and ``generator`` where a policy is handed to
                what calls it, or another ``network``. With another ``prior``, an ``nfe`` and
                ``observation_key`` that are the defaults for this one become those for the other.

        Examples:
            >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor
            >>> actor = WarmPriorActor(VelocityMLP(2, 3, 4), PastPrior(4))
            >>> one_step = actor.replace(nfe=1)
            >>> actor.ode.nfe, one_step.ode.nfe, one_step.network is actor.network
            (9, 1, True)
        """
        mine = {
            "network": self.network,
            "prior": self.prior,
            "nfe": self.ode.nfe,
            "solver": self.ode.solver,
            "grid": self.ode.grid,
            "clip": self.ode.clip,
            "guidance": self.ode.guidance,
            "normalizer": self.normalizer,
            "environment": self.environment,
            "generator": self.sampler.generator,
            **self._keys(),
            "path_key": self.ode.path_key,
        }
        if "prior" in changes:
            mine = {k: v for k, v in mine.items() if v != _following(self.prior).get(k, ...)}
        return type(self)(**(mine | changes))

    def _keys(self) -> dict[str, NestedKey]:
        """The constructor's keys."""
        return dict(zip(_SAVED_KEYS, (*self.in_keys[:3], self.chunk_key), strict=True))

    def config(self) -> dict[str, Any]:
        """JSON-serialisable description of everything but the weights.

        Raises:
            TypeError: if the network is not a :class:`VelocityNetwork`, or an option of the network, the
                prior or the normaliser cannot be written as JSON.
        """
        network = uncompiled(self.network)
        if not isinstance(network, VelocityNetwork):
            raise TypeError(
                f"cannot save {type(network).__name__}: only VelocityNetwork subclasses carry the "
                "configuration that from_pretrained needs"
            )
        guidance = self.ode.guidance
        config = {
            "format": FORMAT,
            "warmprior": version("warmprior"),
            "prior": self.prior.config(),
            "network": network.config(),
            "actor": {
                "nfe": self.ode.nfe,
                "solver": self.ode.solver,
                "grid": self.ode.grid,
                "clip": self.ode.clip,
                # Policies saved before there was guidance have none.
                **({} if guidance is None else {"guidance": guidance.config()}),
                **self._keys(),
            },
            "normalizer": None if self.normalizer is None else self.normalizer.config(),
            "environment": self.environment,
            "precision": self._precision(),
        }
        try:
            return as_json(config)
        except TypeError as error:
            raise TypeError(
                f"cannot save {self.prior}, {type(network).__name__} and the normaliser: {error}. Use plain "
                "numbers and text for options, and plain names for the normaliser's keys."
            ) from error

    def _parts(self) -> dict[str, nn.Module]:
        """What has weights, under the names of the configuration."""
        parts = {"network": self.network, "prior": self.prior, "normalizer": self.normalizer}
        return {name: part for name, part in parts.items() if isinstance(part, nn.Module)}

    def _precision(self) -> dict[str, str]:
        """Names of the parts' precisions. Each its own: half precision is too coarse for statistics."""
        found = {name: _dtype(part) for name, part in self._parts().items()}
        return {name: str(dtype).removeprefix("torch.") for name, dtype in found.items() if dtype}

    def check_saveable(self) -> None:
        """Whether :meth:`from_pretrained` could load what :meth:`save_pretrained` would write.

        For before a training: its policies would be lost otherwise.

        Raises:
            TypeError: if there is no :meth:`config`.
            ValueError: if a policy built from it has other tensors than this one.
        """
        self._saveable()

    def _saveable(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """The configuration and the tensors, after checking that they belong together."""
        config = self.config()
        tensors = without_compilation(self.state_dict())
        mine = {name: value.shape for name, value in tensors.items()}
        try:
            built = self._blueprint(config, mine)
            if built is None:
                with torch.random.fork_rng([]):  # as if nothing had been built
                    built = self._from_config(config).state_dict()
            problem = _difference(built, tensors)
        except Exception as error:
            problem = repr(error)
        if problem:
            raise ValueError(
                f"a saved {type(self.network).__name__} could not be loaded again: {problem}. Its "
                "constructor has to build, from the options in its config(), what is to be saved."
            )
        return config, tensors

    def save_pretrained(self, directory: str | Path) -> None:
        """Write ``config.json`` and ``model.safetensors``.

        Network, prior and normaliser each keep their precision (``torch.float16``, ``bfloat16``,
        ``float32`` or ``float64``). The configuration holds a digest of both files, by which
        :meth:`from_pretrained` notices any change.

        Args:
            directory: created if needed.

        Raises:
            OSError: if the folder cannot be written to.
            TypeError: if the network is not a :class:`VelocityNetwork` (its configuration is needed).
            ValueError: if the policy could not be loaded again, see :meth:`check_saveable`.
        """
        config, tensors = self._saveable()
        directory = Path(directory)
        weights = directory / WEIGHTS
        write_atomic(weights, lambda path: save_file(tensors, path))
        text = json.dumps(config | {"sha256": pretrained_digest(config, weights)}, indent=2) + "\n"
        write_atomic(directory / CONFIG, lambda path: path.write_text(text))

    def push_to_hub(
        self,
        repository: str,
        *,
        card: str | None = None,
        private: bool | None = None,
        revision: str | None = None,
        message: str = "Upload a policy of warmprior",
        token: str | None = None,
        endpoint: str | None = None,
    ) -> str:
        """Save the policy in a repository of the Hugging Face hub, which is made if needed.

        Args:
            repository: such as ``"user/name"``.

        Keyword Args:
            card: text of its ``README.md``, such as :func:`~warmprior.experiments.model_card` writes; by
                default what is there stays.
            private: whether a new repository is private; by default what the account has set.
            revision: branch; the main one by default.
            message: of the commit.
            token: with which to write; by default the hub client's own.
            endpoint: address of the hub or of a server like it; by default the hub client's own.

        Returns:
            The commit, as ``revision`` of :meth:`from_pretrained` takes it.

        Raises:
            TypeError: see :meth:`save_pretrained`.
            ValueError: likewise; if the name is no ``"user/name"``; or if it is to be private, and there is a
                public repository of that name.
            OSError: if the hub does not take it: a ``PermissionError`` without a token that may write.
            ImportError: if huggingface_hub is not installed.

        Examples:
            >>> actor.push_to_hub("user/square-past", card=model_card(actor))  # doctest: +SKIP
            '0123456789abcdef0123456789abcdef01234567'
        """
        return push(
            self.save_pretrained,
            repository,
            card=card,
            private=private,
            revision=revision,
            message=message,
            token=token,
            endpoint=endpoint,
        )

    @classmethod
    def from_pretrained(
        cls,
        directory: str | Path,
        *,
        prior: Prior | None = None,
        device: torch.device | str = "cpu",
        generator: torch.Generator | None = None,
        revision: str | None = None,
        token: str | None = None,
        endpoint: str | None = None,
    ) -> WarmPriorActor:
        """Load a policy that :meth:`save_pretrained` or :meth:`push_to_hub` wrote.

        It returns bit-identical chunks. Nothing of it is run: weights are tensors, and the configuration
        names classes that are imported already.

        Args:
            directory: where ``config.json`` and ``model.safetensors`` lie; or, as text, ``"user/name"`` of a
                repository at the Hugging Face hub, where there is no such folder.

        Keyword Args:
            prior: the prior that the environment carries, if any: it must be the policy's own.
            device: where to put the weights.
            generator: source of randomness of the sampler.
            revision: branch, tag or commit of the repository; its main branch by default.
            token: for a private repository; by default the hub client's own.
            endpoint: address of the hub or of a server like it; by default the hub client's own.

        Raises:
            FileNotFoundError: if a file, the repository or the revision is missing.
            ValueError: if the files are damaged, of another format version, do not fit each other, or
                belong to a policy with another prior; or if a revision of a folder is asked for.
            PermissionError: if the hub does not let this user read it.
            OSError: if the hub cannot be asked, and the policy is not in its client's cache.
            ImportError: if the hub has to be asked, and huggingface_hub is not installed.

        Examples:
            >>> WarmPriorActor.from_pretrained("user/square-past")  # doctest: +SKIP
            WarmPriorActor(...)
        """
        folder = pretrained_folder(directory, revision=revision, token=token, endpoint=endpoint)
        try:
            actor = cls._read(folder, prior)
        except ValueError as error:
            if folder == Path(directory):
                raise
            raise ValueError(
                f"{directory} at the hub: {error} (if it was damaged here, remove {folder.parents[1]} "
                "to fetch it again)"
            ) from error
        actor.sampler.generator = generator
        return actor.to(device).eval()

    @classmethod
    def _read(cls, directory: Path, prior: Prior | None) -> WarmPriorActor:
        """The policy in a folder, checked."""
        path, weights = directory / CONFIG, directory / WEIGHTS
        config = read_config(path)
        if not weights.exists():
            raise FileNotFoundError(f"no policy weights at {weights}")
        check_regular(weights)
        try:
            shapes = tensor_shapes(weights)
            built = cls._blueprint(config, shapes)
            misfit = built and _difference(built, shapes)
        except Exception as error:  # the format's own, that of a blueprint, or a failing disk
            misfit = str(error)
        if misfit:
            raise ValueError(
                f"{weights} does not fit {path}: it is damaged or belongs to another network ({misfit})"
            )
        if config.get("sha256") is not None and config["sha256"] != pretrained_digest(
            config, weights
        ):
            raise ValueError(
                f"{weights} or {path} is damaged or was changed since the policy was saved: copy the "
                "folder again. To change a setting, pass it to the call, or save the policy anew."
            )
        try:
            actor = cls._from_config(config)
        except (
            Exception
        ) as error:  # whatever options of another version, or no options at all, lead to
            reason = str(error) if type(error) is ValueError else repr(error)
            raise ValueError(f"{path} is damaged or of another version: {reason}") from error
        if prior is not None and as_json(prior.config()) != config["prior"]:
            raise ValueError(
                f"the policy at {directory} was trained with {actor.prior}, not with {prior}"
            )
        tensors = load_file(weights)
        problem = _difference(actor.state_dict(), tensors) or _bad_value(actor, tensors)
        if problem:
            raise ValueError(f"{weights}: {problem}. It is damaged: copy the policy again.")
        actor.load_state_dict(tensors)
        return actor

    @classmethod
    def _from_config(cls, config: dict[str, Any]) -> WarmPriorActor:
        """An actor with fresh weights."""
        options: dict[str, Any] = dict(config["actor"])
        for name in _SAVED_KEYS:
            if name in options:
                options[name] = _key_from_json(name, options[name])
        if "guidance" in options:
            options["guidance"] = RealTimeChunking(**options["guidance"])
        normalizer = config["normalizer"]
        actor = cls(
            VelocityNetwork.from_config(config["network"]),
            Prior.from_config(config["prior"]),
            normalizer=None if normalizer is None else Normalizer.from_config(normalizer),
            environment=config.get("environment"),
            **options,
        )
        # Policies saved before it was told are of the default precision.
        parts = actor._parts()
        for name, precision in config.get("precision", {}).items():
            dtype = _PRECISIONS[precision]
            # Only then: a part may hold other types beside that of its weights.
            if _dtype(parts[name]) != dtype:
                parts[name].to(dtype)
        return actor

    @classmethod
    def _blueprint(
        cls, config: dict[str, Any], shapes: Mapping[str, tuple[int, ...]]
    ) -> dict[str, Tensor] | None:
        """What an actor of a configuration holds; ``None`` if only building it can tell."""
        try:
            return blueprint(lambda: cls._from_config(config), shapes)
        except BlueprintError:
            raise
        except Exception:  # a wrong option, or a network that needs values to be built
            return None


def _key_from_json(name: str, value: Any) -> NestedKey:
    """A key as JSON holds it: text, or a list of texts for a nested one."""
    parts = value if isinstance(value, list) and len(value) > 1 else [value]
    if not all(isinstance(part, str) and part for part in parts):
        raise ValueError(f"{name} must be a key, got {value!r}")
    return tuple(parts) if isinstance(value, list) else value


def _following(prior: Prior) -> dict[str, Any]:
    """The constructor's defaults that follow from the prior."""
    return {
        "nfe": DEFAULT_NFE if prior.is_flow else 1,
        "observation_key": keys.CONDITIONED if prior.conditions_network else keys.OBSERVATION,
    }


def _dtype(part: nn.Module) -> torch.dtype | None:
    """The precision of a part's weights; ``None`` if it has none."""
    tensors = chain(part.parameters(), part.buffers())
    return next((value.dtype for value in tensors if value.is_floating_point()), None)


def _difference(built: Mapping[str, Tensor], given: Mapping[str, Any]) -> str | None:
    """How the tensors, or shapes alone, that are given differ from those of a built actor."""
    for name in sorted(built.keys() ^ given.keys()):
        return f"{name} is {'missing' if name in built else 'not part of the network'}"
    for name, value in built.items():
        other = given[name]
        if tuple(value.shape) != tuple(getattr(other, "shape", other)):
            return f"{name} has shape {tuple(getattr(other, 'shape', other))}, not {tuple(value.shape)}"
        if isinstance(other, Tensor) and value.dtype != other.dtype:
            return f"{name} has type {other.dtype}, not {value.dtype}"
    return None


def _bad_value(actor: WarmPriorActor, tensors: Mapping[str, Tensor]) -> str | None:
    """What no training saves among the values for an actor, if anything."""
    for name, built in actor.state_dict().items():
        value = tensors[name]
        # Infinite where it was built so, as a mask is.
        if (value.isnan() | (value.isinf() & ~built.isinf())).any():
            return f"{name} holds NaN or infinity"
        statistic = name.startswith("normalizer.")
        if statistic and name.endswith("_scale") and not (value > 0).all():
            return f"{name} holds a scale that is not positive"
    return None
