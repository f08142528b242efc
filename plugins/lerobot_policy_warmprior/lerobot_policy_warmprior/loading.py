"""Loading of saved policies, with errors for weights and options that do not fit."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from draccus.utils import DraccusException
from huggingface_hub import hf_hub_download
from huggingface_hub.errors import EntryNotFoundError
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import NormalizationMode
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from warmprior.checks import LARGEST, all_usable
from warmprior.io.files import read_json
from warmprior.saving.policies import NoLargerThan

HUB = ("token", "cache_dir", "local_files_only", "force_download", "proxies", "revision")
"""Options of a download."""

OLD_BUFFERS = re.compile(r"(un)?normalize_(inputs|targets|outputs)\.")
"""Names of buffers of old policies, which normalised before LeRobot had processors."""

STATISTICS = {
    NormalizationMode.MEAN_STD: ("mean", "std"),
    NormalizationMode.MIN_MAX: ("min", "max"),
    NormalizationMode.QUANTILES: ("q01", "q99"),
    NormalizationMode.QUANTILE10: ("q10", "q90"),
}
"""Statistics that LeRobot's normalisation needs; without them it silently does nothing."""


def saved_file(place: str, name: str, **hub: Any) -> Path | None:
    """Return a file in a folder or hub repository, if there is one."""
    folder = Path(place)
    try:
        file = folder / name if folder.is_dir() else Path(hf_hub_download(place, name, **hub))
    except EntryNotFoundError:
        return None
    return file if file.exists() else None


