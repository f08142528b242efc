"""Files to damage, and the ways to do so: policies, training states, results and options."""

import json
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

pytest.importorskip("robosuite")
pytest.importorskip("lerobot_policy_warmprior")

import numpy as np
from lerobot_policy_warmprior.modeling_warm_flow import WarmFlowPolicy

from lab.options.options import Options, with_parts
from lab.options.presets import PRESETS
from lab.options.stored_options import recorded, stored_options
from lab.reporting.rows import PLAYED, read_rows
from tests.fuzz.damage import Case, damage, damage_content, damaged_copy, odd_json
from tests.fuzz.datasets import (
    make_datasets,
    make_demonstrations,
    make_minari,
    mutate_datasets,
    mutate_demonstrations,
    mutate_minari,
)
from tests.fuzz.sandbox import Outcome
from tests.lab.reporting.test_rows import ROW
from tests.lerobot.plugin_policies import flow_policy, one_observation
from tests.states import same
from tests.training.cloning_parts import CONFIG, training
from warmprior import (
    ChiTransformer,
    Normalizer,
    PastPrior,
    PreconditionedNetwork,
    VelocityMLP,
    WarmPriorActor,
)
from warmprior.history import cold_history
from warmprior.modules.recording import Recording
from warmprior.saving.policies import load_policy, policy_config, save_policy
from warmprior.saving.training_state import load_state, module_tensors, named, save_state, snapshot_optimizer


