"""Demonstrations to damage in every format, and the ways to do so."""

import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase

pytest.importorskip("robosuite")
pytest.importorskip("pyarrow")
pytest.importorskip("minari")

import h5py
import minari
import numpy as np
import pyarrow.parquet as parquet
from minari.data_collector import EpisodeBuffer

from tests.data.hdf5_faults import FAULTS, NUMBERS, replace
from tests.data.synthetic import env_args_15, write_robomimic_file
from tests.fuzz.damage import Case, damage, damage_content, odd_json
from tests.fuzz.sandbox import Outcome
from warmprior.data import convert_robomimic
from warmprior.data.formats.hdf5 import RobomimicDemonstrations
from warmprior.data.formats.lerobot import LeRobotDemonstrations
from warmprior.data.formats.minari import MinariDemonstrations


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
    """Return True if h5py alone reads the same."""
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
        simulator = meta.get("type", 1)
        if isinstance(simulator, int) and simulator != 1:
            meta = {}  # no environment that can be built
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
    """Return True if pyarrow alone reads the same."""
    seen = ["observation.environment_state", "observation.state"]
    read = [*seen, "action", "next.reward", "episode_index"]  # damage of others is met by nobody
    table = parquet.read_table(folder / "data/chunk-000/file-000.parquet", columns=read)
    rows = np.array(table["episode_index"]) == 0 if mask else np.s_[:]

    def columns(*names: str) -> torch.Tensor:
        values = [np.array(table[name].to_pylist()).reshape(len(table), -1) for name in names]
        return torch.from_numpy(np.concatenate(values, -1)[rows]).float()

    pairs = [
        (data["observation"], columns(*seen)),
        (data["next", "reward"], columns("next.reward")),
    ]
    if actions == "delta":
        pairs.append((data["action"], columns("action")))
    return all(torch.equal(mine, theirs) for mine, theirs in pairs)


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
