"""LeRobot's policies on a robot: in the executor, and in LeRobot's own loop with a robot of a package."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.errors import refuses
from tests.lerobot.plugin_policies import saved_flow_policy, small, warm
from tests.lerobot.test_actor import preprocessed
from tests.lerobot.tiny import ACTION, CAMERA, LENGTH, STATE
from tests.toy_env import stirred
from warmprior import ChunkStep, PastPrior, RealTimeChunking, policy_transforms
from warmprior.deploy import AsyncExecutor
from warmprior.lerobot import LeRobotActor, WarmPriorAdapter

ROBOT = Path(__file__).parent / "robot"


def observations(steps, side):
    generator = np.random.default_rng(0)
    for _ in range(steps):
        image = generator.integers(0, 256, (side, side, 3), np.uint8)
        yield {"state": generator.normal(size=STATE), "top": image, "battery": 0.5}


@pytest.mark.parametrize("name", ["warm_smolvla", "warm_pi05"])
def test_a_warm_policy_acts_as_its_own_loop_does(found, name):
    """Actions in a robot's units, from observations as drivers return them."""
    torch.manual_seed(0)
    policy = warm(found, name, prior="past", n_action_steps=LENGTH).eval()
    policy.reset()
    expected, seen = [], list(observations(2 * LENGTH + 1, 64))
    torch.manual_seed(1)
    for observation in seen:
        batch = {
            "observation.state": torch.tensor(observation["state"], dtype=torch.float32)[None],
            CAMERA: torch.from_numpy(observation["top"]).permute(2, 0, 1)[None] / 255,
        }
        expected.append(10 * policy.select_action(preprocessed(batch))[0])

    actor = LeRobotActor(policy, preprocess=preprocessed, postprocess=lambda action: 10 * action)
    with AsyncExecutor(actor, latency=0) as executor:
        torch.manual_seed(1)
        found_actions = torch.stack([executor.act(observation) for observation in seen])
        assert executor.execute == LENGTH
        refuses(lambda: executor.act({"state": np.zeros(STATE)}), KeyError, "top")
    assert found_actions.shape == (2 * LENGTH + 1, ACTION)
    torch.testing.assert_close(found_actions, torch.stack(expected))


def test_an_adapter_brings_policy_and_prior(policy):
    made, prior = policy("smolvla"), PastPrior(LENGTH)
    actor = LeRobotActor(WarmPriorAdapter(made, prior, nfe=2), preprocess=preprocessed)
    assert actor.prior is prior and actor.sampling.nfe == 2 and actor.ode.policy is made
    refuses(lambda: LeRobotActor(made), ValueError, "prior")
    few = LeRobotActor(policy("smolvla", n_action_steps=2), prior, preprocess=preprocessed)
    for delay, execute in {0: 2, 1: 2, 4: 4}.items():  # as LeRobot's own loop does, if decisions are as fast
        with AsyncExecutor(few, delay=delay) as executor:
            assert executor.execute == execute
    guided = WarmPriorAdapter(policy("smolvla", n_action_steps=2), prior, guidance=RealTimeChunking())
    refuses(lambda: LeRobotActor(guided), ValueError, "guidance")


@pytest.mark.parametrize("camera", [False, True])
def test_a_warm_flow_policy_acts_by_its_averaged_weights(found, tmp_path, camera):
    from lerobot_policy_warmprior.robot import load_actor

    side = 32
    policy, before, after = saved_flow_policy(found, tmp_path, (3, side, side) if camera else None)
    seen, expected = list(observations(12, side)), []
    torch.manual_seed(1)
    policy.reset()
    for observation in seen:
        observation["state"][-1] = -2.0
        batch = {"observation.state": torch.tensor(observation["state"]).float()[None]}
        batch[CAMERA] = torch.from_numpy(observation["top"]).permute(2, 0, 1)[None] / 255
        expected.append(after(policy.select_action(before(batch)))[0])
    actor = load_actor(tmp_path)
    torch.manual_seed(1)
    with AsyncExecutor(actor, latency=0) as executor:
        actions = [executor.act(observation) for observation in seen]
    torch.testing.assert_close(torch.stack(actions), torch.stack(expected), rtol=1e-4, atol=1e-4)
    assert torch.stack(expected)[:, 0].std() > 0.01
    chunks = next(t for t in policy_transforms(actor) if isinstance(t, ChunkStep))
    assert chunks.execute == executor.execute == policy.config.n_action_steps


