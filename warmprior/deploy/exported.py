"""A policy's decision as one compiled program, for small computers."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from warmprior import keys
from warmprior.deploy.observation import observation_shapes
from warmprior.history import cold_history
from warmprior.io.files import check_regular, file_digest, read_json, write_atomic
from warmprior.io.workers import torch_threads
from warmprior.modules.actor import WarmPriorActor, check_usual_keys
from warmprior.modules.generator import Drawing
from warmprior.modules.network import uncompiled
from warmprior.modules.normalize import Normalizer
from warmprior.modules.prior import Prior, noise_factor
from warmprior.modules.registry import from_config

HISTORY_ENTRIES = ("actions", "steps", "forecast", "forecast_steps")


class _Draws(TorchFunctionMode):
    """Lets the source take its normal draws from outside, in their order, and notes their shapes."""

    def __init__(self, given: Iterable[Tensor] | None = None) -> None:
        super().__init__()
        self.given = None if given is None else iter(given)
        self.shapes: list[list[int]] = []

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is not torch.randn:
            return func(*args, **(kwargs or {}))
        drawn = func(*args, **(kwargs or {})) if self.given is None else next(self.given)
        self.shapes.append(list(drawn.shape))
        return drawn


class _Decision(nn.Module):
    """A policy as a function of tensors: the observation, the history's entries, then draws -> the chunk."""

    def __init__(self, policy: WarmPriorActor) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, observation: Tensor, *others: Tensor) -> Tensor:
        history = TensorDict(dict(zip(HISTORY_ENTRIES, others, strict=False)))
        data = TensorDict({self.policy.observation_key: observation, keys.HISTORY: history})
        with _Draws(others[len(HISTORY_ENTRIES) :]):
            return self.policy(data)[keys.CHUNK]


def export_policy(policy: WarmPriorActor, path: str | Path, *, nfe: int | None = None) -> Path:
    """Compile a policy's whole decision for this machine: the source, and the flow at a fixed NFE.

    The program is written to ``path``, which ends in ``.pt2``, and its description to a JSON file beside it.
    :func:`load_exported` loads both. Draws stay outside of the program, so it takes any generator.

    The program is native code for this processor and this version of PyTorch: export on the robot's own
    computer, which needs a C++ compiler.

    Args:
        policy: the policy. Its temperature, solver and clipping become part of the program.
        path: the file to write.
        nfe: network evaluations per chunk; the policy's own by default.

    Returns:
        The path.

    Raises:
        ValueError: if the policy has guidance, a start point, an image encoder or keys of its own, or the
            path does not end in ``.pt2``.

    Examples:
        >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior.deploy import export_policy
        >>> actor = WarmPriorActor(VelocityMLP(2, 3, 4), PastPrior(4))
        >>> export_policy(actor, "policy.onnx")
        Traceback (most recent call last):
            ...
        ValueError: policy.onnx: the name of an exported policy ends in .pt2
    """
    path, policy = Path(path), uncompiled(policy)
    if path.suffix != ".pt2":
        raise ValueError(f"{path}: the name of an exported policy ends in .pt2")
    check_usual_keys(policy, "export_policy")
    network = uncompiled(policy.network)
    for has, what in (
        (policy.ode.guidance is not None, "Real-Time Chunking, which needs gradients"),
        (policy.start is not None, "a start point"),
        (getattr(network, "encodes", False), "an image encoder"),
    ):
        if has:
            raise ValueError(f"a policy with {what} cannot be exported: run the policy itself")
    fixed = policy.replace(
        nfe=policy.sampling.evaluations(nfe),
        temperature=noise_factor(policy.sampling.temperature),
        generator=None,
    ).to("cpu")
    prior = fixed.prior
    history = cold_history([], prior.history_length, prior.prediction_length, network.action_dim)
    observation = torch.zeros(network.observation_steps, network.observation_dim)
    decision, entries = _Decision(fixed.eval()), [history[name] for name in HISTORY_ENTRIES]
    with torch.no_grad(), torch_threads(1), torch.random.fork_rng([]), TemporaryDirectory() as folder:
        with _Draws() as noted:
            fixed(TensorDict({fixed.observation_key: observation, keys.HISTORY: history}))
        draws = [torch.randn(shape) for shape in noted.shapes]
        program = torch.export.export(decision, (observation, *entries, *draws), strict=False)
        for node in program.graph.nodes:
            if torch.Tag.nondeterministic_seeded in getattr(node.target, "tags", ()):
                raise ValueError(
                    f"{prior} draws by {node.target}, and an exported policy takes the draws of torch.randn "
                    "alone from outside: use torch.randn in its source"
                )
        compiled = Path(folder) / "policy.pt2"
        torch._inductor.aoti_compile_and_package(program, package_path=str(compiled))
        description = {
            "program": file_digest(compiled),
            **_machine(),
            "prior": prior.config(),
            "nfe": fixed.sampling.nfe,
            "temperature": fixed.sampling.temperature,
            "draws": noted.shapes,
            "observation_key": fixed.observation_key,
            "observation_steps": network.observation_steps,
            "action_dim": network.action_dim,
            "shapes": {name: list(shape) for name, shape in (observation_shapes(policy) or {}).items()},
            "normalizer": None if policy.normalizer is None else _as_lists(policy.normalizer),
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, lambda target: target.write_bytes(compiled.read_bytes()))
        text = json.dumps(description, indent=2) + "\n"
        write_atomic(path.with_suffix(".json"), lambda target: target.write_text(text))
    return path


