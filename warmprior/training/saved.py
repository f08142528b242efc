"""Saved policies: their files, and their way to the Hugging Face hub and back."""

from __future__ import annotations

import hashlib
import json
import tempfile
import time
from collections.abc import Mapping
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from typing import Any

import torch
from tensordict.utils import NestedKey
from torch import Tensor, nn

from warmprior.io.files import (
    as_json,
    check_regular,
    read_json,
    read_tensors,
    save_file,
    write_atomic,
)
from warmprior.io.hub import explained, is_repository, snapshot, upload
from warmprior.modules.actor import WarmPriorActor
from warmprior.modules.blueprint import BlueprintError, blueprint
from warmprior.modules.compiled import uncompiled, without_compilation
from warmprior.modules.network import VelocityNetwork
from warmprior.modules.normalize import Normalizer
from warmprior.modules.prior import Prior
from warmprior.modules.real_time_chunking import RealTimeChunking
from warmprior.modules.registry import from_config
from warmprior.modules.start import StartPoint

__all__ = [
    "check_saveable",
    "load_policy",
    "policy_config",
    "policy_file",
    "push_policy",
    "save_policy",
]

_PRECISIONS = {name: getattr(torch, name) for name in ("float16", "bfloat16", "float32", "float64")}

FORMAT = 4
"""Version of the layout that :func:`save_policy` writes."""

CONFIG, WEIGHTS, CARD = "config.json", "model.safetensors", "README.md"


ATTEMPTS = 5
"""How often a policy is read whose two files do not belong together: it may be being saved."""


def _digest(config: dict[str, Any], weights: bytes) -> str:
    """Digest of a configuration and of the weights that belong to it."""
    text = json.dumps({k: v for k, v in config.items() if k != "sha256"}, sort_keys=True)
    return hashlib.sha256((text + hashlib.sha256(weights).hexdigest()).encode()).hexdigest()


def _read_config(path: Path) -> dict[str, Any]:
    """Read the configuration of a saved policy."""
    if not path.exists():
        raise FileNotFoundError(f"no policy at {path.parent}: {path.name} is missing")
    config = read_json(path)
    found = config.get("format") if isinstance(config, dict) else None
    if found != FORMAT:
        raise ValueError(
            f"{path} has format {found}, this version of warmprior reads {FORMAT}: "
            "save the policy again with a matching version"
        )
    parts = (
        "prior",
        "start",
        "network",
        "actor",
        "normalizer",
        "environment",
        "precision",
        "sha256",
    )
    missing = [part for part in parts if part not in config]
    if missing:
        raise ValueError(f"{path} is incomplete: it lacks {', '.join(missing)}")
    return config


def _folder(
    place: str | Path,
    *,
    revision: str | None = None,
    token: str | None = None,
    endpoint: str | None = None,
) -> Path:
    """Where the files of a policy lie, fetched from the hub if need be."""
    path = Path(place)
    remote = isinstance(place, str) and is_repository(place) and not path.exists()
    if not remote:
        if revision is not None:
            raise ValueError(
                f"{place} is a folder on this machine, or no user/name of a repository at the hub: leave out "
                f"revision={revision!r}"
            )
        return path
    name = str(place)
    # The small file first: a repository of something else may be large.
    folder = _fetched(name, CONFIG, revision, token, endpoint)
    try:
        _read_config(folder / CONFIG)
    except ValueError as error:
        raise ValueError(f"{name} at the hub holds no policy of warmprior: {error}") from error
    # Of the same commit, whatever happens to the branch meanwhile.
    return _fetched(name, WEIGHTS, folder.name, token, endpoint)


def _fetched(
    repository: str, file: str, revision: str | None, token: str | None, endpoint: str | None
) -> Path:
    """The folder of a commit, with a file of it."""
    where = f"there is no folder {repository} here, and "
    try:
        folder = snapshot(repository, [file], revision=revision, token=token, endpoint=endpoint)
    except ImportError as error:
        raise ImportError(f"{where}to ask the hub {error}") from error
    except Exception as error:  # the client's share no base class
        told = explained(error, repository, revision)
        raise type(told)(f"{where}{told}") from error
    if not (folder / file).exists():
        raise FileNotFoundError(f"{repository} at the hub holds no policy: {file} is missing")
    return folder


