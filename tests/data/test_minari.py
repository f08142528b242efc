"""Datasets of Minari against Minari's own reader, and their environments."""

import json
import os
import shutil
import sys
from itertools import product

import gymnasium
import h5py
import numpy as np
import pytest
import torch

from tests.data.hdf5_faults import FAULTS, damage_heap, replace
from tests.errors import missing, raises, refuses
from tests.fuzz import sandbox

minari = pytest.importorskip("minari")

from gymnasium.spaces import Box, Dict, Discrete  # noqa: E402
from minari import create_dataset_from_buffers  # noqa: E402
from minari.data_collector import EpisodeBuffer  # noqa: E402

from warmprior import PastPrior, VelocityMLP, WarmPriorActor  # noqa: E402
from warmprior.__main__ import main  # noqa: E402
from warmprior.data import DatasetError, open_demonstrations  # noqa: E402
from warmprior.data.formats.minari import MinariDemonstrations  # noqa: E402
from warmprior.envs import environment_of  # noqa: E402
from warmprior.saving import load_policy  # noqa: E402
from warmprior.tasks import Play, Task  # noqa: E402
from warmprior.training import NetworkOptions, TrainingConfig, train_policy  # noqa: E402

LENGTHS = (7, 12, 5)
VECTOR = Box(-np.inf, np.inf, (3,), np.float64)
TREE = Dict(
    {
        "arm": VECTOR,
        "goal": Dict({"place": Box(-9, 9, (2,), np.float32)}),
        "front": Box(0, 255, (16, 16, 3), np.uint8),
    }
)
ACTION, MATRIX = (Box(-1, 1, shape, np.float32) for shape in ((1,), (2, 2)))