def load_exported(path: str | Path) -> ExportedPolicy:
    """Load a policy that :func:`export_policy` wrote on this machine.

    **The file holds native code, which runs when it is loaded.** Load only what you exported yourself;
    nothing else in this library loads such a file, and none is pushed to the hub.

    Args:
        path: the ``.pt2`` file.

    Raises:
        FileNotFoundError: if the file or the JSON beside it is missing.
        ValueError: if the two do not belong together, or were written by another version of PyTorch or for
            another processor.

    Examples:
        >>> from warmprior.deploy import load_exported
        >>> load_exported("nowhere/policy.pt2")
        Traceback (most recent call last):
            ...
        FileNotFoundError: ...
    """
    path = Path(path)
    check_regular(path)
    description = read_json(path.with_suffix(".json"))
    program = path.read_bytes()
    if description["program"] != hashlib.sha256(program).hexdigest():
        raise ValueError(
            f"{path} is not the program that {path.with_suffix('.json')} describes: export again"
        )
    for name, here in _machine().items():
        if description[name] != here:
            raise ValueError(
                f"{path} was exported for {name} {description[name]}, and this is {here}: export on the robot"
            )
    return ExportedPolicy(description, program)


class ExportedPolicy(Drawing, TensorDictModuleBase):
    """A compiled decision, in place of a :class:`~warmprior.WarmPriorActor` that acts alone on a CPU.

    Like the policy, it reads the normalised observation and the history, and writes the chunk; with equal
    generators both return the same, up to rounding. :class:`AsyncExecutor` takes it.

    Attributes:
        prior: the source, of which only the lengths are used.
        normalizer: the policy's normaliser.
        shapes: the shapes of the observation at one step, by name.

    Examples:
        >>> from warmprior.deploy import ExportedPolicy, load_exported
        >>> load_exported.__annotations__["return"]
        'ExportedPolicy'
    """

    def __init__(self, description: dict[str, Any], program: bytes) -> None:
        super().__init__()
        self.prior = from_config(Prior, description["prior"])
        self.shapes = {name: tuple(shape) for name, shape in description["shapes"].items()}
        self.action_dim, self.observation_steps = description["action_dim"], description["observation_steps"]
        self.generator: torch.Generator | None = None
        self.device = torch.device("cpu")
        key = description["observation_key"]
        self.observation_key = tuple(key) if isinstance(key, list) else key
        self.in_keys = [self.observation_key, *((keys.HISTORY, name) for name in HISTORY_ENTRIES)]
        self.out_keys = [keys.CHUNK]
        self._draws = description["draws"]
        self.normalizer: Normalizer | None = None
        if (stored := description["normalizer"]) is not None:
            self.normalizer = Normalizer.from_config(stored)
            self.normalizer.load_state_dict(
                {name: torch.tensor(value) for name, value in stored["values"].items()}
            )
        with TemporaryDirectory() as folder:
            file = Path(folder) / "policy.pt2"
            file.write_bytes(program)
            self._run = torch._inductor.aoti_load_package(str(file))

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase, generator: torch.Generator | None = None) -> TensorDictBase:
        """Draw the source's noise, and write the chunk ``[P, d_a]`` of one decision."""
        generator = self.chosen_generator(generator)
        draws = (torch.randn(shape, generator=generator) for shape in self._draws)
        return tensordict.set(keys.CHUNK, self._run(*(tensordict.get(key) for key in self.in_keys), *draws))


def _as_lists(normalizer: Normalizer) -> dict[str, Any]:
    values = {name: value.tolist() for name, value in normalizer.state_dict().items()}
    return {**normalizer.config(), "values": values}


def _machine() -> dict[str, str]:
    """Return what native code depends on."""
    return {"torch": torch.__version__, "processor": _processor()}


def _processor() -> str:
    """Return the processor's name and the instructions that PyTorch uses."""
    named = platform.processor()
    info = Path("/proc/cpuinfo")
    for line in info.read_text().splitlines() if info.is_file() else ():
        name, _, value = line.partition(":")
        if name.strip() in ("model name", "Model"):
            named = value.strip()
            break
    return f"{platform.machine()} {named} {torch.backends.cpu.get_cpu_capability()}"