def policy_config(actor: WarmPriorActor) -> dict[str, Any]:
    """JSON-serialisable description of everything but the weights.

    Raises:
        TypeError: if the network is not a :class:`VelocityNetwork`, or an option of the network, the
            prior or the normaliser cannot be written as JSON.
    """
    network = uncompiled(actor.network)
    if not isinstance(network, VelocityNetwork):
        raise TypeError(
            f"cannot save {type(network).__name__}: only VelocityNetwork subclasses carry the "
            "configuration that load_policy needs"
        )
    guidance = actor.ode.guidance
    config = {
        "format": FORMAT,
        "warmprior": version("warmprior"),
        "prior": actor.prior.config(),
        "start": None if actor.start is None else actor.start.config(),
        "network": network.config(),
        "actor": {
            "nfe": actor.ode.nfe,
            "solver": actor.ode.solver,
            "grid": actor.ode.grid,
            "clip": actor.ode.clip,
            "max_nfe": actor.ode.max_nfe,
            "guidance": None if guidance is None else guidance.config(),
            "observation_key": actor.in_keys[0],
            "chunk_key": actor.chunk_key,
        },
        "normalizer": None if actor.normalizer is None else actor.normalizer.config(),
        "environment": actor.environment,
        "precision": _precision(actor),
    }
    try:
        return as_json(config)
    except TypeError as error:
        raise TypeError(
            f"cannot save {actor.prior}, {type(network).__name__} and the normaliser: {error}. Use plain "
            "numbers and text for options, and plain names for the normaliser's keys."
        ) from error


def _parts(actor: WarmPriorActor) -> dict[str, nn.Module]:
    """What has weights, under the names of the configuration."""
    parts = {
        "network": actor.network,
        "prior": actor.prior,
        "normalizer": actor.normalizer,
        "start": actor.start,
    }
    return {name: part for name, part in parts.items() if isinstance(part, nn.Module)}


def _precision(actor: WarmPriorActor) -> dict[str, str]:
    """Names of the parts' precisions. Each its own: half precision is too coarse for statistics."""
    found = {name: _dtype(part) for name, part in _parts(actor).items()}
    return {name: str(dtype).removeprefix("torch.") for name, dtype in found.items() if dtype}


def policy_file(place: str | Path, *, revision: str | None = None) -> dict[str, Any]:
    """The configuration of a saved policy, as its file has it.

    Args:
        place: see :func:`load_policy`.

    Keyword Args:
        revision: see :func:`load_policy`.
    """
    return _read_config(_folder(place, revision=revision) / CONFIG)


def check_saveable(actor: WarmPriorActor) -> None:
    """Whether :func:`load_policy` could load what :func:`save_policy` would write.

    For before a training: its policies would be lost otherwise.

    Raises:
        TypeError: if there is no :func:`policy_config`.
        ValueError: if a policy built from it has other tensors than this one.

    Examples:
        >>> from warmprior import PastPrior, VelocityMLP
        >>> check_saveable(WarmPriorActor(VelocityMLP(2, 3, 4), PastPrior(4)))
    """
    _saveable(actor)


def _saveable(actor: WarmPriorActor) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """The configuration and the tensors, after checking that they belong together."""
    config = policy_config(actor)
    tensors = without_compilation(actor.state_dict())
    mine = {name: value.shape for name, value in tensors.items()}
    try:
        built = _built(config, mine)
        if built is None:
            with torch.random.fork_rng([]):  # as if nothing had been built
                built = _from_config(config).state_dict()
        problem = _difference(built, tensors)
    except Exception as error:
        problem = repr(error)
    if problem:
        raise ValueError(
            f"a saved {type(actor.network).__name__} could not be loaded again: {problem}. Its "
            "constructor has to build, from the options in its config(), what is to be saved."
        )
    return config, tensors


