"""Options: what a command line, a preset and a stored file say, and what is refused."""

from __future__ import annotations

import importlib
import json
import re
from dataclasses import replace

import pytest

pytest.importorskip("tyro")

import budget
import navigation1d
import prior_space_rl
import real_time_chunking
import sigma
from options import (
    PRESETS,
    Options,
    Run,
    adapted,
    from_record,
    parse,
    recorded,
    started,
    study,
)
from robomimic import beside, smaller

from warmprior.training import DataOptions

IMAGE = DataOptions(obs="image")
STUDIES = (budget.BudgetOptions, real_time_chunking.DelayOptions)
EVERY = [
    *PRESETS.values(),
    *navigation1d.NAVIGATION_PRESETS.values(),
    *prior_space_rl.AGENT_PRESETS.values(),
    *(study(kind, preset) for kind in STUDIES for preset in PRESETS.values()),
    *map(sigma.preset, PRESETS.values()),
]


def read(*argv, out="somewhere"):
    return parse(PRESETS, [*map(str, argv), "--out", str(out)], "a-study", None)


@pytest.mark.parametrize("preset", EVERY)
def test_options_survive_json(preset):
    tree = json.loads(json.dumps(recorded(preset)))
    again = from_record(type(preset), tree)
    assert again == preset and recorded(again) == tree


@pytest.mark.parametrize("name", PRESETS)
def test_without_options_the_preset_is_what_runs(name, tmp_path):
    found = read("--preset", name, out=tmp_path / "out")
    assert replace(found, run=PRESETS[name].run) == PRESETS[name]


def test_every_option_has_its_own_name():
    given = {
        "task": "can stack",
        "data": "ph mh",
        "demonstrations": "7 9",
        "hidden-dim": "32",
        "iterations": "11",
        "learning-rate": "0.5",
        "prior": "past",
        "chunk": "2 4",
        "sigma": "0.1 0.2",
        "seeds": "4",
        "seed": "3",
        "nfe": "1 5",
        "envs": "2",
    }
    argv = " ".join(f"--{name} {value}" for name, value in given.items()).split()
    found = read(*argv, "--no-precondition", "--weighting", "velocity")
    assert found.data.task == ("can", "stack") and found.data.count("mh") == 9
    assert (found.network.hidden_dim, found.network.precondition) == (32, False)
    assert (found.training.iterations, found.training.learning_rate) == (11, 0.5)
    sources = [(p.name, p.chunk_length, p.sigma) for p in found.sources.methods()]
    assert sources == [("past", h, s) for h in (2, 4) for s in (0.1, 0.2)]
    assert list(found.seeds) == [3, 4, 5, 6] and found.evaluation.nfe == (1, 5)
    assert found.run.envs == 2


