"""What scripts refuse, in a line, before they write, generate, download or train anything."""

import importlib

import h5py
import numpy as np
import pytest

from tests.benchmarks.script_parts import refused
from tests.data.synthetic import env_args_15, write_robomimic_file
from tests.errors import missing

FILE = "--dataset {file} --nfe 1"
HELD_OUT = f"{FILE} --validation {{file}}"
DRIFT = "tests.benchmarks.drift"
IMAGES = f"{FILE} --obs image --fast-rendering"


@pytest.fixture
def no_work(monkeypatch):
    def never(*args, **options):
        raise AssertionError("work was begun")

    loaders = ("generate_demonstrations", "download_robomimic")
    for place in (
        "lab.running.policies.train_policy",
        *(f"lab.demonstrations.loading.{name}" for name in loaders),
    ):
        monkeypatch.setattr(place, never)
    for place in ("warmprior.envs.rendering.require_rendering", "warmprior.envs.mimicgen.find_spec"):
        monkeypatch.setattr(place, lambda *names: None)


@pytest.mark.parametrize(
    ("script", "words", "facts"),
    [
        ("robomimic", "--nfe 0", ("--nfe", "0")),
        ("robomimic", "--device cuda:99", ("device cuda:99",)),
        ("robomimic", "--task x", ("--task x", "lift, can")),
        ("robomimic", "--temperature 1 -0.5", ("--temperature -0.5", ">= 0")),
        ("robomimic", "--grid odd", ("--grid odd", "dense-jump")),
        ("robomimic", f"{FILE} --task can", ("demonstrations of lift", "can")),
        ("robomimic", f"{FILE} --demonstrations 2 3", ("--demonstrations", "--dataset")),
        ("robomimic", "--prior ot --batch-size 1", ("ot", "batch")),
        ("robomimic", f"--task {DRIFT}:task {DRIFT}:other", ("drift",)),
        ("robomimic", "--no-precondition --weighting standardised", ("--weighting velocity",)),
        ("robomimic", "--network chi_transformer,hidden_dim=32", ("--network", "hidden_dim=32", "num_heads")),
        ("robomimic", "--objective l1 --prior past bridge", ("--objective l1", "bridge")),
        ("robomimic", "--times start --prior past", ("--times start", "past")),
        ("robomimic", "--ray-address 127.0.0.1:1", ("--ray-address", "--engine ray")),
        ("robomimic", f"{IMAGES} --prior ot", ("ot", "vector")),
        ("robomimic", f"{FILE} --images agentview_image --prior ot", ("ot", "vector")),
        ("robomimic", f"{FILE} --fast-rendering", ("--fast-rendering", "--images")),
        ("pusht", "--images agentview_image", ("leave out", "--images")),
        ("navigation1d", "--task can", ("--task",)),
        ("joint_targets", FILE, ("--dataset",)),
        ("joint_targets", "--horizon 9 --mask train --download", ("--download, --mask",)),
        ("pusht", "--horizon 9 --style mh", ("--horizon, --style",)),
        ("pusht", "--demonstrations 25 50", ("--demonstrations", "(25, 50)")),
        ("navigation1d", "--chunk 64", ("--chunk", "32", "64")),
        ("mimicgen_tasks", "--download --task stack_d0", ("NVlabs",)),
        ("sigma", f"{HELD_OUT} --chunk 4 8", ("--chunk", "4 8")),
        ("sigma", f"{HELD_OUT} --measured 5000", ("--measured 5000",)),
        ("budget", FILE, ("--mask train",)),
        ("robomimic", "--mask train", ("--mask", "file")),
        ("curvature", f"{HELD_OUT} --prior regression", ("flow",)),
        ("curvature", "--run {tmp}", ("{tmp}",)),
        ("real_time_chunking", "--delay 5", ("delay of 5",)),
        ("real_time_chunking", "--delay -1", ("delay", "-1")),
        ("real_time_chunking", "--prior regression --nfe 1 --guidance rtc", ("regression", "guide")),
        ("prior_space_rl", "--preset unit --horizon 0", ("--horizon",)),
        ("prior_space_rl", "--preset unit --times start", ("--times start", "past")),
        ("prior_space_rl", "--objective l1 --prior bridge", ("--objective l1", "bridge")),
        ("robomimic", f"--task {DRIFT}:task --style ph mh", ("--style", "ph mh")),
        ("prior_space_rl", "--preset unit --delta 0", ("delta", "0.0")),
        ("prior_space_rl", "--preset unit --task can", ("navigation", "--preset unit")),
        ("prior_space_rl", "--preset unit --collectors 2", ("--collectors", "--engine ray")),
        ("prior_space_rl", "--preset unit --prior past step", ("--centre zero", "step")),
        ("prior_space_rl", "--preset unit --centre", ("--centre",)),
        ("robomimic", f"--preset much-ado --task {DRIFT}:task", ("--actions delta",)),
        ("robomimic", "--observations object", ("--observations", "--dataset")),
        ("robomimic", f"{FILE} --network mlp,num_heads=2", ("--network mlp", "num_heads", "num_blocks")),
        ("robomimic", "--preset much", ("--preset", "quick, cpu, paper, much-ado", "'much'")),
        ("prior_space_rl", "--preset paper", ("--task",)),
        *(
            (script, f"{HELD_OUT} --temperature 1 0", ("--temperature", "1.0 0.0"))
            for script in ("sigma", "budget")
        ),
        *((s, f"{FILE} --temperature 1 0", ("--temperature",)) for s in ("chunking", "real_time_chunking")),
        *(("navigation1d", words, ("toy",)) for words in ("--temperature 0", "--play-on")),
        ("navigation1d", "--prior regression", ("flow",)),
        ("prior_space_rl", "--preset unit --temperature 0", ("--temperature",)),
        ("prior_space_rl", "--preset unit --horizon 3", ("toy", "--horizon")),
        ("robomimic", "--no-precondition --prior mip", ("mip", "preconditioning")),
        ("gpu", "--part 7", ("--part", "0, 1, 2, 3, 4, 5", "'7'")),
        ("gpu", "--preset none", ("--preset", "quick, cpu, paper")),
    ],
)
def test_what_cannot_work_is_refused_before_any_work(
    script, words, facts, dataset, no_work, tmp_path, capsys
):
    argv = [*words.format(file=dataset, tmp=tmp_path).split(), "--out", tmp_path / "out"]
    line = refused(importlib.import_module(script).main, argv, capsys)
    assert not missing(line, *(fact.format(tmp=tmp_path) for fact in facts)), line
    assert not list(tmp_path.glob("policies/*")) and not list(tmp_path.glob("out/*"))


