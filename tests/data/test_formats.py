"""A format of one's own, and steps in memory."""

from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.errors import missing, raises
from warmprior import PastPrior
from warmprior.__main__ import main
from warmprior.data import DatasetError, Demonstrations, demonstrations_of, open_demonstrations, opening
from warmprior.data.index import DatasetIndex, DemonstrationReader
from warmprior.options.data import PLACES
from warmprior.saving import load_policy
from warmprior.tasks import Task
from warmprior.training import NetworkOptions, TrainingConfig, train_policy

COLUMNS = {"obs/joints": slice(0, 2), "actions": slice(2, 3), "rewards": slice(3, 4)}


class Table(DemonstrationReader):
    def __init__(self, tables):
        self.tables = tables

    def numbers(self, demo, key, out, first=0):
        out[...] = self.tables[int(demo)][first : first + len(out), COLUMNS[key]]

    def images(self, demo, key):
        raise NotImplementedError

    def name(self, demo, key):
        return f"{key} of {demo}"


class Tables(Demonstrations):
    """A text file per demonstration: two joints, an action, a reward."""

    prefix = "table:"

    def tables(self):
        return [np.loadtxt(file) for file in sorted(Path(self.place).glob("*.txt"))][: self.demos]

    def index(self, observations=None, images=(), *, poses=False):
        return DatasetIndex(
            path=Path(self.place),
            demos=tuple(map(str, range(len(self.tables())))),
            lengths=tuple(map(len, self.tables())),
            observation_keys=("joints",),
            observation_dims=(2,),
            available_keys=("joints",),
            action_dim=1,
        )

    @contextmanager
    def reader(self, index):
        yield Table(self.tables())


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.setattr(opening, "FORMATS", (Tables, *opening.FORMATS))
    rng = np.random.default_rng(0)
    (tmp_path / "reach").mkdir()
    for i, length in enumerate((9, 12, 7)):
        np.savetxt(tmp_path / "reach" / f"{i}.txt", rng.uniform(size=(length, 4)))
    return f"table:{tmp_path / 'reach'}"


def test_a_format_is_a_class_and_a_line(place, tmp_path, capsys):
    text = repr(open_demonstrations(place, demos=2))
    assert not missing(text, "table:", "2 demonstrations", "21 steps", "joints [2]", "actions [1]")
    values = np.concatenate(Tables(place.removeprefix("table:")).tables()).astype(np.float32)
    data = open_demonstrations(place).steps()
    np.testing.assert_array_equal(data["observation"], values[:, :2])
    np.testing.assert_array_equal(data["action"], values[:, 2:3])
    assert data["episode"].bincount().tolist() == [9, 12, 7]
    options = ["--iterations", "2", "--network", "mlp,hidden_dim=8", "--chunk", "4", "--held-out", "1"]
    assert main(["train", place, "--out", str(tmp_path), *options]) == 0
    saved = capsys.readouterr().out.splitlines()[-1]
    kept = 21  # without the last demonstration
    expected = (values[:kept, :2].max(0) + values[:kept, :2].min(0)) / 2
    whole = (values[:, :2].max(0) + values[:, :2].min(0)) / 2
    middle = load_policy(saved).normalizer.loc("observation").numpy()
    # The units are those of all demonstrations, also of those that are left out.
    np.testing.assert_allclose(middle, whole, rtol=1e-6)
    assert not np.allclose(expected, whole)


def steps():
    numbers = torch.rand(30, 4, generator=torch.Generator().manual_seed(0))
    episode = torch.arange(3).repeat_interleave(torch.tensor([4, 16, 10]))
    return TensorDict({"observation": numbers[:, :3], "action": numbers[:, 3:], "episode": episode}, [30])


def test_steps_in_memory_are_demonstrations():
    index = demonstrations_of(steps(), "arm").index()
    assert (index.lengths, index.observation_dims, index.action_dim) == ((4, 16, 10), (3,), 1)
    task = Task(demonstrations_of(steps(), "arm", style="toy", normalised=True))
    assert (task.name, task.style, task.normalizer, task.clip) == ("arm", "toy", None, None)
    assert (task.data == steps()).all()
    for options in ({"observations": ["observation"]}, {"images": ["front"]}):
        with raises(ValueError, "observations", "images"):
            Task(demonstrations_of(steps()), **options)


@pytest.mark.parametrize("key", ["observation", "action"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.int64])
def test_steps_in_memory_whose_numbers_float32_would_round(key, dtype):
    rounded = steps()
    rounded[key] = (10**8 + torch.arange(30)[:, None]).to(dtype)
    with raises(DatasetError, key, "arm", "column 0", 8, "offset"):
        Task(demonstrations_of(rounded, "arm"))
    Task(demonstrations_of(rounded, "arm", normalised=True))
    Task(demonstrations_of(steps().apply(lambda v: v.bfloat16() if v.is_floating_point() else v), "arm"))


def test_steps_and_their_demonstrations_train_the_same_policy():
    options = {"network": NetworkOptions("mlp,hidden_dim=8"), "training": TrainingConfig(iterations=2)}
    given = (steps(), demonstrations_of(steps()), Task(demonstrations_of(steps())))
    one, *others = (train_policy(g, PastPrior(4), description=None, **options).state_dict() for g in given)
    for other in others:
        assert one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


def test_help_names_the_places_of_every_format():
    prefixes = {kind.prefix for kind in opening.FORMATS} - {""}
    assert len(prefixes) > 1 and {prefix for prefix in prefixes if prefix in PLACES} == prefixes


def test_what_steps_in_memory_hold_beside_the_observation_is_left_out_by_name():
    steps = TensorDict({key: torch.rand(6, 2) for key in ("observation", "action", "force")}, [6])
    steps["episode"], steps["frame"] = torch.arange(6) // 3, torch.arange(6)
    steps["next", "done"] = steps["done"] = torch.zeros(6, 1, dtype=torch.bool)
    assert demonstrations_of(steps).index().left_out == {"": ["force"]}
