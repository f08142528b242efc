"""A policy's decision as one compiled program, for small computers."""

from __future__ import annotations

import copy
import hashlib
import json
import platform
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from warmprior import keys
from warmprior.checks import check_keys, check_shape
from warmprior.deploy.observation import observation_shapes
from warmprior.history import ENTRIES, advance, cold_history, history_keys
from warmprior.io.files import check_regular, file_digest, read_json, write_atomic
from warmprior.io.workers import torch_threads
from warmprior.modules.actor import WarmPriorActor, check_usual_keys
from warmprior.modules.generator import Drawing
from warmprior.modules.network import VelocityNetwork, uncompiled
from warmprior.modules.normalize import Normalizer
from warmprior.modules.prior import Prior
from warmprior.modules.recording import Recording
from warmprior.modules.registry import from_config
from warmprior.modules.sampling import effective_temperature

FIELDS = {
    *("program", "torch", "processor", "prior", "nfe", "temperature", "inputs"),
    *("observation_key", "observation_steps", "action_dim", "shapes", "normalizer", "recording"),
}
"""The entries that the description of an exported policy holds."""


class _Draws(TorchFunctionMode):
    """Lets the source take its normal draws from outside, in their order, and notes shapes and dtypes."""

    def __init__(self, given: Iterable[Tensor] | None = None) -> None:
        super().__init__()
        self.given = None if given is None else iter(given)
        self.drawn: list[tuple[torch.Size, torch.dtype]] = []

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is not torch.randn:
            return func(*args, **(kwargs or {}))
        drawn = func(*args, **(kwargs or {})) if self.given is None else next(self.given)
        self.drawn.append((drawn.shape, drawn.dtype))
        return drawn


