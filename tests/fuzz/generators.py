"""Files to damage, and the ways to do so: demonstrations, policies, training states and results."""

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

pytest.importorskip("robosuite")
pytest.importorskip("pyarrow")
pytest.importorskip("lerobot_policy_warmprior")
pytest.importorskip("minari")

import h5py
import minari
import numpy as np
import pyarrow.parquet as parquet
from lerobot_policy_warmprior.modeling_warm_flow import WarmFlowPolicy
from minari.data_collector import EpisodeBuffer

from lab.options.options import Options, with_parts
from lab.options.presets import PRESETS
from lab.options.stored_options import recorded, stored_options
from lab.reporting.rows import PLAYED, read_rows
from tests.data.hdf5_faults import FAULTS, NUMBERS, replace
from tests.data.synthetic import env_args_15, write_robomimic_file
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
from warmprior.data import convert_robomimic
from warmprior.data.formats.hdf5 import RobomimicDemonstrations
from warmprior.data.formats.lerobot import LeRobotDemonstrations
from warmprior.data.formats.minari import MinariDemonstrations
from warmprior.history import cold_history
from warmprior.saving.checkpoint import load_state, module_tensors, named, save_state, snapshot_optimizer
from warmprior.saving.policies import load_policy, policy_config, save_policy

Case = tuple[str, Callable[[], Outcome], str]
"""How a file was damaged, the load to attempt, and what its error has to name."""

ODD_VALUES: tuple[Any, ...] = (
    *(None, True, 0, -1, 3, 10**5, 10**9, 10**30, 0.5, -0.5, 1e308, float("nan"), float("inf")),
    *("", "x", "9", [], [1, 2], {}, {"name": "past"}, [[[[]]]]),
)


def damage(path: Path, rng: np.random.Generator) -> str:
    """Change the bytes of a file; returns how."""
    content = bytearray(path.read_bytes())
    size = len(content)
    how = str(rng.choice(["flip", "flip", "flip", "head", "cut", "append", "zero", "shuffle"]))
    # Half of the flips hit the beginning, where headers and metadata are.
    end = size if rng.random() < 0.5 else max(1, min(size, 4096))
    if how == "flip":
        for place in rng.integers(end, size=int(rng.integers(1, 9))):
            content[place] ^= 1 << int(rng.integers(8))
    elif how == "head":
        place = int(rng.integers(min(16, size)))
        content[place] = int(rng.integers(256))
    elif how == "cut":
        del content[int(rng.integers(size)) :]
    elif how == "append":
        content += rng.bytes(int(rng.integers(1, 5000)))
    else:
        start = int(rng.integers(end))
        length = int(rng.integers(1, 2000))
        block = content[start : start + length]
        new = bytes(len(block)) if how == "zero" else rng.bytes(len(block))
        content[start : start + length] = new
    path.write_bytes(content)
    return how


def odd_json(value: Any, rng: np.random.Generator) -> str:
    """Replace, remove or add one entry somewhere in parsed JSON, in place; returns where."""
    places: list[tuple[Any, Any]] = []

    def walk(node: Any) -> None:
        items = node.items() if isinstance(node, dict) else enumerate(node)
        for key, child in items:
            places.append((node, key))
            if isinstance(child, dict | list):
                walk(child)

    walk(value)
    node, key = places[int(rng.integers(len(places)))]
    if rng.random() < 0.2:
        del node[key]
        return f"no {key}"
    new = ODD_VALUES[int(rng.integers(len(ODD_VALUES)))]
    node[key] = new
    return f"{key} = {new!r}"


def damage_content(path: Path, rng: np.random.Generator) -> str:
    """Damage a file, or, where it is JSON, mostly one of its entries; returns how."""
    if path.suffix != ".json" or rng.random() >= 0.7:
        return damage(path, rng)
    content = json.loads(path.read_text())
    how = odd_json(content, rng)
    path.write_text(json.dumps(content))
    return how


def make_demonstrations(folder: Path) -> None:
    write_robomimic_file(folder / "plain.hdf5", masks={"train": [0, 2]})
    write_robomimic_file(folder / "packed.hdf5", masks={"train": [0, 2]})
    with h5py.File(folder / "packed.hdf5", "a") as file:
        for demo in file["data"].values():
            for key in (*NUMBERS, "obs/robot0_gripper_qpos"):
                values = demo[key][()]
                packed = {"chunks": (4, *values.shape[1:]), "compression": "gzip", "fletcher32": True}
                replace(demo, key, data=values, **packed)


def _odd_env_args(file, rng):
    meta = env_args_15("square")
    how = odd_json(meta, rng)
    file["data"].attrs["env_args"] = json.dumps(meta)
    return how


def _odd_mask(file, rng):
    del file["mask/train"]
    values = [np.zeros((2, 2)), np.arange(2), h5py.Empty("S4"), np.array([b"\xff"]), 3.0]
    file["mask/train"] = values[int(rng.integers(len(values)))]