@pytest.fixture(autouse=True)
def root(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path / "minari"


def drawn(space, rng, length):
    """Values ``[length, ...]`` of a space."""
    if isinstance(space, Dict):
        return {key: drawn(part, rng, length) for key, part in space.spaces.items()}
    if space.dtype == np.uint8:
        return rng.integers(0, 255, (length, *space.shape), dtype=np.uint8)
    if isinstance(space, Discrete):
        return rng.integers(0, space.n, length)
    return rng.uniform(-1, 1, (length, *space.shape)).astype(space.dtype)


def written(name="toy/walk/human-v0", observation=VECTOR, action=ACTION, success=True, **options):
    rng = np.random.default_rng(0)
    buffers = [
        EpisodeBuffer(
            id=i,
            observations=drawn(observation, rng, n + 1),
            actions=drawn(action, rng, n),
            rewards=rng.uniform(size=n).tolist(),
            terminations=[False] * (n - 1) + [i == 1],
            truncations=[False] * (n - 1) + [i != 1],
            infos={"success": np.arange(n) > n - 2} if success else {},
        )
        for i, n in enumerate(LENGTHS)
    ]
    create_dataset_from_buffers(name, buffers, observation_space=observation, action_space=action, **options)
    return name


@pytest.mark.parametrize("form", ["hdf5", "parquet", "arrow"])
def test_steps_are_those_of_minari(form):
    name = written(data_format=form, success=form == "hdf5")
    data = MinariDemonstrations(name).steps()
    assert data["episode"].tolist() == [i for i, n in enumerate(LENGTHS) for _ in range(n)]
    for i, episode in enumerate(minari.load_dataset(name).iterate_episodes()):
        mine = data[data["episode"] == i]
        np.testing.assert_array_equal(mine["observation"], episode.observations[:-1].astype(np.float32))
        np.testing.assert_array_equal(mine["action"], episode.actions)
        np.testing.assert_array_equal(mine["next", "reward"][:, 0], episode.rewards.astype(np.float32))
        np.testing.assert_array_equal(mine["next", "terminated"][:, 0], episode.terminations)
    assert MinariDemonstrations(name, demos=2).index().demos == ("0", "1")


def test_entries_of_dictionaries_are_chosen_by_name():
    name = written(observation=TREE)
    own = next(minari.load_dataset(name).iterate_episodes()).observations
    data = open_demonstrations(f"minari:{name}").steps(["goal/place", "arm"], ["front"])[: LENGTHS[0]]
    expected = np.concatenate([own["goal"]["place"], own["arm"]], -1)[:-1].astype(np.float32)
    np.testing.assert_array_equal(data["observation", "state"], expected)
    np.testing.assert_array_equal(data["observation", "front"], own["front"][:-1].transpose(0, 3, 1, 2))
    assert MinariDemonstrations(name).index().observation_keys == ("arm", "goal/place")
    for wrong, facts in (
        ({"observations": ["leg"]}, ("leg", "arm, goal/place")),
        ({"images": ["side"]}, ("side", "front")),
        ({"images": ["arm"]}, ("'arm'", "front", "Box")),
    ):
        with raises(DatasetError, *facts):
            MinariDemonstrations(name).steps(**wrong)


@pytest.mark.parametrize(
    ("space", "facts"),
    [
        *(({"action": Discrete(3)}, ["Discrete"]), ({"action": MATRIX}, ["(2, 2)"])),
        *(({"observation": o}, [str(o), "FlattenObservation"]) for o in (Discrete(4), MATRIX)),
    ],
)
def test_what_is_no_vector_is_refused(space, facts):
    refuses(lambda: MinariDemonstrations(written(**space)).steps(), DatasetError, *facts)


def test_what_there_is_not(root):
    with raises(FileNotFoundError, "toy/none/human-v0", "MINARI_DATASETS_PATH"):
        MinariDemonstrations("toy/none/human-v0").steps()
    name = written()
    for options, actions in (({"mask": "train"}, "delta"), ({}, "absolute"), ({"demos": 4}, "delta")):
        with pytest.raises(DatasetError):
            MinariDemonstrations(name, **options).steps(actions=actions)
    (data,) = root.rglob("main_data.hdf5")
    data.write_bytes(data.read_bytes()[:900])
    refuses(lambda: MinariDemonstrations(name).steps(), DatasetError, "walk/human-v0")


NOT_A_FLAG = {"terminations": lambda file, name, folder: replace(file, name, np.full(LENGTHS[1], np.nan))}


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        *product(("actions", "observations/arm"), sorted(FAULTS.keys() - {"all with many rows"})),
        *product(("rewards",), ("never written", "a row less", "a row more")),
        *product(("terminations",), ("never written", "a row less", "terminations")),
        *product(("infos/success",), ("external link", "never written")),
    ],
)
def test_no_dataset_is_read_that_holds(root, tmp_path, fault, name):
    dataset = written(observation=TREE)
    (path,) = root.rglob("main_data.hdf5")
    with h5py.File(path, "a") as file:
        (FAULTS | NOT_A_FLAG)[fault](file, f"episode_1/{name}", tmp_path)
    others = {"link to a link": "elsewhere", "group": "episode 1", "empty": "episode 1"}
    with raises(DatasetError, "walk/human-v0", others.get(fault, name.split("/")[-1])):
        MinariDemonstrations(dataset).steps()


@pytest.mark.parametrize("place", ["options", "infos"])
def test_a_heap_of_strings_over_which_hdf5_walks_for_ever(root, monkeypatch, place):
    """Minari reads the options of a reset, and what a step reported."""
    dataset = written()
    (path,) = root.rglob("main_data.hdf5")
    with h5py.File(path, "a") as file:
        if place == "options":
            file["episode_1"].attrs["options/scene"] = "kitchen"
        else:
            texts = {"data": ["door"] * LENGTHS[1], "dtype": h5py.string_dtype()}
            file.create_dataset("episode_1/infos/scene", **texts)
    MinariDemonstrations(dataset).steps()
    damage_heap(path, "string", 2**64 - 16)
    monkeypatch.setattr(sandbox, "LIMIT_SECONDS", 10.0)
    found = sandbox.attempt(MinariDemonstrations(dataset).steps, str(path))
    assert found.kind == "refused", found
    assert "heap" in found.detail


@pytest.mark.parametrize("form", ["hdf5", "parquet"])
@pytest.mark.parametrize("counted", [{"episode": 5}, {"episode": 5, "total_steps": 17}, {"total_steps": 23}])
def test_counts_that_differ(root, form, counted):
    name, where = written(data_format=form, success=form == "hdf5"), root / "toy/walk/human-v0/data"
    assert MinariDemonstrations(name).index().lengths == LENGTHS
    for key, value in counted.items():
        if key != "episode":
            change(where / "metadata.json", **{key: value})
        elif form == "hdf5":
            with h5py.File(where / "main_data.hdf5", "a") as file:
                file["episode_1"].attrs["total_steps"] = value
        else:
            change(where / "1/metadata.json", total_steps=value)
    facts = ["total_steps", 5, 12] if len(counted) > 1 else ["metadata.json", *counted.values()][:1]
    refuses(lambda: MinariDemonstrations(name).steps(), DatasetError, where, *facts)


