import re
import shlex
import shutil
import sys

import pytest

from tests.data.synthetic import env_args_15, write_robomimic_file
from tests.errors import missing
from tests.io.hub_server import TOKEN, model_hub
from tests.processes import apart
from warmprior import (
    PastPrior,
    VelocityMLP,
    VelocityNetwork,
    WarmPriorActor,
    policy_transforms,
)
from warmprior.__main__ import main
from warmprior.saving.policies import load_policy, save_policy

pytest.importorskip("robosuite")
from warmprior.data import open_demonstrations
from warmprior.envs import TASKS, rendering_backend
from warmprior.evaluation import play_episode
from warmprior.tasks import Task
from warmprior.training import NetworkOptions, TrainingConfig, train_policy
from warmprior.training.cloning import policy_path
from warmprior.training.gradient_step import GradientStep

pytestmark = pytest.mark.usefixtures("short_episodes")


@pytest.fixture(scope="module")
def saved(short_episodes, tmp_path_factory):
    """A policy of a few steps, whose demonstrations are gone; and one of its episodes."""
    folder = tmp_path_factory.mktemp("saved")
    path = folder / "lift.hdf5"
    write_robomimic_file(path, lengths=(30, 40), task="lift")
    training = TrainingConfig(iterations=3, batch_size=8, checkpoints=1)
    task, prior = Task(open_demonstrations(path)), PastPrior(8)
    network = NetworkOptions("mlp,hidden_dim=16")
    actor = train_policy(task, prior, folder / "policy", network=network, training=training, description=None)
    env = task.make_env().append_transform(policy_transforms(prior, normalizer=task.normalizer))
    episode = play_episode(actor, env, 10_000_000, nfe=1)
    env.close()
    kept = folder / "kept"
    shutil.copytree(policy_path(folder / "policy", 3), kept)
    path.unlink()
    shutil.rmtree(folder / "policy")
    return kept, episode


def refused(argv, capsys, bars=False):
    """The only line in which it refuses a command line; the last one, below the ``bars`` of a download."""
    assert main(argv) == 2
    *above, said = capsys.readouterr().err.splitlines()
    assert said.startswith("warmprior: error: ") and (bars or not above), [*above, said]
    return said


def test_evaluate_plays_the_same_episodes(saved, capsys):
    folder, episode = saved
    assert main(["evaluate", str(folder), "--episodes", "1", "--nfe", "1"]) == 0
    said = capsys.readouterr().out
    assert f"{int(episode.success)} of 1 episodes solved" in said
    assert f" {episode.steps} control steps on average" in said
    assert main(["info", str(folder)]) == 0
    said = capsys.readouterr().out
    assert "PastPrior(chunk_length=8" in said and "Lift" in said and "VelocityMLP" in said
    assert f"state ({TASKS['lift'].observation_dim},)" in said


def test_evaluate_plays_without_noise_at_temperature_0(saved, monkeypatch):
    import warmprior.evaluation.episodes as evaluation

    played = []
    monkeypatch.setattr(
        evaluation, "evaluate", lambda actor, *args, **options: played.append(actor) or [saved[1]]
    )
    for words in ("", "--temperature 0 --grid dense-jump"):
        assert main(["evaluate", str(saved[0]), "--nfe", "1", *words.split()]) == 0
    assert [actor.sampling.temperature for actor in played] == [None, 0]
    assert str(played[1].sampling.grid) != str(played[0].sampling.grid)


