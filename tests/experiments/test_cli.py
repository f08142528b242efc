"""Options from the command line: one tree, its identity, interruptions."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from tests.data.synthetic import write_robomimic_file
from warmprior.io.files import exclusive
from warmprior.io.script import run_script

pytest.importorskip("tyro")

from warmprior.experiments import (
    NAVIGATION_PRESETS,
    PRESETS,
    EvaluationOptions,
    MeasuredRecipe,
    Recipe,
    parse,
    record,
    restore,
    started,
)
from warmprior.experiments.prior_space import PRIOR_SPACE_PRESETS

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "robomimic.py"
EVERY = [
    *PRESETS.values(),
    *NAVIGATION_PRESETS.values(),
    *PRIOR_SPACE_PRESETS.values(),
    *(MeasuredRecipe.of(preset) for preset in PRESETS.values()),
]


def read(*argv, presets=PRESETS, **options):
    return parse(presets, argv, study="a-study", **options)


@pytest.mark.parametrize("preset", EVERY)
def test_a_recipe_survives_json(preset):
    tree = json.loads(json.dumps(record(preset)))
    assert restore(type(preset), tree) == preset


@pytest.mark.parametrize("name", PRESETS)
def test_without_options_the_preset_is_what_runs(name, tmp_path):
    recipe = read("--preset", name, "--out", str(tmp_path / "out"))
    assert record(replace(recipe, run=PRESETS[name].run)) == record(PRESETS[name])


def test_every_leaf_is_an_option_under_its_own_name(tmp_path):
    given = {
        "task": ["can", "stack"],
        "data": ["ph", "mh"],
        "demonstrations": [7, 9],
        "hidden-dim": [32],
        "iterations": [11],
        "learning-rate": [0.5],
        "prior": ["past"],
        "chunk": [2, 4],
        "sigma": [0.1, 0.2],
        "seeds": [4],
        "seed": [3],
        "nfe": [1, 5],
        "envs": [2],
    }
    argv = [str(word) for name, values in given.items() for word in (f"--{name}", *values)]
    plain = ["--no-precondition", "--weighting", "velocity"]
    recipe = read(*argv, *plain, "--out", str(tmp_path / "out"))
    assert recipe.data.task == ("can", "stack") and recipe.data.count("mh") == 9
    assert (recipe.network.hidden_dim, recipe.network.precondition) == (32, False)
    assert (recipe.training.iterations, recipe.training.learning_rate) == (11, 0.5)
    sources = [(p.name, p.chunk_length, p.sigma) for p in recipe.sources.methods()]
    assert sources == [("past", h, s) for h in (2, 4) for s in (0.1, 0.2)]
    assert list(recipe.seeds) == [3, 4, 5, 6] and recipe.evaluation.nfes == [5, 1]
    assert recipe.run.envs == 2


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ("--no-precondition", "--weighting standardised needs --precondition"),
        ("--prior past,age=3", "past cannot be built from"),
        ("--preset nobodys", "--preset must be one of quick, cpu, paper"),
        ("--seeds 1000000000", "--seeds must be between 1 and 1,000"),
        ("--episodes 0", "--episodes must be between 1"),
        ("--nfe 100000000000000000000", "--nfe must be between 1"),
        ("--chunk 1000000000", "--chunk must be between 1"),
        ("--device meta", "--device meta does not work here"),
        ("--task nothing", "unknown task 'nothing'"),
        ("--force-download", "--force-download belongs to --download"),
        ("--download --demonstrations 0", "--demonstrations must be between 1"),
        ("--data source", "--data source is that of MimicGen's files: add --download"),
        ("--task coffee_d0", "no scripted expert for coffee_d0: add --download"),
        ("--prior gaussian --sigma 0.5", "--sigma belongs to warm priors"),
        ("--iterations 0", "iterations must be at least 1"),
        ("--seed -1", "seed must be at least 0"),
        ("--learning-rate nan", "learning_rate must be a finite number > 0"),
        ("--weight-decay -1", "weight_decay must be a finite number >= 0"),
        ("--betas 0.9 2", "betas must lie in [0, 1)"),
        ("--warmup-ratio 3", "warmup_ratio must lie in [0, 1)"),
        ("--save-every 0", "save_every must be at least 1"),
    ],
)
def test_what_cannot_work_is_told_in_one_line_and_leaves_nothing(argv, message, tmp_path, capsys):
    out = tmp_path / "out"
    words = [*argv.split(), "--out", str(out)]
    code = run_script(lambda: parse(PRESETS, words, study="a-study"), "a.py")
    told = capsys.readouterr().err
    assert code == 2 and message in told and not out.exists()
    assert told.startswith("a.py: error: ") and told.count("\n") == 1


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        ("--episdes 5", ("Unrecognized options: --episdes", "--episodes")),
        ("--episodes many", ("--episodes", "'many'")),
        ("--data xy", ("--data", "xy")),
    ],
)
def test_what_is_no_option_is_told_with_the_nearest(argv, words, capsys):
    with pytest.raises(SystemExit) as stop:
        read(*argv.split())
    told = capsys.readouterr().err
    assert stop.value.code == 2 and all(word in told for word in words)


def begin(recipe):
    with started(recipe, "a-study") as out:
        (out / "results.json").write_text("{}")


def test_a_continued_run_has_the_options_it_began_with(tmp_path):
    out = ["--out", str(tmp_path / "out")]
    first = read("--chunk", "4", "--sigma", "0.3", "--logger", "tensorboard", *out)
    begin(first)
    again = read("--resume", *out)
    assert record(again) == record(first)
    changed = read("--resume", "--envs", "3", "--logger", "none", *out).run
    assert (changed.envs, changed.logger, again.run.logger) == (3, "none", "tensorboard")
    assert record(read("--resume", "--chunk", "4", *out)) == record(first)
    with pytest.raises(ValueError, match=r"was started with --chunk 4: leave these out"):
        read("--resume", "--chunk", "8", *out)
    with pytest.raises(ValueError, match=r"was started with .*--preset quick"):
        read("--resume", "--preset", "cpu", *out)
    with pytest.raises(ValueError, match="add --resume to continue it"):
        read(*out)
    with pytest.raises(ValueError, match=r"holds a run of another study \(a-study\)"):
        parse(PRESETS, ["--resume", *out], study="another")


def test_what_fails_at_once_is_not_in_the_way_of_its_correction(tmp_path):
    out = ["--out", str(tmp_path / "out")]
    with pytest.raises(RuntimeError), started(read("--task", "can", *out), "a-study"):
        raise RuntimeError("no such data")
    assert read("--task", "lift", *out).data.task == ("lift",)
    # What was interrupted later can be continued, and is not overwritten.
    begin(read(*out))
    with pytest.raises(RuntimeError), started(read("--resume", *out), "a-study"):
        raise RuntimeError("killed")
    assert read("--resume", *out).run.resume
    with pytest.raises(ValueError, match="add --resume"):
        read(*out)


def test_options_without_effect_are_refused(tmp_path):
    out = ["--out", str(tmp_path / "out")]
    for given in ("--episodes 3", "--no-precondition --episodes 3"):
        with pytest.raises(ValueError, match=r"makes no use of it: leave out --episodes$"):
            read(*given.split(), *out, unused=("episodes", "top_k"))
    plain = ["--no-precondition", "--weighting", "velocity"]
    assert not read(*plain, *out, unused=("episodes",)).network.precondition


def test_a_misspelt_folder_starts_no_new_run(tmp_path):
    with pytest.raises(ValueError, match=r"there is no run in .*typo; name its folder"):
        read("--resume", "--out", str(tmp_path / "typo"))


def test_options_of_another_version_are_named(tmp_path):
    begin(read("--out", str(tmp_path)))
    path = tmp_path / "options.json"
    tree = json.loads(path.read_text())
    tree["training"]["warm_restarts"] = 3
    path.write_text(json.dumps(tree))
    with pytest.raises(ValueError, match=r"options\.json is not of this version: .*warm_restarts"):
        read("--resume", "--out", str(tmp_path))


def test_two_processes_do_not_share_a_folder(tmp_path):
    recipe = read("--out", str(tmp_path / "out"))
    holding = (
        "import sys, time; from pathlib import Path; from warmprior.io.files import exclusive\n"
        "with exclusive(Path(sys.argv[1])): print(flush=True); time.sleep(60)"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", holding, str(tmp_path / "out")], stdout=subprocess.PIPE
    )
    try:
        process.stdout.readline()
        with pytest.raises(BlockingIOError, match="in use by another process"):
            begin(recipe)
        assert not (tmp_path / "out" / "options.json").exists()
    finally:
        process.kill()
        process.wait()
    with exclusive(tmp_path / "out"):  # which ended with its holder
        pass


def test_default_folders_are_numbered_past_the_latest(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert str(read().run.out) == "runs/a-study-square-ph-quick"
    (tmp_path / "runs" / "a-study-square-ph-quick-2").mkdir(parents=True)
    assert str(read().run.out) == "runs/a-study-square-ph-quick-3"


def test_a_relative_path_continues_the_run_of_the_same_file(tmp_path, monkeypatch):
    write_robomimic_file(tmp_path / "lift.hdf5", lengths=(30, 40), task="lift")
    out = ["--out", str(tmp_path / "out")]
    monkeypatch.chdir(tmp_path)
    begin(read("--dataset", "lift.hdf5", *out))
    monkeypatch.chdir(tmp_path.parent)
    assert read("--resume", *out).data.dataset == tmp_path / "lift.hdf5"


def test_an_option_that_depends_on_the_task():
    def preset(asked):
        recipe = PRESETS[asked.run.preset]
        return replace(recipe, evaluation=EvaluationOptions(episodes=1 + len(asked.data.task)))

    assert read("--task", "can", "stack", preset=preset).evaluation.episodes == 3
    assert isinstance(read(preset=preset), Recipe)


def test_ctrl_c_is_told_in_one_line_whatever_becomes_of_it(capsys):
    def script():
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1)
        except KeyboardInterrupt as error:  # as libraries do that tell where it happened
            raise RuntimeError("in the forward pass") from error

    before = signal.getsignal(signal.SIGINT)
    assert run_script(script, "a.py") == 130
    assert capsys.readouterr().err == "\na.py: interrupted; --resume continues\n"
    assert signal.getsignal(signal.SIGINT) is before


def test_errors_of_ours_are_not_hidden():
    def script():
        raise TypeError("a defect")

    with pytest.raises(TypeError, match="a defect"):
        run_script(script, "a.py")


@pytest.mark.parametrize("group", [True, False])
def test_ctrl_c_ends_a_training_within_seconds(tmp_path, group):
    """As a terminal sends it, to all processes, or to the first alone."""
    pytest.importorskip("robosuite")
    write_robomimic_file(tmp_path / "lift.hdf5", lengths=(30, 40), task="lift")
    argv = ["--dataset", "lift.hdf5", "--iterations", "1000000", "--envs", "2", "--out", "out"]
    process = subprocess.Popen(
        [sys.executable, str(SCRIPT), *argv],
        cwd=tmp_path,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob("policies/*/")) and time.monotonic() < deadline:
        time.sleep(0.1)
    time.sleep(1.0)
    if group:
        os.killpg(process.pid, signal.SIGINT)
    else:
        process.send_signal(signal.SIGINT)
    sent = time.monotonic()
    _, told = process.communicate(timeout=30)
    assert process.returncode == 130 and told.strip().endswith("interrupted; --resume continues")
    assert "Traceback" not in told
    assert time.monotonic() - sent < 10  # two seconds on an idle machine


def test_numbers_of_demonstrations_are_of_presets_only_where_they_are_generated(tmp_path):
    """A preset generates as many as it likes; a file is taken whole unless its user says otherwise."""
    file = tmp_path / "file.hdf5"
    file.touch()
    out = ["--out", str(tmp_path / "out")]
    for preset, (ph, mh) in {"quick": (150, 150), "cpu": (150, 300), "paper": (200, 300)}.items():
        data = read("--preset", preset, *out).data
        assert (data.count("ph"), data.count("mh")) == (ph, mh)
        for argv in (["--dataset", str(file)], ["--download"]):
            data = read("--preset", preset, *argv, *out).data
            assert data.first("ph") is None and data.first("mh") is None
            some = read("--preset", preset, *argv, "--demonstrations", str(ph), *out).data
            assert some.first("ph") == ph  # also where it is the preset's own number


def test_continued_run_keeps_its_part_of_a_file(tmp_path):
    file, out = tmp_path / "file.hdf5", ["--out", str(tmp_path / "out")]
    file.touch()
    for given in ([], ["--demonstrations", "7"]):
        with started(read("--dataset", str(file), *given, *out), "a-study"):
            pass
        assert read("--resume", *out).data.demonstrations == tuple(map(int, given[1:]))
        with pytest.raises(ValueError, match=r"was started with (no )?--demonstrations"):
            read("--resume", *out, "--demonstrations", "8")
