"""What scripts refuse, in a line, before they write, generate, download or train anything."""

from __future__ import annotations

import importlib

import pytest

from tests.benchmarks.script_parts import refused
from tests.data.synthetic import env_args_15, write_robomimic_file
from warmprior.envs import modernize_env_args

pytest.importorskip("robosuite")
pytest.importorskip("tyro")

FILE = "--dataset {file} --nfe 1"
HELD_OUT = f"{FILE} --validation {{file}}"
DRIFT = "tests.benchmarks.drift"
IMAGES = f"{FILE} --obs image --fast-rendering"


@pytest.fixture
def no_work(monkeypatch):
    def never(*args, **options):
        raise AssertionError("work was begun")

    loaders = ("generate_demonstrations", "download_robomimic")
    for place in ("lab.policies.train_policy", *(f"lab.tasks.{name}" for name in loaders)):
        monkeypatch.setattr(place, never)
    for place in ("lab.tasks.require_rendering", "warmprior.envs.mimicgen.find_spec"):
        monkeypatch.setattr(place, lambda *names: None)


@pytest.mark.parametrize(
    ("script", "words", "message"),
    [
        ("robomimic", "--nfe 0", "--nfe must be a whole number of at least 1, got 0"),
        ("robomimic", "--device cuda:99", "--device cuda:99 does not work here"),
        ("robomimic", f"{FILE} --task can", "holds demonstrations of lift"),
        ("robomimic", f"{FILE} --demonstrations 2 3", "--demonstrations takes one number with --dataset"),
        ("robomimic", "--prior ot --batch-size 1", "ot pairs within a batch"),
        ("robomimic", f"--task {DRIFT}:task {DRIFT}:other", "two tasks are called drift"),
        ("robomimic", "--no-precondition --weighting standardised", "needs --weighting velocity"),
        ("robomimic", "--network chi_transformer --hidden-dim 32", "--hidden-dim 32: num_heads must divide"),
        ("robomimic", "--self-distillation 1 --prior past regression --nfe 1", "leave out regression"),
        ("robomimic", "--objective l1 --prior past bridge", "--objective l1 needs a straight path"),
        ("robomimic", "--self-distillation 1 --prior past bridge", "n needs a straight path: leave out b"),
        ("robomimic", "--times start --prior past", "--times start trains no flow: leave out past"),
        ("robomimic", "--ray-address 127.0.0.1:1", "--ray-address belongs to --engine ray"),
        ("robomimic", f"{IMAGES} --prior ot", "ot reads observations that are one vector"),
        ("navigation1d", "--task can", "the toy has demonstrations of its own: leave out --task"),
        ("navigation1d", "--chunk 64", "--chunk must be at most 32, got 64"),
        ("mimicgen_tasks", "--download --task stack_d0", "need NVlabs' package"),
        ("sigma", f"{HELD_OUT} --chunk 4 8", "this study has one --chunk, got 4 8"),
        ("sigma", f"{HELD_OUT} --observations 5000", "count=5000 observations"),
        ("budget", FILE, "train them with --mask train"),
        ("robomimic", "--mask train", "--mask is that of a file"),
        ("curvature", f"{HELD_OUT} --prior regression", "none of these policies has a flow"),
        ("curvature", "--run {tmp}", "there is no run in"),
        ("real_time_chunking", "--delay 5", "too long"),
        ("real_time_chunking", "--delay -1", "delay must be a whole number of at least 0, got -1"),
        ("real_time_chunking", "--prior regression --nfe 1 --guidance rtc", "regression is no flow to guide"),
        ("prior_space_rl", "--preset unit --horizon 0", "--horizon must be a whole number of at least 1"),
        ("prior_space_rl", "--preset unit --delta 0", "delta must be a finite number > 0, got 0.0"),
        ("prior_space_rl", "--preset unit --task can", "navigation and --preset unit belong together"),
        ("prior_space_rl", "--preset unit --collectors 2", "--collectors belongs to --engine ray"),
        ("prior_space_rl", "--preset unit --prior past step", "--centre zero: step has a centre of its own"),
        ("prior_space_rl", "--preset unit --centre", "--centre needs at least one value"),
        ("robomimic", f"--preset much-ado --task {DRIFT}:task", "has its own: add --actions delta"),
        ("robomimic", f"{FILE} --observation-layers 2", "leave it None with the network mlp"),
        ("robomimic", f"{FILE} --max-grad-norm 0", "max_grad_norm must be a finite number > 0, got 0.0"),
        ("robomimic", "--preset much", "--preset must be one of quick, cpu, paper, much-ado, got 'much'"),
        ("prior_space_rl", "--preset paper", "has hyper-parameters per task: add the --task"),
    ],
)  # fmt: skip
def test_what_cannot_work_is_refused_before_any_work(
    script, words, message, dataset, no_work, tmp_path, capsys
):
    argv = [*words.format(file=dataset, tmp=tmp_path).split(), "--out", tmp_path / "out"]
    assert message in refused(importlib.import_module(script).main, argv, capsys)
    assert not list(tmp_path.glob("policies/*")) and not list(tmp_path.glob("out/*"))


def _unregistered(env_args):
    env_args["env_name"] = "Own"


def _another_name(env_args):
    env_args["env_kwargs"]["env_name"] = "Door"


def _unknown_option(env_args):
    env_args["env_kwargs"]["tusk"] = 1


@pytest.mark.parametrize(
    ("change", "said"),
    [(_unregistered, "'Own'"), (_another_name, "'Door'"), (_unknown_option, "tusk")],
)
@pytest.mark.parametrize("script", ["robomimic", "prior_space_rl"])
def test_an_environment_that_cannot_be_built_is_refused_before_training(
    script, change, said, no_work, tmp_path, capsys
):
    env_args = env_args_15("lift")
    change(env_args)
    path = tmp_path / "own.hdf5"
    write_robomimic_file(path, lengths=(30, 20), task="lift", env_args=env_args)
    argv = ["--dataset", path, "--nfe", 1, "--prior", "past", "--out", tmp_path / "out"]
    line = refused(importlib.import_module(script).main, argv, capsys)
    assert said in line and "own.hdf5" in line
    assert not list(tmp_path.glob("policies/*"))


@pytest.mark.parametrize(
    ("name", "said"), [("mute", "'won'"), ("narrow", "'observation'"), ("broken", "a cable is loose")]
)
def test_an_environment_of_ones_own_is_played_before_training(name, said, no_work, tmp_path, capsys):
    argv = ["--task", f"tests.benchmarks.drift:{name}", "--prior", "past", "--chunk", 4, "--nfe", 1]
    line = refused(importlib.import_module("robomimic").main, [*argv, "--out", tmp_path / "out"], capsys)
    assert said in line and "drift" in line
    assert not list(tmp_path.glob("policies/*")) and not list(tmp_path.glob("out/*"))


def test_the_name_of_the_environment_among_its_options(tmp_path):
    """Some writers repeat it there, and robosuite would be given it twice."""
    env_args = env_args_15("lift")
    env_args["env_kwargs"]["env_name"] = "Lift"
    assert modernize_env_args(env_args) == modernize_env_args(env_args_15("lift"))