def make_rows(folder: Path) -> None:
    rows = [ROW | {"seed": seed, "nfe": nfe, "policy": f"past-{seed}"} for seed in (0, 1) for nfe in (9, 1)]
    (folder / "results.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))


def mutate_rows(folder: Path, rng: np.random.Generator) -> Case:
    whole, path = folder / "results.jsonl", folder / "case.jsonl"
    rows = [json.loads(line) for line in whole.read_text().splitlines()]
    if rng.random() < 0.7:
        how = odd_json(rows, rng)
        path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    elif rng.random() < 0.3:
        how = "a row twice"
        path.write_text("".join(json.dumps(row) + "\n" for row in [*rows, rows[int(rng.integers(4))]]))
    else:
        path.write_bytes(whole.read_bytes())
        how = damage(path, rng)

    def load() -> Outcome:
        found, expected = read_rows(path, PLAYED), read_rows(whole, PLAYED)
        if found == expected:
            return Outcome("equal")
        # A row less, which is computed again, or another number of one that could be.
        texts = [json.loads(line) for line in path.read_text().splitlines()]
        return Outcome("as stored") if found == texts else Outcome("silent", "differs")

    return how, load, str(path)


def make_options(folder: Path) -> None:
    (folder / "case").mkdir()
    path = folder / "lift.hdf5"
    path.touch()
    options = with_parts(PRESETS["quick"], data={"dataset": path, "task": ("lift",), "demonstrations": ()})
    record = {"study": "robomimic", "options": recorded(options)}
    (folder / "options.json").write_text(json.dumps(record, indent=1))


def mutate_options(folder: Path, rng: np.random.Generator) -> Case:
    whole, path = folder / "options.json", folder / "case" / "options.json"
    path.write_bytes(whole.read_bytes())
    how = damage_content(path, rng)

    def load() -> Outcome:
        options = stored_options(Options, path.parent, "robomimic")
        try:
            options.check()
        except (ValueError, OSError) as error:  # which names the option
            return Outcome("refused" if "--" in str(error) else "unclear", str(error))
        tree = json.loads(path.read_bytes())["options"]
        equal = tree == json.loads(whole.read_text())["options"]
        found = recorded(options) == tree
        return Outcome("equal" if equal else "as stored") if found else Outcome("silent", "differs")

    return how, load, str(path)


def make_policies(folder: Path) -> None:
    torch.manual_seed(0)
    data = TensorDict({"observation": torch.randn(50, 5), "action": torch.randn(50, 2)}, [50])
    networks = {
        "mlp": PreconditionedNetwork(VelocityMLP(2, 5, 3, 2, hidden_dim=16)),
        "chi": ChiTransformer(2, 5, 3, hidden_dim=8, num_layers=1, num_heads=2),
    }
    for name, network in networks.items():
        actor = WarmPriorActor(network, PastPrior(3), nfe=2, clip=1.0, normalizer=Normalizer.fit(data))
        save_policy(actor, folder / name)


def make_states(folder: Path) -> None:
    training(folder / "whole", CONFIG).run(None)


def mutate_policies(folder: Path, rng: np.random.Generator) -> Case:
    """Damage a policy; or sign another one, as anybody can who writes files."""
    whole, case = folder / str(rng.choice(["mlp", "chi"])), folder / "case"
    signed = bool(rng.random() < 0.5)
    if signed:
        tensors, config = load_state(whole / "model.safetensors")
        how = "signed: " + (odd_json(config, rng) if rng.random() < 0.7 else _odd_tensor(tensors, rng))
        save_state(case / "model.safetensors", tensors, config)
    else:
        how = damaged_copy(whole / "model.safetensors", case, rng)

    def load() -> Outcome:
        actor, expected = load_policy(case), load_policy(whole)
        if signed:
            return _plays(actor)
        equal = same(actor.state_dict(), expected.state_dict())
        if equal and policy_config(actor) == policy_config(expected):
            return Outcome("equal")
        return Outcome("silent", "differs")

    return how, load, str(case)


def _odd_tensor(tensors: dict[str, torch.Tensor], rng: np.random.Generator) -> str:
    """Replace a value, or a tensor, in place; returns how."""
    name = str(rng.choice(sorted(tensors)))
    value = float(rng.choice([np.nan, np.inf, -np.inf, 0.0, -1.0, 10.0, 1e30]))
    if rng.random() < 0.3:
        tensors[name] = tensors[name].flatten()[:-1].clone()
        return f"{name} cut"
    flat = tensors[name].view(-1)
    if not flat.is_floating_point():
        value = -1
    flat[int(rng.integers(len(flat)))] = value
    return f"{name} = {value}"


def _plays(actor: WarmPriorActor) -> Outcome:
    """Whether a policy that was loaded makes a decision, and of numbers."""
    data = TensorDict({actor.observation_key: torch.zeros(1, 2, 5)}, [1])
    lengths = actor.prior.history_length, actor.prior.prediction_length
    data.set(actor.history_key, cold_history([1], *lengths, 2))
    with torch.no_grad():
        chunk = actor(data, nfe=1)[actor.tensor_keys["chunk_key"]]
    good = bool(torch.isfinite(chunk).all()) and chunk.shape == (1, actor.prior.prediction_length, 2)
    return Outcome("as stored") if good else Outcome("silent", f"{chunk.shape}, or not finite")


def mutate_states(folder: Path, rng: np.random.Generator) -> Case:
    whole, case = folder / "whole" / "state.safetensors", folder / "case"
    how = damaged_copy(whole, case, rng)

    def load() -> Outcome:
        cloning = training(case, CONFIG)
        stored, facts = load_state(whole)
        mine = {
            **named("trained", module_tensors(cloning.update.trained)),
            **named("ema", module_tensors(cloning.update.ema)),
            **named("optimizer", snapshot_optimizer(cloning.update.optimizer)),
        }
        restored = same(mine, {name: stored[name] for name in mine})
        progress = {"iteration": cloning.iteration, "losses": [list(pair) for pair in cloning.losses]}
        equal = restored and progress.items() <= facts.items()
        return Outcome("equal") if equal else Outcome("silent", "differs")

    return how, load, str(case / whole.name)


@dataclass(frozen=True)
class Subject:
    """A kind of file: ``make`` writes whole ones into a folder, and ``mutate`` damages a copy of one."""

    name: str
    make: Callable[[Path], None]
    mutate: Callable[[Path, np.random.Generator], Case]


def make_plugin(folder: Path) -> None:
    seen = {"observation.environment_state": 2, "observation.state": 3}
    recording = json.dumps(asdict(Recording("arm", 2, 60, "[2], as recorded", seen, rate=30)))
    flow_policy({"warm_flow": WarmFlowPolicy}, recording=recording).save_pretrained(folder / "whole")


def mutate_plugin(folder: Path, rng: np.random.Generator) -> Case:
    """Damage the configuration of a policy of LeRobot's, or the header of its weights."""
    whole, case = folder / "whole", folder / "case"
    shutil.rmtree(case, ignore_errors=True)
    shutil.copytree(whole, case)
    weights = case / "model.safetensors"
    of_weights = bool(rng.random() < 0.3)
    if of_weights:
        content = bytearray(weights.read_bytes())
        header = 8 + int.from_bytes(content[:8], "little")
        for place in rng.integers(header, size=int(rng.integers(1, 9))):
            content[place] ^= 1 << int(rng.integers(8))
        weights.write_bytes(content)
        how = "header flipped"
    else:
        how = f"config.json {damage_content(case / 'config.json', rng)}"

    def load() -> Outcome:
        policy, expected = WarmFlowPolicy.from_pretrained(case), WarmFlowPolicy.from_pretrained(whole)
        if not same(policy.state_dict(), expected.state_dict()):
            return Outcome("silent", "the weights differ")
        if policy.config == expected.config:
            return Outcome("equal")
        # Another option of the same network; nothing signs a configuration of LeRobot.
        torch.manual_seed(0)
        try:
            action = policy.select_action(one_observation())
        except KeyError as error:  # an observation of another name
            return Outcome("refused" if "config.json" in str(error) else "unclear", str(error))
        good = not of_weights and action.shape == (2, 2) and bool(action.isfinite().all())
        return Outcome("as stored") if good else Outcome("silent", f"{action.shape}, or not finite")

    return how, load, str(case)


SUBJECTS = (
    Subject("demonstration files", make_demonstrations, mutate_demonstrations),
    Subject("saved policies", make_policies, mutate_policies),
    Subject("training states", make_states, mutate_states),
    Subject("results", make_rows, mutate_rows),
    Subject("options", make_options, mutate_options),
    Subject("LeRobotDatasets", make_datasets, mutate_datasets),
    Subject("Minari's datasets", make_minari, mutate_minari),
    Subject("LeRobot's policies", make_plugin, mutate_plugin),
)
