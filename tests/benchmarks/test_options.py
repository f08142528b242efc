import copy
import json
import os
from dataclasses import replace
from functools import reduce

import budget
import navigation1d
import prior_space_rl
import pytest
import real_time_chunking
import robomimic
import sigma
from mimicgen_tasks import FEW

from lab.demonstrations.data_options import DataOptions
from lab.demonstrations.scripted import generate
from lab.options.command_line import parse, started
from lab.options.options import Options
from lab.options.presets import PRESETS, study
from lab.options.stored_options import from_record, recorded, stored_options
from lab.reporting.report import unlike
from tests.benchmarks.script_parts import refused
from tests.errors import raises
from warmprior.options.defaults import EVALUATION_SEED

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
    assert again == replace(preset, run=again.run) and recorded(again) == tree


def test_a_command_line_changes_what_it_says_alone(tmp_path):
    for name, preset in PRESETS.items():
        found = read("--preset", name, out=tmp_path)
        assert found.preset == name and replace(found, run=preset.run, preset=preset.preset) == preset
    words = (
        "--task can stack --style ph mh --demonstrations 7 9 --network mlp,hidden_dim=32 --learning-rate 0.5"
    )
    words += " --prior past --chunk 2 4 --sigma 0.1 0.2 --seeds 4 --seed 3 --nfe 1 5 --no-precondition"
    found = read(*words.split())
    assert found.data.task == ("can", "stack") and found.data.count("mh") == 9
    assert (found.network.network, found.network.precondition) == ("mlp,hidden_dim=32", False)
    assert (found.training.learning_rate, found.evaluation.nfe) == (0.5, (1, 5))
    sources = [(p.name, p.chunk_length, p.sigma) for p in found.sources.methods()]
    assert sources == [("past", h, s) for h in (2, 4) for s in (0.1, 0.2)]
    assert list(found.seeds) == [3, 4, 5, 6]


def test_a_run_continues_with_its_options_and_refuses_others(tmp_path, monkeypatch):
    file, out, resume = tmp_path / "file.hdf5", tmp_path / "out", ["--resume", "--sigma", "0.3"]
    file.touch()
    monkeypatch.chdir(tmp_path)
    first = read("--dataset", "file.hdf5", "--chunk", 4, "--sigma", 0.3, "--seed", 3, out=out)
    with pytest.raises(OSError), started(first, "a-study"):
        raise OSError("what fails at once is not in the way of its correction")
    with pytest.raises(RuntimeError), started(first, "a-study"):
        (out / "tasks.json").touch()  # trainings have begun
        raise RuntimeError("killed")
    monkeypatch.chdir("/")  # a relative path is that of the same file
    # Who computes is no part of a run, and to repeat an option does no harm.
    again = read(*resume, "--workers", 3, out=out)
    assert replace(again, run=first.run) == first and again.data.dataset == file and again.run.workers == 3
    for words, changed in (("--seed 4", "--seed"), ("--compile --seeds 2", "--compile, --seeds")):
        with raises(ValueError, changed):
            read(*resume, *words.split(), out=out)
    with raises(ValueError, "--resume", out):
        read(out=out)
    with raises(ValueError, tmp_path / "empty"):
        read(*resume, out=tmp_path / "empty")
    with raises(ValueError, "a-study"):
        parse(PRESETS, [*resume, "--out", str(out)], "sigma", None)
    stored = json.loads((out / "options.json").read_text())
    for part, name, value, fact in (
        ("training", "iterations", "many", "integer"),
        ("evaluation", "nfe", [1, "two"], "integer"),
        ("run", "tusk", 1, "--tusk"),
        ("training", "iterations", -1, -1),
    ):
        damaged = copy.deepcopy(stored)
        damaged["options"][part][name] = value
        (out / "options.json").write_text(json.dumps(damaged))
        with raises(ValueError, out / "options.json", fact) as caught:
            read(*resume, out=out)
        assert "\n" not in str(caught.value)
    for damaged in (None, [], "x", {}, {"study": "robomimic", "options": []}):
        (out / "options.json").write_text(json.dumps(damaged))
        with raises(ValueError, out / "options.json"):
            stored_options(Options, out, None)


def test_an_option_that_a_file_lacks_is_no_default(tmp_path):
    """Without `dataset` a run would generate demonstrations of its own, for minutes."""
    file, path = tmp_path / "file.hdf5", tmp_path / "out" / "options.json"
    file.touch()
    path.parent.mkdir()
    record = {"study": "a-study", "options": recorded(read("--dataset", file, out=path.parent))}
    path.write_text(json.dumps(record))
    stored_options(Options, path.parent, "a-study")
    options = record["options"]
    places = [(part, name) for part, values in options.items() if isinstance(values, dict) for name in values]
    for *part, name in ("preset",), *places:
        damaged = copy.deepcopy(record)
        del reduce(dict.get, part, damaged["options"])[name]
        path.write_text(json.dumps(damaged))
        with raises(ValueError, "options.json", f"--{name.replace('_', '-')}"):
            stored_options(Options, path.parent, "a-study")