@pytest.mark.parametrize("form", ["hdf5", "parquet"])
@pytest.mark.parametrize("count", [2, 4, 10**10, "x"])
def test_episodes_that_metadata_do_not_count(root, form, count):
    name = written(data_format=form, success=form == "hdf5")
    (metadata,) = root.glob("toy/walk/human-v0/data/metadata.json")
    change(metadata, total_episodes=count)
    refuses(lambda: MinariDemonstrations(name).index(), DatasetError, metadata.parent, "metadata.json", count)
    change(metadata, total_episodes=len(LENGTHS), total_steps=str(count))
    refuses(lambda: MinariDemonstrations(name).index(), DatasetError, metadata.parent, count)


@pytest.mark.parametrize("form", ["parquet", "arrow"])
def test_an_episode_has_one_file(root, form):
    """Minari reads one of several, whichever it finds first."""
    name, episode = written(data_format=form, success=False), root / "toy/walk/human-v0/data/1"
    part = episode / f"part-0.{form}"
    shutil.copy(part, episode / f"part-1.{form}")
    refuses(lambda: MinariDemonstrations(name).index(), DatasetError, episode, part.name, f"part-1.{form}")
    (episode / f"part-1.{form}").unlink()
    part.write_bytes(part.read_bytes()[:300])
    refuses(lambda: MinariDemonstrations(name).steps(), DatasetError, part)
    part.unlink()
    refuses(lambda: MinariDemonstrations(name).index(), DatasetError, episode, 0)


def test_a_form_of_files_that_is_unknown_or_not_installed(root, monkeypatch, capsys):
    name, metadata = (
        written(data_format="parquet", success=False),
        root / "toy/walk/human-v0/data/metadata.json",
    )
    monkeypatch.setitem(sys.modules, "minari.dataset._storages.arrow_storage", None)
    refuses(lambda: MinariDemonstrations(name).index(), ImportError, "arrow_storage")
    assert main(["train", f"minari:{name}"]) == 2
    assert not missing(capsys.readouterr().err, "arrow_storage")
    change(metadata, data_format="zarr")
    with raises(DatasetError, metadata.parent, "'zarr'", "hdf5, parquet, arrow"):
        MinariDemonstrations(name).index()


def change(path, **entries):
    path.write_text(json.dumps(json.loads(path.read_text()) | entries))


@pytest.mark.parametrize("file", ["main_data.hdf5", "metadata.json"])
def test_a_pipe_is_not_waited_for(root, file):
    name = written()
    (path,) = root.glob(f"toy/walk/human-v0/data/{file}")
    path.unlink()
    os.mkfifo(path)
    refuses(lambda: MinariDemonstrations(name).index(), DatasetError, path, "not a regular file")


@pytest.mark.parametrize("form", ["arrow", "parquet"])
def test_a_linked_episode_is_refused(root, tmp_path, form):
    """Behind the link may be a pipe, and the digest of the contents would not see a change there."""
    name = written(data_format=form, success=False)
    episode, elsewhere = root / "toy/walk/human-v0/data/1", tmp_path / "elsewhere"
    episode.rename(elsewhere)
    episode.symlink_to(elsewhere)
    refuses(lambda: MinariDemonstrations(name).index(), DatasetError, episode, "not a regular file")


@pytest.mark.parametrize("depth", [1, 40])
def test_a_group_with_several_names_is_not_walked_through_for_ever(root, monkeypatch, depth):
    """With a depth of 40 there are 2**40 ways to the last group."""
    name = written()
    (path,) = root.rglob("main_data.hdf5")
    with h5py.File(path, "a") as file:
        group = file["episode_1/infos"]
        for _ in range(depth):
            inner = group.create_group("arm")
            group["hand"], group = inner, inner
        group["base"] = file["episode_1"]
    monkeypatch.setattr(sandbox, "LIMIT_SECONDS", 10.0)
    found = sandbox.attempt(MinariDemonstrations(name).steps, str(path))
    assert found.kind == "refused", found
    assert "another name" in found.detail
    assert len(found.detail) < 1000