@pytest.mark.parametrize("adapted", [False, True])
def test_a_saved_vla_is_loaded_with_its_processors(found, tmp_path, monkeypatch, adapted):
    """Also one that was fine-tuned with ``--peft``, of which LeRobot saves the adapters."""
    from lerobot_policy_warmprior import robot

    policy = warm(found, "warm_smolvla", prior="past", n_action_steps=LENGTH).eval()
    config, place, base = policy.config, str(tmp_path / "run"), str(tmp_path / "base")
    policy.save_pretrained(base if adapted else place)
    if adapted:
        pytest.importorskip("peft")
        config.pretrained_path, config.load_vlm_weights = base, True
        tuned = policy.wrap_with_peft(peft_cli_overrides={"method_type": "LORA", "r": 2})
        config.load_vlm_weights = False
        stirred(torch.nn.ParameterList(w for w in tuned.parameters() if w.requires_grad))
        tuned.save_pretrained(place), config.save_pretrained(place)
    tasks = []

    def before(batch):
        tasks.append(batch.pop("task"))
        return preprocessed(batch)

    # The tokeniser of LeRobot's is on the hub, and so is the backbone's configuration.
    pipelines = before, lambda action: action + 100
    monkeypatch.setattr(robot, "make_pre_post_processors", lambda *args, **options: pipelines)
    with small("warm_smolvla"):
        actors = [robot.load_actor(place, task="wave"), LeRobotActor(policy, preprocess=preprocessed)]
    actions = []
    for actor in actors:
        torch.manual_seed(0)
        with AsyncExecutor(actor, latency=0) as executor:
            actions.append(executor.act(next(iter(observations(1, 64)))))
    assert tasks == [["wave"]] and actions[0].shape == (ACTION,)
    torch.testing.assert_close(actions[0], actions[1] + 100)


@pytest.mark.slow
def test_lerobots_own_loop_runs_a_policy_on_a_robot_of_a_package(tmp_path):
    """Record by a leader, train, run, and record what the policy does; as the page on LeRobot says it."""
    scripts = Path(sys.executable).parent
    if not (scripts / "lerobot-rollout").exists():
        pytest.skip("this release of lerobot has no lerobot-rollout")
    paths = [str(ROBOT), os.environ.get("PYTHONPATH", "")]
    options = os.environ | {
        "PYTHONPATH": os.pathsep.join(path for path in paths if path),
        "HF_LEROBOT_HOME": str(tmp_path / "home"),
        "HF_HUB_OFFLINE": "1",
        "OMP_NUM_THREADS": "1",
    }

    def run(script, *argv):
        command = [sys.executable, str(scripts / script), *argv]
        done = subprocess.run(command, env=options, capture_output=True, text=True, check=False, timeout=600)
        assert done.returncode == 0, done.stderr[-3000:]

    robot = ["--robot.type=sim_arm", "--robot.id=a", "--play_sounds=false"]
    recorded = [
        *("--dataset.num_episodes=2", "--dataset.episode_time_s=2", "--dataset.reset_time_s=0"),
        *("--dataset.fps=20", "--dataset.push_to_hub=false", "--dataset.video=false"),
        "--dataset.single_task=wave",
    ]
    data = ["--dataset.repo_id=local/arm", f"--dataset.root={tmp_path / 'arm'}"]
    run("lerobot-record", *robot, "--teleop.type=sim_leader", *data, *recorded)
    network = "--policy.hidden_dim=32 --policy.num_layers=1 --policy.num_heads=2 --policy.encoder=small"
    sizes = "--policy.image_size=32 --policy.crop_size=28 --policy.nfe=1 --policy.device=cpu"
    recipe = "--batch_size=4 --num_workers=0 --steps=3 --save_freq=3 --policy.push_to_hub=false"
    train = ["--policy.type=warm_flow", *network.split(), *sizes.split(), *recipe.split()]
    run("lerobot-train", *train, *data, f"--output_dir={tmp_path / 'run'}")
    policy = f"--policy.path={tmp_path / 'run' / 'checkpoints' / 'last' / 'pretrained_model'}"
    rollout = ["--fps=20", "--return_to_initial_position=false", policy, *robot]
    run("lerobot-rollout", *rollout, f"--robot.log={tmp_path / 'sent.json'}", "--duration=2", "--task=wave")
    sent = np.array(json.loads((tmp_path / "sent.json").read_text()))
    assert 20 <= len(sent) <= 41 and np.isfinite(sent).all()
    assert np.abs(sent).max() <= 0.51  # targets of the demonstrations
    kept = ["--dataset.repo_id=local/rollout_arm", f"--dataset.root={tmp_path / 'rollout'}"]
    run("lerobot-rollout", *rollout, "--strategy.type=episodic", *kept, *recorded)
    from warmprior.data.formats.lerobot import LeRobotDemonstrations

    steps = LeRobotDemonstrations(tmp_path / "rollout").steps(observations=["observation.state"])
    assert len(steps["episode"].unique()) == 2 and steps["action"].abs().max() <= 0.51