def mutate_demonstrations(folder: Path, rng: np.random.Generator) -> Case:
    whole = folder / str(rng.choice(["plain.hdf5", "packed.hdf5"]))
    path = folder / "case.hdf5"
    path.write_bytes(whole.read_bytes())
    must_refuse, masked = False, bool(rng.random() < 0.3)
    kind = rng.random()
    if kind < 0.5:
        how = damage(path, rng)
    else:
        with h5py.File(path, "a") as file:
            if kind < 0.6:
                how = "env_args " + _odd_env_args(file, rng)
            elif kind < 0.65:
                how, must_refuse, masked = "mask", True, True
                _odd_mask(file, rng)
            else:
                fault = str(rng.choice(list(FAULTS)))
                name = f"data/demo_{rng.choice([0, 2])}/{rng.choice(NUMBERS)}"
                how, must_refuse = f"{fault} {name}", True
                FAULTS[fault](file, name, folder)
    mask, actions = "train" if masked else None, "absolute" if rng.random() < 0.3 else "delta"

    def load() -> Outcome:
        read = RobomimicDemonstrations(path, mask=mask)
        data = read.steps(actions=actions)
        if must_refuse:
            return Outcome("silent", "was read")
        undamaged = RobomimicDemonstrations(whole, mask=mask)
        expected = undamaged.steps(actions=actions)
        equal = data.shape == expected.shape and bool((data == expected).all())
        if equal and read.index().env_args == undamaged.index().env_args:
            return Outcome("equal")
        # HDF5 keeps no checksum of plain values: then the file must say so to any reader.
        return Outcome("as stored") if _says_so(read, data, actions) else Outcome("silent", "differs")

    return how, load, str(path)


def _says_so(read: RobomimicDemonstrations, data: TensorDictBase, actions: str) -> bool:
    """Whether h5py alone reads the same."""
    index = read.index()
    with h5py.File(read.path) as file:
        demos = sorted(file["data"], key=lambda name: int(name[5:]))
        if read.mask:
            demos = [demo for demo in demos if demo.encode() in set(file["mask/train"][()])]
        values = [
            np.concatenate([file[f"data/{demo}/obs/{key}"][()] for key in index.observation_keys], -1)
            for demo in demos
        ]
        deltas = np.concatenate([file[f"data/{demo}/actions"][()] for demo in demos])
        meta = json.loads(file["data"].attrs["env_args"])
        rewards = np.concatenate([file[f"data/{demo}/rewards"][()].reshape(-1) for demo in demos])
    pairs = [(data["observation"], np.concatenate(values)), (data["next", "reward"][:, 0], rewards)]
    if actions == "delta":
        pairs.append((data["action"], deltas))
    equal = all(torch.equal(mine, torch.from_numpy(theirs).float()) for mine, theirs in pairs)
    return equal and index.env_args == meta


def make_datasets(folder: Path) -> None:
    path = folder / "lift.hdf5"
    write_robomimic_file(path, lengths=(6, 9), task="lift", masks={"train": [0]})
    convert_robomimic(path, folder / "whole")


def mutate_datasets(folder: Path, rng: np.random.Generator) -> Case:
    """Damage a file of a dataset: its bytes, or, where it is JSON, also an entry."""
    whole, case = folder / "whole", folder / "case"
    shutil.rmtree(case, ignore_errors=True)
    shutil.copytree(whole, case)
    # What LeRobot's own statistics and tasks are is read by nobody here.
    unread = ("stats.json", "tasks.parquet")
    files = sorted(p for p in case.rglob("*") if p.is_file() and p.name not in unread)
    path = files[int(rng.integers(len(files)))]
    how = damage_content(path, rng)
    mask = "train" if rng.random() < 0.3 else None
    actions = "absolute" if rng.random() < 0.3 else "delta"

    def load() -> Outcome:
        read, undamaged = (LeRobotDemonstrations(place, mask=mask) for place in (case, whole))
        data, expected = (place.steps(actions=actions) for place in (read, undamaged))
        equal = data.shape == expected.shape and bool((data == expected).all())
        if equal and read.index().env_args == undamaged.index().env_args:
            return Outcome("equal")
        # Neither JSON nor parquet, as LeRobot writes it, keeps a checksum: another option of the environment,
        # or another number, is another recording's.
        stored = equal if path.suffix == ".json" else _table_says_so(case, data, mask, actions)
        ok = stored and read.index().task == undamaged.index().task
        return Outcome("as stored") if ok else Outcome("silent", "differs")

    return f"{path.relative_to(case)} {how}", load, str(case)


def _table_says_so(folder: Path, data: TensorDictBase, mask: str | None, actions: str) -> bool:
    """Whether pyarrow alone reads the same."""
    table = parquet.read_table(folder / "data/chunk-000/file-000.parquet")
    rows = np.array(table["episode_index"]) == 0 if mask else np.s_[:]

    def columns(*names: str) -> torch.Tensor:
        values = [np.array(table[name].to_pylist()).reshape(len(table), -1) for name in names]
        return torch.from_numpy(np.concatenate(values, -1)[rows]).float()

    pairs = [
        (data["observation"], columns("observation.environment_state", "observation.state")),
        (data["next", "reward"], columns("next.reward")),
    ]
    if actions == "delta":
        pairs.append((data["action"], columns("action")))
    return all(torch.equal(mine, theirs) for mine, theirs in pairs)


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
        "chi": ChiTransformer(2, 5, 3, embedding_dim=8, num_layers=1, num_heads=2),
    }
    for name, network in networks.items():
        actor = WarmPriorActor(network, PastPrior(3), nfe=2, clip=1.0, normalizer=Normalizer.fit(data))
        save_policy(actor, folder / name)


