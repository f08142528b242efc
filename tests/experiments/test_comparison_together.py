"""A comparison whose policies several processes train together, and the first one plays."""

from __future__ import annotations

import io
import json
from contextlib import redirect_stdout

import pytest
import torch

from tests.experiments.comparison_parts import comparison, rows_of, weights
from tests.together import together
from warmprior.experiments import Method, Store
from warmprior.io.distributed import rank, world_size

METHODS = tuple(Method(name, 4) for name in ("gaussian", "past", "preview"))


class FailingStore(Store):
    """The policies of one source diverge, and it is told who trained."""

    def train(self, method, training, progress=None):
        with (self.directory / f"trained by {world_size()}").open("a") as file:
            file.write(f"{method.name} {rank()}\n")
        if method.name == "preview":
            raise FloatingPointError("the loss became nan")
        return super().train(method, training, progress)


def run(folder):
    (folder / "policies").mkdir(exist_ok=True)
    made = comparison(folder, 1, methods=METHODS, kind=FailingStore, seeds=1, episodes=2)
    with redirect_stdout(io.StringIO()) as told:
        made.run()
    assert rank() == 0 and world_size() == 1  # the others have ended
    (folder / "failures").write_text(json.dumps(made.failures))
    (folder / "told").write_text(told.getvalue())


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    one, two = (tmp_path_factory.mktemp(name) for name in ("one", "two"))
    run(one)
    together(run, two)
    return one, two


def test_all_trained_and_one_played(folders):
    """The rows have the same facts and order; processes draw other batches than one does."""
    one, two = (rows_of(folder) for folder in folders)
    assert [row["prior"] for row in two] == [row["prior"] for row in one]
    assert {row["prior"] for row in two} == {"gaussian", "past"}
    for mine, theirs in zip(one, two, strict=True):
        assert mine.keys() == theirs.keys() and len(mine["outcomes"]) == 2
        facts = ("task", "prior", "sigma", "seed", "checkpoint", "nfe", "episodes")
        assert [mine[key] for key in facts] == [theirs[key] for key in facts]
    trained = sorted((folders[1] / "policies" / "trained by 2").read_text().splitlines())
    assert trained == sorted(f"{method.name} {r}" for method in METHODS for r in range(2))


def test_what_all_trained_is_not_said_to_be_found(folders):
    for folder in folders:
        told = (folder / "told").read_text()
        assert told.count("trained drift own") == 2 and "found" not in told


def test_a_training_that_fails_in_all_does_not_stop_the_others(folders):
    one, two = (json.loads((folder / "failures").read_text()) for folder in folders)
    assert one == two and len(two) == 1 and "the loss became nan" in two[0]
    # Nor is it tried again by the first process alone.
    assert "preview" not in (folders[1] / "policies" / "trained by 1").read_text()


def test_it_can_be_resumed_without_torchrun(folders):
    made = comparison(
        folders[1], 1, methods=METHODS[:2], kind=FailingStore, seeds=1, episodes=2, resume=False
    )
    before = weights(folders[1])
    for contestant in made.contestants:
        assert contestant.path.is_dir()
        contestant.store.train(contestant.method, contestant.training, lambda iteration: None)
    after = weights(folders[1])
    assert all(torch.equal(after[name], value) for name, value in before.items())