@pytest.mark.parametrize(
    ("change", "fact"),
    [
        (lambda env_args: env_args.update(env_name="Own"), "'Own'"),
        (lambda env_args: env_args["env_kwargs"].update(env_name="Door"), "'Door'"),
        (lambda env_args: env_args["env_kwargs"].update(tusk=1), "tusk"),
    ],
)
@pytest.mark.parametrize("script", ["robomimic", "prior_space_rl"])
def test_an_environment_that_cannot_be_built_is_refused_before_training(
    script, change, fact, no_work, tmp_path, capsys
):
    path, env_args = tmp_path / "own.hdf5", env_args_15("lift")
    change(env_args)
    write_robomimic_file(path, lengths=(30, 20), task="lift", env_args=env_args)
    argv = ["--dataset", path, "--nfe", 1, "--prior", "past", "--out", tmp_path / "out"]
    line = refused(importlib.import_module(script).main, argv, capsys)
    assert not missing(line, fact, "own.hdf5"), line
    assert not list(tmp_path.glob("policies/*"))


@pytest.mark.parametrize("preset", ["quick", "cpu"])
def test_a_robots_own_file_is_refused_before_its_images_are_read(
    preset, no_work, tmp_path, capsys, monkeypatch
):
    """It names no environment to play in, whatever options of images a preset has."""
    path, frames = tmp_path / "arm.hdf5", np.zeros((20, 48, 64, 3), np.uint8)
    with h5py.File(path, "w") as file:
        demo = {"actions": np.eye(20, 2), "obs/joints": np.eye(20, 3), "obs/wrist": frames}
        for name, value in demo.items():
            file[f"data/demo_0/{name}"] = value
    monkeypatch.delattr("warmprior.data.formats.hdf5.RobomimicReader.images")
    words = f"--dataset {path} --images wrist --preset {preset} --out {tmp_path / 'out'}"
    line = refused(importlib.import_module("robomimic").main, words.split(), capsys)
    assert not missing(line, "arm.hdf5", "which environment", "python -m warmprior train"), line


@pytest.mark.parametrize(
    ("name", "said"), [("mute", "'won'"), ("narrow", "'observation'"), ("broken", "a cable is loose")]
)
def test_an_environment_of_ones_own_is_played_before_training(name, said, no_work, tmp_path, capsys):
    argv = ["--task", f"tests.benchmarks.drift:{name}", "--prior", "past", "--chunk", 4, "--nfe", 1]
    line = refused(importlib.import_module("robomimic").main, [*argv, "--out", tmp_path / "out"], capsys)
    assert not missing(line, said, "drift"), line
    assert not list(tmp_path.glob("policies/*")) and not list(tmp_path.glob("out/*"))