def saved_weights(place: str, **hub: Any) -> dict[str, Tensor]:
    """Return a policy's saved weights as tensors that take no memory, none if there is no file.

    Raises:
        ValueError: if the file is damaged.
    """
    file = saved_file(place, "model.safetensors", **hub)
    if file is None:
        return {}
    try:
        with safe_open(file, "pt") as weights:
            shapes = {name: weights.get_slice(name).get_shape() for name in weights.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise ValueError(f"{file} is damaged ({error}): copy or download the policy again") from None
    return {name: torch.empty(shape, device="meta") for name, shape in shapes.items()}


def saved_json(place: str, name: str, **hub: Any) -> dict[str, Any]:
    """Return the content of a JSON file in a folder or hub repository, empty if there is none."""
    file = saved_file(place, name, **hub)
    if file is None:
        return {}
    content = read_json(file)
    if not isinstance(content, dict):
        raise ValueError(f"{file} is no JSON object: choose another policy")
    return content


def check_statistics(config: Any, meta: Any) -> None:
    """Raise ValueError for a dataset without usable statistics that the policy's normalisation needs."""
    features, unusable = {**config.input_features, **config.output_features}, []
    for name, feature in features.items():
        mode = config.normalization_mapping.get(feature.type.value, NormalizationMode.IDENTITY)
        stats = (meta.stats or {}).get(name, {})
        numbers = {n: torch.as_tensor(stats.get(n, torch.nan)) for n in STATISTICS.get(mode, ())}
        unusable += [f"{name}: {n}" for n, value in numbers.items() if not all_usable(value)]
    if unusable:
        raise ValueError(
            f"{meta.root}/meta/stats.json has no usable {', '.join(unusable)}: LeRobot would train on raw "
            f"values, on numbers above {LARGEST:g}, or on NaN, which any episode brings there. Delete such "
            "episodes (lerobot-edit-dataset --operation.type=delete_episodes), compute it again "
            "(--operation.type=recompute_stats), leave the feature out (--policy.input_features), or change "
            "--policy.normalization_mapping"
        )


UNBUILT = (ValueError, TypeError, AttributeError, ArithmeticError, LookupError, AssertionError)
"""Options that no policy can be built of raise these errors."""


class WholePolicy(nn.Module):
    """Base class in front of a policy of LeRobot, whose ``from_pretrained`` ignores missing weights."""

    config_class: Any
    name: str
    has_all_weights: ClassVar[bool] = False  # True if the saved weights are all that the policy is built of
    _misfit: ClassVar[str | None] = "no model.safetensors"

    def load_state_dict(self, state_dict: Mapping[str, Tensor], *args: Any, **kwargs: Any) -> Any:
        """Load weights, and note those that do not fit."""
        weights = self.state_dict()
        loaded = {weights[name].data_ptr() for name in weights.keys() & state_dict.keys()}
        found = [(name, value) for name, value in weights.items() if name in state_dict]
        wrong = {
            # A file has tied weights once.
            "missing": [n for n, v in weights.items() if n not in state_dict and v.data_ptr() not in loaded],
            "unexpected": [n for n in state_dict if n not in weights and not OLD_BUFFERS.match(n)],
            "of another shape": [n for n, v in found if v.shape != state_dict[n].shape],
            "of another type": [
                n for n, v in found if v.is_floating_point() != state_dict[n].is_floating_point()
            ],
            f"with NaN, infinity or numbers above {LARGEST:g}": [
                n for n, v in found if self.has_all_weights and not all_usable(state_dict[n])
            ],
        }
        problems = [
            f"{len(names)} {what}: {', '.join(names[:3])}{', ...' if len(names) > 3 else ''}"
            for what, names in wrong.items()
            if names
        ]
        self.__dict__["_misfit"] = "; ".join(problems) or None
        return super().load_state_dict(state_dict, *args, **kwargs)

    @classmethod
    def from_pretrained(
        cls,
        pretrained_name_or_path: Any,
        *,
        config: Any = None,
        cli_overrides: Sequence[str] = (),
        **kwargs: Any,
    ) -> Self:
        """Load a saved policy, or a checkpoint of its family.

        Raises:
            ValueError: if weights are damaged, missing, unexpected or of another shape, or an option
                contradicts the saved options.
            FileNotFoundError: if there is no such policy.
        """
        place = str(pretrained_name_or_path)
        hub = {name: kwargs[name] for name in HUB if name in kwargs}
        weights = saved_weights(place, **hub)
        saved = saved_json(place, "config.json", **hub)
        misfit: str | None
        try:
            if config is None:
                config = PreTrainedConfig.from_pretrained(place, cli_overrides=list(cli_overrides), **hub)
            if saved.get("type") == cls.name:
                kept = PreTrainedConfig.from_pretrained(place, **hub)
                if kept.prior is None:
                    raise ValueError("its config.json names no prior")
                for option, unset in (("joints", "auto"), ("prior", None)):
                    if getattr(config, option, "") == unset:  # what the weights were trained with
                        setattr(config, option, getattr(kept, option))
                check_options(kept, config, training=kwargs.get("dataset_meta") is not None)
            # A training that goes on reads its dataset while the policy is built.
            limited = cls.has_all_weights and weights and kwargs.get("dataset_meta") is None
            with NoLargerThan(weights) if limited else nullcontext():
                policy = super().from_pretrained(place, config=config, **kwargs)  # type: ignore[misc]
            misfit = policy._misfit
        except RuntimeError as error:
            if "state_dict" not in str(error):
                raise
            title, *names = map(str.strip, str(error).splitlines())  # it names each weight in a line
            misfit = "; ".join([*names[:3], *(["..."] if len(names) > 3 else [])]) or title
        except FileNotFoundError as error:
            raise FileNotFoundError(f"{place} has no policy: {error}") from error
        except (*UNBUILT, DraccusException) as error:
            if any(repr(name) in str(error) for name in kwargs):  # an argument of the caller's
                raise
            reason = str(error).partition("\n")[0] or repr(error)
            raise ValueError(f"the policy in {place} cannot be built: {reason}") from error
        if misfit == WholePolicy._misfit:
            raise FileNotFoundError(f"{place} has no model.safetensors: choose the folder of a saved policy")
        if misfit:
            raise ValueError(
                f"the weights in {place} are not those of {cls.name} with these options: {misfit}. Leave out "
                "options that change the network, or choose another policy"
            )
        return policy


def check_options(saved: Any, requested: Any, *, training: bool) -> None:
    """Raise ValueError if options contradict those that a saved policy was trained with."""
    before, now = (config.meaning(training=training) for config in (saved, requested))
    changes = [f"{name}={now[name]!r} (it has {before[name]!r})" for name in now if now[name] != before[name]]
    if changes:
        raise ValueError(f"it was trained with other options than {', '.join(changes)}: leave them out")


def check_known(name: str, arguments: Mapping[str, Any], names: Sequence[str]) -> None:
    """Raise TypeError for unknown keyword arguments, which LeRobot's policies ignore."""
    if unknown := sorted(arguments.keys() - set(names)):
        raise TypeError(f"{name} takes no {', '.join(unknown)}: it takes {', '.join(names)}")