def test_each_training_seed_has_start_states_of_its_own():
    evaluation = PRESETS["cpu"].evaluation
    starts = [evaluation.starts(seed) for seed in (0, 1, 2, 99_999)]
    assert [len(seeds) for seeds in starts] == [50] * 4
    assert len({seed for seeds in starts for seed in seeds}) == 200
    assert all(EVALUATION_SEED <= seed < 2**32 for seeds in starts for seed in seeds)
    with raises(ValueError, "--episodes", "10,000", 10_001):
        replace(evaluation, episodes=10_001)


def test_counts_that_could_not_be_listed(tmp_path):
    for option in ("demonstrations", "image-size", "episodes", "seeds", "chunk", "nfe", "workers"):
        with raises(ValueError, f"--{option}", "10,000,000", 10**23):
            read(f"--{option}", 10**23, out=tmp_path)


def test_demonstrations_are_generated_by_no_more_processes_than_asked_for(tmp_path, monkeypatch, capsys):
    asked = []

    def working(count, state):
        asked.append(count)
        raise OSError("that is all")

    monkeypatch.setattr(generate, "working", working)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: range(3))
    monkeypatch.setenv("WARMPRIOR_CACHE", str(tmp_path / "cache"))
    argv = ["--task", "lift", "--demonstrations", "5", "--workers", "1", "--out", str(tmp_path / "out")]
    assert "that is all" in refused(robomimic.main, argv, capsys)
    assert asked == [1] and "LOKY_MAX_CPU_COUNT" not in os.environ


def test_a_run_of_another_machines_device_is_read_but_not_continued(tmp_path):
    """Its policies can be measured here; a training needs the device."""
    with started(read(out=tmp_path), "a-study"):
        path = tmp_path / "options.json"
        path.write_text(path.read_text().replace('"device": "cpu"', '"device": "cuda:99"'))
    assert stored_options(Options, tmp_path, "a-study").run.device == "cuda:99"
    with raises(ValueError, "device cuda:99"):
        read("--resume", out=tmp_path)


def test_numbers_of_demonstrations_are_of_presets_only_where_they_are_generated(tmp_path):
    """A preset generates as many as it likes; a file is taken whole unless its user says otherwise."""
    file = tmp_path / "file.hdf5"
    file.touch()
    counts = {"quick": (25, 25), "cpu": (150, 300), "paper": (200, 300), "much-ado": (200, 300)}
    for name, (ph, mh) in counts.items():
        data = read("--preset", name).data
        assert (data.count("ph"), data.count("mh")) == (ph, mh)
        for argv in (["--dataset", file], ["--download"]):
            assert read("--preset", name, *argv).data.first("ph") is None
            # Also where it is the preset's own number.
            assert read("--preset", name, *argv, "--demonstrations", ph).data.first("ph") == ph


def test_naming_images_asks_for_policies_that_see_them():
    for preset in ("quick", "cpu", "paper", "much-ado"):
        named = ["--preset", preset, "--images", "agentview_image"]
        options = read(*named)
        assert options == read(*named, "--obs", "image") and options.data.sees_images
        assert options.name.endswith("-image") and options.data.images == ("agentview_image",)
        assert options.data.image_size == {"quick": 48, "cpu": 48}.get(preset, 84)
    assert DataOptions(images=("front",)).sees_images and not DataOptions().sees_images


def test_tables_name_what_is_not_the_papers():
    plain = read("--preset", "paper")
    assert unlike(plain, PRESETS["paper"]) == []
    words = "--times u-shaped --objective l1 --grid dense-jump"
    (line,) = unlike(read("--preset", "paper", *words.split()), PRESETS["paper"])
    changed = "times u-shaped (uniform); objective l1 (velocity)"
    assert line.endswith(f": {changed}; grid dense-jump (uniform).")
    for words, named, left_out in (
        (
            "--preset much-ado --warmup-ratio 0.2",
            ["actions absolute (delta)", "max grad norm 100.0 (None)", "temperature 0.0 (1.0)"],
            "warmup",
        ),
        # The weighting is that in force, which follows from the network where none is given.
        ("", ["weighting standardised (velocity)", "network mlp (chi_transformer)", "(200000)"], "obs"),
        ("--obs image --encoder small", ["image size 48 (84)"], "obs"),
    ):
        (line,) = unlike(read(*words.split()), PRESETS["paper"])
        assert all(name in line for name in named) and left_out not in line
    assert unlike(FEW["paper"], FEW["paper"]) == []  # its images have a batch size of their own