class _Decision(nn.Module):
    """A policy as a function of tensors: the observation, the history's entries, then draws -> the chunk."""

    def __init__(self, policy: WarmPriorActor) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, observation: Tensor, *others: Tensor) -> Tensor:
        history = TensorDict(dict(zip(ENTRIES, others, strict=False)))
        data = TensorDict({self.policy.observation_key: observation, keys.HISTORY: history})
        with _Draws(others[len(ENTRIES) :]):
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
        ValueError: if the policy has guidance, a start point, an image encoder or keys of its own; if the
            program decides otherwise than the policy; or if the path does not end in ``.pt2``, or its JSON
            file is another one.
        TypeError: if the network is not a :class:`VelocityNetwork`.
        RuntimeError: if no C++ compiler works here.

    Examples:
        >>> from warmprior import PastPrior, VelocityMLP, WarmPriorActor
        >>> from warmprior.deploy import export_policy
        >>> actor = WarmPriorActor(VelocityMLP(2, 3, 4), PastPrior(4))
        >>> export_policy(actor, "policy.onnx")
        Traceback (most recent call last):
            ...
        ValueError: policy.onnx: the name of an exported policy ends in .pt2
    """
    # A copy, because evaluation mode and the CPU are not for the caller's policy.
    path, policy = Path(path), copy.deepcopy(uncompiled(policy))
    if path.suffix != ".pt2":
        raise ValueError(f"{path}: the name of an exported policy ends in .pt2")
    described = path.with_suffix(".json")
    if described.exists() and "program" not in read_json(described):
        raise ValueError(
            f"{described} is no exported policy's, and would be overwritten: choose another name"
        )
    check_usual_keys(policy, "export_policy")
    network = uncompiled(policy.network)
    if not isinstance(network, VelocityNetwork):
        raise TypeError(f"cannot export {type(network).__name__}: only subclasses of VelocityNetwork")
    for has, what in (
        (policy.ode.guidance is not None, "Real-Time Chunking, which needs gradients"),
        (policy.start is not None, "a start point"),
        (getattr(network, "encodes", False), "an image encoder"),
    ):
        if has:
            raise ValueError(f"a policy with {what} cannot be exported: run the policy itself")
    fixed = policy.replace(
        nfe=policy.sampling.evaluations(nfe),
        temperature=effective_temperature(policy.sampling.temperature),
        generator=None,
    ).to("cpu")
    prior = fixed.prior
    decision = _Decision(fixed.eval())
    with torch.no_grad(), torch_threads(1), torch.random.fork_rng([]), TemporaryDirectory() as folder:
        torch.manual_seed(0)
        dtype = next((p.dtype for p in network.parameters()), torch.float32)
        history = cold_history(
            [], prior.history_length, prior.prediction_length, network.action_dim, dtype=dtype
        )
        chunk = torch.randn(history["forecast"].shape, dtype=dtype)
        later = advance(history, chunk, torch.tensor([prior.chunk_length]))
        observation = torch.randn(network.observation_steps, network.observation_dim, dtype=dtype)
        cases = [(observation, *(state[name] for name in ENTRIES)) for state in (history, later)]
        with _Draws() as noted:
            fixed(TensorDict({fixed.observation_key: observation, keys.HISTORY: history}))
        draws = [torch.randn(shape, dtype=kind) for shape, kind in noted.drawn]
        try:
            program = torch.export.export(decision, (*cases[0], *draws), strict=False)
        except Exception as error:
            raise ValueError(f"torch.export cannot follow {prior}: {_first_line(error)}") from error
        # What is not a draw of torch.randn became a constant.
        for case in cases:
            if not torch.allclose(program.module()(*case, *draws), decision(*case, *draws), atol=1e-4):
                raise ValueError(
                    f"the exported program decides otherwise than the policy: let {prior} draw by "
                    "torch.randn alone, and keep no state"
                )
        compiled = Path(folder) / "policy.pt2"
        try:
            torch._inductor.aoti_compile_and_package(program, package_path=str(compiled))
        except Exception as error:
            raise RuntimeError(
                f"the policy cannot be compiled here: {_first_line(error)}. Is a C++ compiler installed?"
            ) from error
        description = {
            "program": file_digest(compiled),
            **_machine(),
            "prior": prior.config(),
            "nfe": fixed.sampling.nfe,
            "temperature": fixed.sampling.temperature,
            "inputs": [[list(value.shape), str(value.dtype)] for value in (*cases[0], *draws)],
            "observation_key": fixed.observation_key,
            "observation_steps": network.observation_steps,
            "action_dim": network.action_dim,
            "shapes": {name: list(shape) for name, shape in (observation_shapes(policy) or {}).items()},
            "normalizer": None if policy.normalizer is None else _as_lists(policy.normalizer),
            "recording": None if policy.recording is None else asdict(policy.recording),
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, lambda target: target.write_bytes(compiled.read_bytes()))
        text = json.dumps(description, indent=2) + "\n"
        write_atomic(described, lambda target: target.write_text(text))
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
    if lacking := FIELDS - (description.keys() if isinstance(description, dict) else set()):
        lacks = ", ".join(sorted(lacking))
        raise ValueError(f"{path.with_suffix('.json')} lacks {lacks}: export the policy again")
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
        recording: what it was trained on.
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
        self.device = torch.device("cpu")
        key = description["observation_key"]
        self.observation_key = tuple(key) if isinstance(key, list) else key
        self.in_keys = [self.observation_key, *history_keys()]
        self.out_keys = [keys.CHUNK]
        self._inputs = [(tuple(shape), getattr(torch, kind[6:])) for shape, kind in description["inputs"]]
        self.recording = description["recording"] and Recording(**description["recording"])
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
        """Draw the source's noise, and write the chunk ``[P, d_a]`` of one decision.

        Raises ValueError if an entry has another shape: native code does not check what it reads.
        """
        check_keys(tensordict, self.in_keys, type(self).__name__)
        generator, count = self.chosen_generator(generator), len(self.in_keys)
        entries = []
        for key, (shape, dtype) in zip(self.in_keys, self._inputs, strict=False):
            check_shape(str(key), value := tensordict.get(key), shape)
            entries.append(value.to("cpu", dtype).contiguous())
        draws = (torch.randn(s, dtype=d, generator=generator) for s, d in self._inputs[count:])
        return tensordict.set(keys.CHUNK, self._run(*entries, *draws))


def _first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {str(error).strip().partition(chr(10))[0]}"


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