def save_policy(actor: WarmPriorActor, directory: str | Path) -> None:
    """Write ``config.json`` and ``model.safetensors``.

    Network, prior and normaliser each keep their precision (``torch.float16``, ``bfloat16``,
    ``float32`` or ``float64``). The configuration holds a digest of both files, by which
    :func:`load_policy` notices any change.

    Args:
        actor: the policy.
        directory: created if needed.

    Raises:
        OSError: if the folder cannot be written to.
        TypeError: if the network is not a :class:`VelocityNetwork` (its configuration is needed).
        ValueError: if the policy could not be loaded again, see :func:`check_saveable`.

    See Also:
        :func:`~warmprior.training.load_policy`: reads it.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from warmprior import PastPrior, VelocityMLP
        >>> actor = WarmPriorActor(VelocityMLP(2, 3, 4), PastPrior(4))
        >>> with TemporaryDirectory() as folder:
        ...     save_policy(actor, folder)
        ...     load_policy(folder).prior
        PastPrior(chunk_length=4, sigma=0.5, correlation=0.0)
    """
    config, tensors = _saveable(actor)
    directory = Path(directory)
    weights = directory / WEIGHTS
    write_atomic(weights, lambda path: save_file(tensors, path))
    digest = _digest(config, weights.read_bytes())
    text = json.dumps(config | {"sha256": digest}, indent=2) + "\n"
    write_atomic(directory / CONFIG, lambda path: path.write_text(text))