def test_an_environment_that_does_not_take_what_was_recorded(root):
    """As of another version of its package."""
    name = written(observation=Box(-np.inf, np.inf, (3,), np.float32), env="Pendulum-v1", expert_policy=None)
    (metadata,) = root.glob("toy/walk/human-v0/data/metadata.json")
    spec = json.loads(json.loads(metadata.read_text())["env_spec"])
    change(metadata, env_spec=json.dumps(spec | {"kwargs": {"friction": 0.5}}))
    task = Task(open_demonstrations(f"minari:{name}"))
    with raises(ValueError, f"minari:{name}", "Pendulum-v1", "{'friction': 0.5}", "make_env"):
        task.make_env()
    with raises(ValueError, "Pendulum-v1", "{'friction': 0.5}", "make_env"):
        environment_of(WarmPriorActor(VelocityMLP(1, 3, 4), PastPrior(4), environment=task.environment))


def test_a_policy_is_trained_and_played_in_the_dataset_s_environment(tmp_path, capsys):
    name = written(observation=Box(-np.inf, np.inf, (3,), np.float32), env="Pendulum-v1", expert_policy=None)
    task = Task(open_demonstrations(f"minari:{name}"), play=Play(horizon=9))
    small, short = NetworkOptions("mlp,hidden_dim=8"), TrainingConfig(iterations=2)
    actor = train_policy(task, PastPrior(4), tmp_path / "run", nfe=1, network=small, training=short)
    assert actor.sampling.nfe == 1
    actor = load_policy(tmp_path / "run" / "policy_000002")
    env = environment_of(actor)
    rollout = env.rollout(9, actor)
    assert rollout["next", "executed_steps"].flatten().tolist() == [4, 4, 1]
    assert not main(
        ["evaluate", str(tmp_path / "run" / "policy_000002"), "--episodes", "1", "--nfe", "1", "3"]
    )
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines] == ["NFE 1", "NFE 3"]
    with pytest.warns(UserWarning, match="Pendulum-v1 has no time limit.*horizon"):
        Task(open_demonstrations(f"minari:{name}"), play=Play(horizon=-1)).make_env()


def test_without_an_environment_only_playing_is_refused(tmp_path, capsys):
    place = f"minari:{written(observation=TREE)}"
    options = [
        "--observations",
        "arm",
        "--iterations",
        "2",
        "--network",
        "mlp,hidden_dim=8",
        "--held-out",
        "1",
    ]
    assert not main(["train", place, "--out", str(tmp_path), "--nfe", "1", *options])
    said = capsys.readouterr().out
    assert "(1, " in said and "NFE 1" in said and "NFE 9" in said
    task = Task(open_demonstrations(place))
    refuses(lambda: task.make_env(), ValueError, "environment")


def test_an_environment_that_reports_no_success_is_trained_for(tmp_path, capsys):
    space = Box(-np.inf, np.inf, (3,), np.float32)
    name = written(observation=space, success=False, env="Pendulum-v1", expert_policy=None)
    small = ["--iterations", "2", "--network", "mlp,hidden_dim=8", "--out", str(tmp_path)]
    assert not main(["train", f"minari:{name}", *small])
    said = capsys.readouterr().out
    assert "only trained" in said and "to evaluate it" not in said


def test_nothing_named_in_a_dataset_is_imported(root):
    name = written(observation=Box(-np.inf, np.inf, (3,), np.float32), env="Pendulum-v1", expert_policy=None)
    (metadata,) = root.rglob("metadata.json")
    text = metadata.read_text()
    for other in ("evil-v1", "evil:Pendulum-v1"):
        metadata.write_text(text.replace("Pendulum-v1", other))
        task = Task(open_demonstrations(f"minari:{name}"))
        with raises(ImportError, other):
            task.make_env()
    entry = "gymnasium.envs.classic_control.pendulum:PendulumEnv"
    assert entry in text
    metadata.write_text(text.replace(entry, "evil:Env"))  # the registry's own is built
    assert isinstance(Task(open_demonstrations(f"minari:{name}")).make_env(), torch.nn.Module)
    assert gymnasium.registry["Pendulum-v1"].entry_point == entry