@pytest.mark.skipif(rendering_backend() is None, reason="nothing renders here")
def test_video_has_a_frame_per_control_step(saved, tmp_path, capsys):
    av = pytest.importorskip("av")
    folder, episode = saved
    video = tmp_path / "videos" / "out.mp4"
    argv = ["evaluate", str(folder), "--episodes", "1", "--nfe", "1", "--video", str(video)]
    assert apart(main)(argv) == 0
    with av.open(str(video)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        assert container.streams.video[0].average_rate == 20
    assert len(frames) == episode.steps + 1
    # The arm moves, and neighbours look alike.
    far = abs(frames[0].astype(int) - frames[-1]).mean()
    assert far > abs(frames[0].astype(int) - frames[1]).mean()


def test_a_video_is_refused_before_the_episodes_where_nothing_renders(saved, tmp_path, capsys, monkeypatch):
    pytest.importorskip("av")
    monkeypatch.setattr("warmprior.envs.rendering.rendering_backend", lambda: None)
    argv = ["evaluate", str(saved[0]), "--episodes", "1", "--video", str(tmp_path / "out.mp4")]
    assert main(argv) == 2
    said = capsys.readouterr()
    assert not missing(said.err, "EGL", "OSMesa", "libosmesa6") and "solved" not in said.out


def test_a_policy_is_pushed_and_played_from_the_hub(saved, tmp_path, capsys, monkeypatch):
    pytest.importorskip("huggingface_hub")
    folder, episode = saved
    monkeypatch.chdir(tmp_path)
    assert main(["push", str(folder), "me/lift", "--dry-run"]) == 0
    card = capsys.readouterr().out
    assert card.startswith("---") and "# past on Lift" in card and "Not measured" in card
    with model_hub(monkeypatch, tmp_path / "cache") as hub:
        assert main(["push", str(folder), "me/lift"]) == 2
        assert "401" in capsys.readouterr().err and not hub.repositories
        monkeypatch.setenv("HF_TOKEN", TOKEN)
        assert main(["push", str(folder), "me/lift", "--private", "--license", "mit"]) == 0
        assert hub.repositories["me/lift"].branches["main"] in capsys.readouterr().out
        assert b"license: mit" in hub.files("me/lift")["README.md"]
        assert hub.repositories["me/lift"].private
        assert main(["push", str(folder), "me/lift", "--revision", "v1"]) == 0
        for extra in ([], ["--revision", "v1"]):
            assert main(["info", "me/lift", *extra]) == 0
            assert "PastPrior(chunk_length=8" in capsys.readouterr().out
        assert main(["evaluate", "me/lift", "--episodes", "1", "--nfe", "1"]) == 0
        assert f" {episode.steps} control steps on average" in capsys.readouterr().out
        for argv, fact in (
            (["info", "me/other"], "me/other"),
            (["info", "me/lift", "--revision", "v2"], "v2"),
            (["push", "me/lift", "me/lift"], "folder"),
            (["push", str(folder), "lift"], "user/name"),
        ):
            assert not missing(refused(argv, capsys, bars=True), fact)


def test_what_a_user_can_mend_is_said_in_one_line(saved, tmp_path, capsys):
    bare = tmp_path / "bare"
    network = VelocityMLP(7, 19, 8, hidden_dim=8)
    save_policy(WarmPriorActor(network, PastPrior(8)), bare)
    for argv, fact in (
        (["evaluate", str(tmp_path / "missing")], f"{tmp_path}/missing"),
        (["evaluate", str(bare)], "environment"),
        (["evaluate", str(saved[0]), "--nfe", "0"], "nfe"),
        (["evaluate", str(saved[0]), "--nfe"], "--nfe"),
        (["evaluate", str(saved[0]), "--grid", "sparse"], "'sparse'"),
        (["evaluate", str(saved[0]), "--episodes", "0"], "episodes"),
        (["evaluate", str(saved[0]), "--import", "no.such"], "'no'"),
        (["info", str(tmp_path / "missing")], f"{tmp_path}/missing"),
        (["info", __file__], "file"),
        (["info", str(tmp_path)], "bare"),
        (["train", str(tmp_path)], f"lerobot:{tmp_path}"),
        (["push", str(bare), "name", "--dry-run"], "'name'"),
        (["evaluate", str(saved[0]), "--video", "out.txt"], ".mp4"),
    ):
        assert not missing(refused(argv, capsys), fact)


def test_train_makes_a_policy_per_task_and_continues(tmp_path, capsys, monkeypatch):
    path, out = tmp_path / "lift.hdf5", tmp_path / "my runs"
    write_robomimic_file(path, lengths=(30, 40), task="lift")
    argv = ["train", str(path), "--out", str(out), "--network", "mlp,hidden_dim=8", "--seed", "3"]
    small = [*argv, "--iterations", "2", "--prior", "past,correlation=0.5,sigma=0.3"]
    assert main(small) == 0
    *_, said, folder = capsys.readouterr().out.splitlines()
    words = shlex.split(said[said.index("python -m") :])
    assert words[:5] == ["python", "-m", "warmprior", "evaluate", folder]
    assert folder == str(out / "lift-ph-past,correlation=0.5,sigma=0.3-seed3" / "policy_000002")
    assert main(["info", folder]) == 0
    assert "PastPrior(chunk_length=8, sigma=0.3, correlation=0.5)" in capsys.readouterr().out
    written = {p: p.stat().st_mtime_ns for p in out.rglob("*.safetensors")}
    compiled = []
    monkeypatch.setattr(GradientStep, "compile", lambda update: compiled.append(update))
    assert main([*small, "--compile"]) == 0 and compiled  # there is nothing to do
    assert {p: p.stat().st_mtime_ns for p in out.rglob("*.safetensors")} == written
    for words, facts in (
        (
            "--iterations 4 --network mlp,hidden_dim=9",
            ("iterations was 2 and is 4", "hidden_dim was 8 and is 9"),
        ),
        ("--network plain_mlp --no-precondition", ("network was PreconditionedNetwork and is",)),
        ("--demonstrations 1", ("demonstrations",)),
    ):
        assert main([*small, *words.split()]) == 2
        said = capsys.readouterr().err.splitlines()[-1]
        assert not missing(said, *facts, "--out") and "buffers" not in said
        assert not re.search(r"\b[0-9a-f]{16}\b", said)  # no digest
    assert load_policy(folder).sampling.nfe == 3
    assert main([*small, "--nfe", "1"]) == 0
    assert load_policy(folder).sampling.nfe == 1
    assert not missing(capsys.readouterr().err, folder, "nfe was 3 and is 1")


STRAIGHT = """
import torch
from warmprior import VelocityNetwork

class Straight(VelocityNetwork):
    def __init__(self, action_dim, observation_dim, prediction_length, observation_steps, scale=1.0):
        super().__init__(action_dim, observation_dim, prediction_length, observation_steps)
        self.scale = scale
        self.velocity = torch.nn.Parameter(torch.zeros(prediction_length, action_dim))

    def forward(self, t, a, observation):
        return self.scale * self.velocity.expand_as(a)
"""


def test_a_network_of_ones_own_is_trained_and_imported_again(tmp_path, capsys, monkeypatch):
    path, out = tmp_path / "lift.hdf5", tmp_path / "out"
    write_robomimic_file(path, lengths=(30, 40), task="lift")
    (tmp_path / "straight_networks.py").write_text(STRAIGHT)
    monkeypatch.syspath_prepend(tmp_path)
    argv = ["train", str(path), "--out", str(out), "--iterations", "1", "--network"]
    try:
        assert main([*argv, "straight_networks:Straight,scale=2.0"]) == 0
        folder = capsys.readouterr().out.splitlines()[-1]
        trained = load_policy(folder).network.network
        assert (type(trained).__name__, trained.scale) == ("Straight", 2.0)
        assert (trained.velocity != 0).all()  # one step of Adam moves every weight
        del VelocityNetwork.classes["Straight"], sys.modules["straight_networks"]  # as in another process
        assert not missing(refused(["info", folder], capsys), "velocity network", "'Straight'", "import")
        assert main(["info", folder, "--import", "straight_networks"]) == 0
        assert "Straight" in capsys.readouterr().out
        for words, fact in (
            (["straight_networks:Crooked"], "Crooked"),
            (["straight_networks:Straight,hidden_dim=8"], "hidden_dim"),
        ):
            assert not missing(refused([*argv, *words], capsys), fact)
    finally:
        VelocityNetwork.classes.pop("Straight", None)
        sys.modules.pop("straight_networks", None)


def test_train_at_the_start_alone_is_for_one_step(tmp_path, capsys):
    path = tmp_path / "lift.hdf5"
    write_robomimic_file(path, lengths=(30, 40), task="lift")
    words = "--times start --iterations 2 --network mlp,hidden_dim=8 --held-out 1"
    assert main(["train", str(path), "--out", str(tmp_path / "out"), *words.split()]) == 0
    said = capsys.readouterr().out
    assert "NFE 1:" in said and "NFE 3:" not in said and "--nfe 1\n" in said
    sampling = load_policy(said.splitlines()[-1]).sampling
    assert sampling.nfe == sampling.max_nfe == 1


@pytest.mark.parametrize(("task", "env_name"), [("lift", "MyKitchen"), ("stack_d0", "Stack_D0")])
def test_train_needs_no_simulator(tmp_path, capsys, monkeypatch, task, env_name):
    monkeypatch.setitem(sys.modules, "mimicgen", None)
    path = tmp_path / "own.hdf5"
    write_robomimic_file(path, task=task, env_args=env_args_15(task) | {"env_name": env_name})
    words = (
        f"train {path} --out {tmp_path} --iterations 2 --network mlp,hidden_dim=8 --prior cvae,hidden_dim=8"
    )
    assert main(words.split()) == 0
    said = capsys.readouterr().out
    assert "only trained" in said and load_policy(said.splitlines()[-1]).environment is not None


@pytest.mark.parametrize(
    ("words", "fact"),
    [
        ("--prior nobodys", "'nobodys'"),
        ("", "missing.hdf5"),
        ("--chunk 0", "chunk_length"),
        ("--iterations 0", "iterations"),
        ("--times start --nfe 3", "nfe=3"),
        ("--fast-rendering", "fast_rendering"),
        ("--device gpu", "gpu"),
        ("--device meta", "meta"),
    ],
)
def test_train_refuses_what_cannot_be_before_any_work(tmp_path, capsys, words, fact):
    said = refused(["train", "missing.hdf5", *words.split(), "--out", str(tmp_path / "out")], capsys)
    assert not missing(said, fact)
    assert not (tmp_path / "out").exists()


def test_train_on_a_dataset_of_any_robot(tmp_path, capsys):
    pytest.importorskip("lerobot.datasets")
    from tests.data.lerobot_parts import numbers, write_lerobot

    features = {name: numbers(width) for name, width in {"arm": 3, "cup": 2, "action": 4}.items()}
    write_lerobot(tmp_path / "cups", (12, 12), features)
    words = f"train lerobot:{tmp_path / 'cups'} --observations arm cup --iterations 2"
    assert main([*words.split(), "--network", "mlp,hidden_dim=8", "--out", str(tmp_path / "out")]) == 0
    actor = load_policy(capsys.readouterr().out.splitlines()[-1])
    assert (actor.network.observation_dim, actor.network.action_dim) == (5, 4)
    # Its actions are not near the arm; and of what it has, observations alone are named.
    for more, fact in (
        *(("--joints arm", "cups"), ("--observations leg", "leg")),
        ("--demonstrations 3", "demos=3"),
    ):
        said = refused([*words.split(), *more.split(), "--out", str(tmp_path / "out")], capsys)
        assert not missing(said, fact) and "timestamp" not in said