def push_policy(
    actor: WarmPriorActor,
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
        actor: the policy.
        repository: such as ``"user/name"``.

    Keyword Args:
        card: text of its ``README.md``, such as :func:`~warmprior.training.model_card` writes; by
            default what is there stays.
        private: whether a new repository is private; by default what the account has set.
        revision: branch; the main one by default.
        message: of the commit.
        token: with which to write; by default the hub client's own.
        endpoint: address of the hub or of a server like it; by default the hub client's own.

    Returns:
        The commit, as ``revision`` of :func:`load_policy` takes it.

    Raises:
        TypeError: see :func:`save_policy`.
        ValueError: likewise; if the name is no ``"user/name"``; or if it is to be private, and there is a
            public repository of that name.
        OSError: if the hub does not take it: a ``PermissionError`` without a token that may write.
        ImportError: if huggingface_hub is not installed.

    Examples:
        >>> push_policy(actor, "user/square-past", card=model_card(actor))  # doctest: +SKIP
        '0123456789abcdef0123456789abcdef01234567'
    """
    if not is_repository(repository):
        raise ValueError(f"{repository!r} is no name of a repository at the hub: use user/name")
    files = [CONFIG, WEIGHTS] + [CARD] * (card is not None)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        save_policy(actor, folder)
        if card is not None:
            (folder / CARD).write_text(card)
        try:
            return upload(
                folder,
                repository,
                files,
                message=message,
                private=private,
                revision=revision,
                endpoint=endpoint,
                token=token,
            )
        except Exception as error:  # the client's share no base class
            if isinstance(error, ImportError) or type(error) is ValueError:
                raise
            raise explained(error, repository, revision) from error


def load_policy(
    directory: str | Path,
    *,
    prior: Prior | None = None,
    device: torch.device | str = "cpu",
    generator: torch.Generator | None = None,
    revision: str | None = None,
    token: str | None = None,
    endpoint: str | None = None,
) -> WarmPriorActor:
    """Load a policy that :func:`save_policy` or :func:`push_policy` wrote.

    It returns bit-identical chunks. Nothing of it is run: weights are tensors, and the configuration
    names classes that are imported already.

    Args:
        directory: where ``config.json`` and ``model.safetensors`` lie; or, as text, ``"user/name"`` of a
            repository at the Hugging Face hub, where there is no such folder.

    Keyword Args:
        prior: the prior that the policy must have been trained with, if any.
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
        >>> from tempfile import TemporaryDirectory
        >>> from warmprior import PastPrior, VelocityMLP
        >>> with TemporaryDirectory() as folder:
        ...     save_policy(WarmPriorActor(VelocityMLP(2, 3, 4), PastPrior(4)), folder)
        ...     load_policy(folder).prior.chunk_length
        4
        >>> load_policy("user/square-past")  # doctest: +SKIP
        WarmPriorActor(...)
    """
    folder = _folder(directory, revision=revision, token=token, endpoint=endpoint)
    try:
        actor = _read(folder, prior)
    except ValueError as error:
        if folder == Path(directory):
            raise
        raise ValueError(
            f"{directory} at the hub: {error} (if it was damaged here, remove {folder.parents[1]} "
            "to fetch it again)"
        ) from error
    actor.sampler.generator = generator
    return actor.to(device).eval()


def _read(directory: Path, prior: Prior | None) -> WarmPriorActor:
    """The policy in a folder, checked."""
    path, weights = directory / CONFIG, directory / WEIGHTS
    # Each file is read once, and what is checked is what is loaded: another process may replace them.
    for attempt in range(ATTEMPTS):
        config = _read_config(path)
        if not weights.exists():
            raise FileNotFoundError(f"no policy weights at {weights}")
        check_regular(weights)
        data = weights.read_bytes()
        whole = config["sha256"] == _digest(config, data)
        if whole:
            break
        time.sleep(0.02 * 2**attempt)
    try:
        tensors, _ = read_tensors(data)
        built = _built(config, {name: tuple(value.shape) for name, value in tensors.items()})
        misfit = built and _difference(built, tensors)
    except Exception as error:  # the format's own, that of a blueprint, or a failing disk
        misfit = str(error)
    if misfit:
        raise ValueError(
            f"{weights} does not fit {path}: it is damaged or belongs to another network ({misfit})"
        )
    if not whole:
        raise ValueError(
            f"{weights} or {path} is damaged or was changed since the policy was saved: copy the "
            "folder again. To change a setting, pass it to the call, or save the policy anew."
        )
    try:
        actor = _from_config(config)
    except Exception as error:  # whatever options of another version, or no options at all, lead to
        reason = str(error) if type(error) is ValueError else repr(error)
        raise ValueError(f"{path} is damaged or of another version: {reason}") from error
    if prior is not None and as_json(prior.config()) != config["prior"]:
        raise ValueError(
            f"the policy at {directory} was trained with {actor.prior}, not with {prior}"
        )
    problem = _difference(actor.state_dict(), tensors) or _bad_value(actor, tensors)
    if problem:
        raise ValueError(f"{weights}: {problem}. It is damaged: copy the policy again.")
    actor.load_state_dict(tensors)
    return actor


def _from_config(config: dict[str, Any]) -> WarmPriorActor:
    """An actor with fresh weights."""
    options: dict[str, Any] = dict(config["actor"])
    for name in ("observation_key", "chunk_key"):
        options[name] = _key_from_json(name, options[name])
    if options["guidance"] is not None:
        options["guidance"] = RealTimeChunking(**options["guidance"])
    normalizer, start = config["normalizer"], config["start"]
    actor = WarmPriorActor(
        VelocityNetwork.from_config(config["network"]),
        from_config(Prior, config["prior"]),
        normalizer=None if normalizer is None else Normalizer.from_config(normalizer),
        start=None if start is None else from_config(StartPoint, start),
        environment=config["environment"],
        **options,
    )
    parts = _parts(actor)
    for name, precision in config["precision"].items():
        dtype = _PRECISIONS[precision]
        # Only then: a part may hold other types beside that of its weights.
        if _dtype(parts[name]) != dtype:
            parts[name].to(dtype)
    return actor


def _built(
    config: dict[str, Any], shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, Tensor] | None:
    """What an actor of a configuration holds; ``None`` if only building it can tell."""
    try:
        return blueprint(lambda: _from_config(config), shapes)
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