def make_states(folder: Path) -> None:
    training(folder / "whole", CONFIG).run(None)


def damaged_copy(whole: Path, case: Path, rng: np.random.Generator) -> str:
    """Copy a file into another folder, and damage it there; returns how."""
    case.mkdir(exist_ok=True)
    (case / whole.name).write_bytes(whole.read_bytes())
    return damage(case / whole.name, rng)


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


MINARI = "toy/walk/human-v0"


def make_minari(folder: Path) -> None:
    rng = np.random.default_rng(0)
    for place, form in (("whole", "hdf5"), ("tables", "parquet")):
        os.environ["MINARI_DATASETS_PATH"] = str(folder / place)
        buffers = [
            EpisodeBuffer(
                id=i,
                observations=rng.uniform(-1, 1, (n + 1, 3)).astype(np.float32),
                actions=rng.uniform(-1, 1, (n, 1)).astype(np.float32),
                rewards=rng.uniform(size=n).tolist(),
                terminations=[False] * n,
                truncations=[False] * (n - 1) + [True],
            )
            for i, n in enumerate((7, 12))
        ]
        minari.create_dataset_from_buffers(MINARI, buffers, env="Pendulum-v1", data_format=form)


def mutate_minari(folder: Path, rng: np.random.Generator) -> Case:
    """Damage a file of a dataset: its bytes, an entry of its JSON, or an array of HDF5."""
    whole, case = folder / str(rng.choice(["whole", "whole", "tables"])), folder / "case"
    shutil.rmtree(case, ignore_errors=True)
    shutil.copytree(whole, case)
    must_refuse = False
    if whole.name == "whole" and rng.random() < 0.4:
        fault = str(rng.choice(sorted(FAULTS.keys() - {"all with many rows"})))
        name = f"episode_{rng.choice(2)}/{rng.choice(['actions', 'rewards', 'observations'])}"
        how, must_refuse = f"{fault} {name}", True
        with h5py.File(case / MINARI / "data/main_data.hdf5", "a") as file:
            FAULTS[fault](file, name, folder)
    else:
        files = sorted(p for p in (case / MINARI / "data").rglob("*") if p.is_file())
        path = files[int(rng.integers(len(files)))]
        inside = path.parent.name == "data" and path.suffix == ".json" and rng.random() < 0.6
        how = f"{path.name} {_odd_text(path, rng) if inside else damage_content(path, rng)}"

    def read(place: Path) -> tuple[TensorDictBase, dict[str, Any]]:
        os.environ["MINARI_DATASETS_PATH"] = str(place)
        demonstrations = MinariDemonstrations(MINARI)
        return demonstrations.steps(), demonstrations.environment(demonstrations.index())

    def load() -> Outcome:
        (data, environment), (expected, recorded) = read(case), read(whole)
        if must_refuse:
            return Outcome("silent", "was read")
        equal = data.shape == expected.shape and bool((data == expected).all())
        if equal and environment == recorded:
            return Outcome("equal")
        # Neither plain HDF5, parquet nor JSON keeps a checksum: then any reader finds the same.
        ok = _minari_says_so(case, data, environment)
        return Outcome("as stored") if ok else Outcome("silent", "differs")

    return how, load, str(case)


def _odd_text(path: Path, rng: np.random.Generator) -> str:
    """Change an entry of the JSON that is a text in Minari's metadata; returns where."""
    content = json.loads(path.read_text())
    name = str(rng.choice(["env_spec", "observation_space", "action_space"]))
    inner = json.loads(content[name])
    how = odd_json(inner, rng)
    path.write_text(json.dumps(content | {name: json.dumps(inner)}))
    return f"{name}: {how}"


def _minari_says_so(folder: Path, data: TensorDictBase, environment: dict[str, Any]) -> bool:
    """Return True if Minari alone reads the same."""
    os.environ["MINARI_DATASETS_PATH"] = str(folder)
    dataset = minari.load_dataset(MINARI)
    episodes = list(dataset.iterate_episodes())
    pairs = [
        (data["observation"], [episode.observations[:-1] for episode in episodes]),
        (data["action"], [episode.actions for episode in episodes]),
        (data["next", "reward"][:, 0], [episode.rewards for episode in episodes]),
    ]
    equal = all(torch.equal(mine, torch.from_numpy(np.concatenate(own)).float()) for mine, own in pairs)
    spec = dataset.env_spec
    if spec is None:
        return equal and not environment
    described = environment["gymnasium"]
    return equal and all(
        described[name] == getattr(spec, name) for name in ("id", "kwargs", "max_episode_steps")
    )


def make_plugin(folder: Path) -> None:
    flow_policy({"warm_flow": WarmFlowPolicy}).save_pretrained(folder / "whole")


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
        action = policy.select_action(one_observation())
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