def test_an_address_without_a_cluster_is_refused_before_anything_is_written(tmp_path):
    pytest.importorskip("ray")
    argv = ["--engine", "ray", "--ray-address", "127.0.0.1:1"]
    with pytest.raises(ConnectionError, match=r"127\.0\.0\.1:1 is no cluster"):
        read(*argv, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_fails_at_once_is_not_in_the_way_of_its_correction(tmp_path):
    out = tmp_path / "out"
    with pytest.raises(RuntimeError), started(read("--task", "can", out=out), "a-study"):
        raise RuntimeError("no such data")
    assert read("--task", "lift", out=out).data.task == ("lift",)
    # What was interrupted later can be continued, and is not overwritten.
    with pytest.raises(RuntimeError), started(read(out=out), "a-study"):
        (out / "tasks.json").touch()  # trainings have begun
        raise RuntimeError("killed")
    assert read("--resume", out=out).run.resume
    with pytest.raises(ValueError, match="add --resume"):
        read(out=out)


def test_numbers_of_demonstrations_are_of_presets_only_where_they_are_generated(tmp_path):
    """A preset generates as many as it likes; a file is taken whole unless its user says otherwise."""
    file = tmp_path / "file.hdf5"
    file.touch()
    for preset, (ph, mh) in {"quick": (150, 150), "cpu": (150, 300), "paper": (200, 300)}.items():
        data = read("--preset", preset).data
        assert (data.count("ph"), data.count("mh")) == (ph, mh)
        for argv in (["--dataset", file], ["--download"]):
            data = read("--preset", preset, *argv).data
            assert data.first("ph") is None and data.first("mh") is None
            some = read("--preset", preset, *argv, "--demonstrations", ph).data
            assert some.first("ph") == ph  # also where it is the preset's own number
    # A continued run keeps its part of a file.
    for i, given in enumerate(([], ["--demonstrations", "7"])):
        out = tmp_path / str(i)
        with started(read("--dataset", file, *given, out=out), "a-study"):
            pass
        assert read("--resume", out=out).data.demonstrations == tuple(map(int, given[1:]))
        with pytest.raises(ValueError, match="other values of --demonstrations"):
            read("--resume", "--demonstrations", "8", out=out)


def test_tables_name_what_is_not_the_papers():
    plain = read("--preset", "paper")
    assert beside(plain, PRESETS["paper"]) == [] == smaller(plain, PRESETS["paper"])
    words = "--times u-shaped --objective l1 --self-distillation 0.5 --grid dense-jump"
    (line,) = beside(read("--preset", "paper", *words.split()), PRESETS["paper"])
    assert all(given in line for given in words.replace(" --", "|--").split("|"))
    assert smaller(read(), PRESETS["paper"])


# Images


@pytest.fixture
def offline(monkeypatch):
    def weights():
        raise OSError("ImageNet's weights of ResNet-18 cannot be had (no route to host): connect")

    for place in ("options", "warmprior.training.options"):
        monkeypatch.setattr(f"{place}.imagenet_weights", weights)
    monkeypatch.setattr("warmprior.training.options.require_rendering", lambda: "egl")


def preset_of_images(name):
    return adapted(PRESETS[name], Options(data=IMAGE, run=Run(preset=name)))


def test_where_they_cannot_be_had_it_starts_from_random_ones_and_says_so(offline, capsys):
    assert preset_of_images("paper").network.encoder == "resnet18"
    said = capsys.readouterr().out
    assert "no route to host" in said and "starts from random weights" in said
    for name in ("quick", "cpu"):  # small presets need none
        found = preset_of_images(name)
        assert found.network.encoder == "small"
        found.check()
    assert capsys.readouterr().out == ""
    # Asked for elsewhere, missing weights are an error before any work.
    with pytest.raises(OSError, match="cannot be had"):
        replace(PRESETS["quick"], data=IMAGE).check()


@pytest.mark.parametrize("script", ["robomimic", "sigma", "prior_space_rl", "real_time_chunking", "pusht"])
def test_help_says_what_every_option_is(script, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "90")  # one column of boxes
    with pytest.raises(SystemExit):
        importlib.import_module(script).main(["--help"])
    examples, _, text = capsys.readouterr().out.partition("show this help")
    assert re.search(r"^\$ python benchmarks/\w+\.py", examples, re.M)
    assert not re.search(r"(?<!\$) python benchmarks", examples)
    assert "``" not in text and ":class:" not in text
    assert "prior_space_rl.py quick, unit and paper" in re.sub(r"[\s│]+", " ", text)
    lines = "\n".join(line.strip("│ ") for line in text.splitlines())
    entries = re.split(r"\n(?=--[a-z])", lines)[1:]
    names, texts = zip(*(entry.split(maxsplit=1) for entry in entries), strict=True)
    plain = [re.sub(r"\([^()]*\)|\{[^{}]*\}|--[\w.-]+", "", text) for text in texts]
    silent = [n for n, text in zip(names, plain, strict=True) if not re.search("[a-z]{2}", text)]
    assert len(names) > 40 and silent == []
