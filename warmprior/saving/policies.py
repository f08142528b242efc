"""Saved policies: a single file, in a folder or on the Hugging Face hub."""

from __future__ import annotations

import json
import math
import tempfile
import warnings
from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from warmprior.checks import LARGEST, all_usable, check_device
from warmprior.io.extras import require
from warmprior.io.files import as_json, is_repository, read_json, write_atomic
from warmprior.modules.actor import USUAL_KEYS, StartPoint, WarmPriorActor
from warmprior.modules.network import VelocityNetwork, precision_of, uncompiled, without_compilation
from warmprior.modules.normalize import Normalizer
from warmprior.modules.preconditioning import SourceMoments
from warmprior.modules.prior import Prior
from warmprior.modules.real_time_chunking import RealTimeChunking
from warmprior.modules.recording import Recording
from warmprior.modules.registry import from_config
from warmprior.modules.sampling import Sampling
from warmprior.modules.trend import RestingAction
from warmprior.saving.training_state import as_key, load_state, save_state

FORMAT = 11
"""The version of the layout that :func:`save_policy` writes."""

CONFIG, WEIGHTS, CARD = "config.json", "model.safetensors", "README.md"


def _read(folder: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return weights and configuration of the policy in a folder."""
    path = folder / WEIGHTS
    if not path.exists():
        kept = sorted(file.parent.name for file in folder.glob(f"*/{WEIGHTS}"))
        reason = f"{WEIGHTS} is missing"
        if folder.is_file():
            reason = "it is a file, but a policy is a folder"
        elif kept:
            reason = f"it holds the policies {', '.join(kept)}: name one of them"
        raise FileNotFoundError(f"no policy at {folder}: {reason}")
    copy = None
    if (folder / CONFIG).is_file():
        copy = read_json(folder / CONFIG)
        _check_format(folder / CONFIG, copy)  # a policy of another format may have no configuration elsewhere
    tensors, config = load_state(path, "policy", "Copy it again, or remove it to train again")
    _check_format(path, config)
    if copy not in (None, config):
        differ = sorted(name for name in {*copy, *config} if copy.get(name) != config.get(name))
        # A warning only, because an interrupted save leaves the configuration of the policy before.
        warnings.warn(
            f"{folder / CONFIG} differs in {', '.join(differ)} from the configuration in {WEIGHTS}, which is "
            "used: save the policy again",
            stacklevel=4,
        )
    return tensors, config


def _check_format(path: Path, config: Any) -> None:
    if not isinstance(config, dict) or "warmprior" not in config:
        raise ValueError(f"{path} does not belong to a policy of warmprior")
    version = config.get("format")
    if version != FORMAT:
        raise ValueError(
            f"{path} has format {version}, but this version reads {FORMAT}: save the policy again"
        )


def _folder(place: str | Path, revision: str | None) -> Path:
    """Return the folder of a policy, after fetching it from the hub if needed."""
    path = Path(place)
    if path.exists() or not (isinstance(place, str) and is_repository(place)):
        if revision is not None:
            raise ValueError(f"{place} is not a repository on the hub: leave out revision={revision!r}")
        return path
    hub = require("huggingface_hub", "sim")
    fetch = partial(hub.snapshot_download, place)
    # The small file first, because a repository without a policy may be large.
    try:
        folder = Path(fetch(revision=revision, allow_patterns=[CONFIG]))
    except OSError as error:
        reason = " ".join(str(error).split())
        raise OSError(f"{place} is not a folder, and cannot be fetched from the hub: {reason}") from error
    if not (folder / CONFIG).exists():
        raise ValueError(f"{place} on the hub holds no policy of warmprior: it has no {CONFIG}")
    _check_format(folder / CONFIG, read_json(folder / CONFIG))
    # From the same commit, since the branch may move between the two requests.
    return Path(fetch(revision=folder.name, allow_patterns=[WEIGHTS]))


def check_repository(name: str) -> None:
    """Raise ValueError if a text does not have the form of a repository's name on the hub."""
    if not is_repository(name):
        raise ValueError(f"{name!r} is not the name of a repository on the hub: use user/name")


def policy_config(actor: WarmPriorActor) -> dict[str, Any]:
    """Return everything except the weights as JSON; raise TypeError if JSON cannot hold a part."""
    actor, network = uncompiled(actor), uncompiled(actor.network)
    if type(actor) is not WarmPriorActor:  # a plain actor would be loaded
        raise TypeError(
            f"cannot save {type(actor).__name__}: only WarmPriorActor itself is saved; put what the subclass "
            "adds into a prior, start point or network, or save a WarmPriorActor of its parts without that"
        )
    if not isinstance(network, VelocityNetwork):
        raise TypeError(f"cannot save {type(network).__name__}: only subclasses of VelocityNetwork are saved")
    guidance = actor.ode.guidance
    config = {
        "format": FORMAT,
        "warmprior": version("warmprior"),
        "prior": actor.prior.config(),
        "start": None if actor.start is None else actor.start.config(),
        "network": network.config(),
        "actor": {
            **asdict(actor.sampling),
            **actor.tensor_keys,
            "guidance": None if guidance is None else asdict(guidance),
        },
        "normalizer": None if actor.normalizer is None else actor.normalizer.config(),
        "environment": actor.environment,
        "recording": None if actor.recording is None else asdict(actor.recording),
        # One precision per part, because half precision is too coarse for statistics.
        "precision": {
            name: str(dtype).removeprefix("torch.")
            for name, part in _parts(actor).items()
            if (dtype := precision_of(part))
        },
    }
    try:
        return as_json(config)
    except TypeError as error:
        raise TypeError(f"cannot save {type(network).__name__} with {actor.prior}: {error}") from error


def _parts(actor: WarmPriorActor) -> dict[str, nn.Module]:
    """Return the parts that have weights, under the names of the configuration."""
    parts = {
        "network": actor.network,
        "prior": actor.prior,
        "normalizer": actor.normalizer,
        "start": actor.start,
    }
    return {name: part for name, part in parts.items() if isinstance(part, nn.Module)}


def policy_file(place: str | Path, *, revision: str | None = None) -> dict[str, Any]:
    """Return the configuration in a saved policy's file; arguments as for :func:`load_policy`."""
    return _read(_folder(place, revision))[1]


def check_saveable(actor: WarmPriorActor) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return configuration and weights to save, after checking that :func:`load_policy` could load them.

    Raises TypeError or ValueError if it could not; call it before a training run whose result would be lost.
    """
    config = policy_config(actor)
    tensors = without_compilation(actor.state_dict())
    try:
        with torch.random.fork_rng([]):  # building a policy draws random weights
            again = policy_config(_filled(config, tensors))
        if changed := [name for name in config if config[name] != again[name]]:
            raise ValueError(f"its {changed[0]} would have {again[changed[0]]}, not {config[changed[0]]}")
    except Exception as error:
        raise ValueError(
            f"the policy could not be loaded again: {error}. Constructors must build the same object from "
            "the options in config()"
        ) from error
    return config, tensors


def save_policy(actor: WarmPriorActor, directory: str | Path) -> None:
    """Save a policy as ``model.safetensors``, with a readable copy of its configuration, ``config.json``.

    Network, prior and normaliser each keep their precision. A digest lets :func:`load_policy` detect any
    change. An interrupted save over a policy leaves either the old policy or the new one.

    Args:
        actor: the policy.
        directory: the folder; it is created if needed.

    Raises:
        OSError: if the folder cannot be written to.
        TypeError: if the network is not a :class:`VelocityNetwork` (its configuration is needed), the
            policy is of a subclass of :class:`WarmPriorActor`, or JSON cannot hold a part's options.
        ValueError: if the policy could not be loaded again, which is checked before writing.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior.saving import load_policy, save_policy
        >>> actor = WarmPriorActor(VelocityMLP(2, 3, 4), PastPrior(4))
        >>> with TemporaryDirectory() as folder:
        ...     save_policy(actor, folder)
        ...     load_policy(folder).prior
        PastPrior(chunk_length=4, sigma=0.5, correlation=0.0)
    """
    config, tensors = check_saveable(actor)
    directory = Path(directory)
    save_state(directory / WEIGHTS, tensors, config)
    text = json.dumps(config, indent=2) + "\n"
    write_atomic(directory / CONFIG, lambda path: path.write_text(text))


def push_policy(
    actor: WarmPriorActor,
    repository: str,
    *,
    card: str | None = None,
    private: bool | None = None,
    revision: str | None = None,
) -> str:
    """Save the policy in a repository on the Hugging Face hub, which is created if needed.

    It needs a token with write access, as ``hf auth login`` keeps it, or in ``HF_TOKEN``.

    Args:
        actor: the policy.
        repository: name of the repository, such as ``"user/name"``.

    Keyword Args:
        card: text of its ``README.md``, such as that of :func:`~warmprior.saving.model_card`; by default
            an existing one stays.
        private: True for a new private repository; by default the account's setting.
        revision: branch; the main one by default.

    Returns:
        The hash of the commit, a ``revision`` for :func:`load_policy`.

    Raises:
        TypeError: see :func:`save_policy`.
        ValueError: see :func:`save_policy`; also if the name does not have the form ``"user/name"``, or
            ``private`` is True and the repository exists and is public.
        OSError: if the hub refuses the upload (the hub client's own error).

    Examples:
        >>> from warmprior.saving import load_policy, model_card, push_policy
        >>> actor = load_policy("policy_010000")  # doctest: +SKIP
        >>> push_policy(actor, "user/square-past", card=model_card(actor))  # doctest: +SKIP
        '0123456789abcdef0123456789abcdef01234567'
    """
    check_repository(repository)
    api = require("huggingface_hub", "sim").HfApi()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        save_policy(actor, folder)
        if card is not None:
            (folder / CARD).write_text(card)
        api.create_repo(repository, private=private, exist_ok=True)
        if private and not api.repo_info(repository).private:
            raise ValueError(f"{repository} is public: choose another name, or make it private on the hub")
        if revision is not None:
            api.create_branch(repository, branch=revision, exist_ok=True)
        sent = api.upload_folder(
            repo_id=repository,
            folder_path=folder,
            commit_message="Upload a policy of warmprior",
            revision=revision,
        )
    return str(sent.oid)


def load_policy(
    directory: str | Path,
    *,
    device: torch.device | str = "cpu",
    revision: str | None = None,
) -> WarmPriorActor:
    """Load a policy that :func:`save_policy` or :func:`push_policy` wrote.

    Its chunks are bit-identical to the original's. No code in the file is run: weights are tensors, and the
    configuration names classes that must already be imported.

    Args:
        directory: the folder with ``model.safetensors``; or, if there is no such folder, a repository on the
            Hugging Face hub, ``"user/name"``; a private one needs a token, see :func:`push_policy`.

    Keyword Args:
        device: device of the weights.
        revision: branch, tag or commit of the repository; its main branch by default.

    Raises:
        FileNotFoundError: if the folder has no policy.
        ValueError: if the policy is damaged or has another format version, a folder is given a revision, or
            the device does not work.
        OSError: if the hub does not have the policy, or this user has no access to it.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior.saving import load_policy, save_policy
        >>> with TemporaryDirectory() as folder:
        ...     save_policy(WarmPriorActor(VelocityMLP(2, 3, 4), PastPrior(4)), folder)
        ...     load_policy(folder).prior.chunk_length
        4
    """
    check_device(device)
    folder = _folder(directory, revision)
    tensors, config = _read(folder)
    try:
        actor = _filled(config, tensors)
    except Exception as error:  # options of another version can raise anything
        reason = str(error) if type(error) is ValueError else repr(error)
        raise ValueError(f"the policy in {folder / WEIGHTS} cannot be built here: {reason}") from error
    return actor.to(device).eval()


def _filled(config: dict[str, Any], tensors: Mapping[str, Tensor]) -> WarmPriorActor:
    """Return the actor of a configuration, with these weights, all of which must be usable numbers."""
    with NoLargerThan(tensors):
        actor = _from_config(config)
    built = actor.state_dict()
    for name in sorted(built.keys() ^ tensors.keys()):
        raise ValueError(f"{name} is {'missing' if name in built else 'not part of it'}")
    for name, value in built.items():
        expected, stored = (f"{tuple(t.shape)} of {t.dtype}" for t in (value, tensors[name]))
        if stored != expected:
            raise ValueError(f"{name} is {stored}, not {expected}")
        # Data have no larger numbers, so no training makes them; their products overflow at decisions.
        if value.is_floating_point() and not all_usable(tensors[name]):
            raise ValueError(f"{name} holds NaN, infinity or numbers above {LARGEST:g}")
    actor.load_state_dict(tensors)
    for place, module in actor.named_modules():
        if isinstance(module, (Normalizer, RestingAction, SourceMoments)):
            for name in module.positive:
                if not (module.get_buffer(name) > 0).all():
                    raise ValueError(f"{place}.{name} is a scale, but holds values that are not positive")
    return actor


class NoLargerThan(TorchDispatchMode):
    """A limit on the size of parts built from a file's options: not much more than the file's weights."""

    def __init__(self, tensors: Mapping[str, Tensor]) -> None:
        super().__init__()
        # With room for temporary tensors, and for buffers that are not saved.
        self.numbers = 2 * sum(value.numel() for value in tensors.values()) + 2**24
        self.count = 10 * len(tensors) + 1000

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        sizes: list[Any] = []
        if func is torch.ops.aten.clone.default:  # copies of layers
            sizes = [args[0].numel()]
        elif not any(isinstance(value, Tensor) for value in args):  # a new tensor; its size is among these
            sizes = [math.prod(value) if isinstance(value, (list, tuple)) else value for value in args]
        if sizes:
            self.numbers -= max((size for size in sizes if isinstance(size, int)), default=1)
            self.count -= 1
            if self.numbers < 0 or self.count < 0:
                raise ValueError("its options need far more weights than it has")
        return func(*args, **(kwargs or {}))


def _from_config(config: dict[str, Any]) -> WarmPriorActor:
    """Return the actor of a configuration, with fresh weights."""
    options: dict[str, Any] = dict(config["actor"])
    # The constructor also takes objects, which no file holds.
    if others := options.keys() - {*asdict(Sampling()), *USUAL_KEYS, "observation_key", "guidance"}:
        raise ValueError(f"actor.{min(others)} is no option of a saved policy")
    for name, value in options.items():
        if name.endswith("_key"):
            options[name] = as_key(value)
    if options["guidance"] is not None:
        options["guidance"] = RealTimeChunking(**options["guidance"])
    normalizer, start, recording = config["normalizer"], config["start"], config["recording"]
    actor = WarmPriorActor(
        from_config(VelocityNetwork, config["network"]),
        from_config(Prior, config["prior"]),
        normalizer=None if normalizer is None else Normalizer.from_config(normalizer),
        start=None if start is None else from_config(StartPoint, start),
        environment=config["environment"],
        recording=None if recording is None else Recording(**recording),
        **options,
    )
    parts = _parts(actor)
    for name, precision in config["precision"].items():
        dtype = getattr(torch, precision)
        # Only if it differs, because a part may also hold other types than that of its weights.
        if precision_of(parts[name]) != dtype:
            parts[name].to(dtype)
    return actor
