import numpy as np
import pytest

pytest.importorskip("robosuite")

from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Compose
from torchrl.envs.utils import check_env_specs

from tests.errors import refuses
from warmprior import PastPrior, RealTimeChunking, VelocityMLP, WarmPriorActor
from warmprior.data.formats.hdf5 import RobomimicDemonstrations
from warmprior.envs import RobosuiteEnv, environment_description, environment_of
from warmprior.envs.description import environment_name, robosuite_parts
from warmprior.envs.simulator import task_env_args
from warmprior.saving.policies import load_policy, save_policy

Rotation = pytest.importorskip("scipy.spatial.transform").Rotation


def actor(tmp_path, actions="absolute", horizon=None):
    environment = environment_description(task_env_args("lift"), "ph", actions, horizon=horizon)
    network = VelocityMLP(10 if actions == "absolute" else 7, 19, 4, hidden_dim=16)
    policy = WarmPriorActor(network, PastPrior(4), nfe=1, environment=environment)
    save_policy(policy, tmp_path)
    return load_policy(tmp_path)


@pytest.mark.parametrize("actions", ["delta", "absolute"])
def test_a_saved_policy_knows_the_space_of_its_actions(tmp_path, actions):
    policy = actor(tmp_path, actions)
    env = environment_of(policy, horizon=6)
    assert environment_name(policy) == "Lift"
    check_env_specs(env)
    rollout = env.rollout(3, policy)
    assert rollout["next", "executed_steps"].flatten().tolist() == [4, 2]
    assert rollout["vla_action", "chunk"].shape[-1] == (10 if actions == "absolute" else 7)
    assert ("eef_pose" in rollout.keys()) == (actions == "absolute")  # noqa: SIM118


def test_a_saved_policy_knows_its_time_limit(tmp_path):
    for horizon, found in ((None, 400), (6, 6)):
        assert environment_of(actor(tmp_path, "delta", horizon)).horizon == found


def test_a_guided_policy_is_told_what_is_left_of_its_chunks(tmp_path):
    guided = actor(tmp_path).replace(guidance=RealTimeChunking())
    rollout = environment_of(guided, horizon=6).rollout(3, guided)
    assert not rollout["rtc", "delay"].any()
    # H = P = 4 actions are executed, and nothing is left.
    assert not rollout["history", "forecast_steps"].any()


@pytest.mark.parametrize("task", ["lift", "transport"])
def test_the_pose_is_that_of_the_controller(task):
    env = RobosuiteEnv(task, eef_pose=True)
    pose = env.rollout(2)["next", "eef_pose"][-1]
    raw = env._env._get_observations(force_update=True)
    for arm, robot in enumerate(env._env.robots):
        controller = robot.part_controllers["right"]
        controller.update(force=True)
        np.testing.assert_allclose(pose[arm, :, :3], controller.ref_ori_mat, atol=1e-6)
        np.testing.assert_allclose(pose[arm, :, 3], raw[f"robot{arm}_eef_pos"], atol=1e-6)
        hand = Rotation.from_quat(raw[f"robot{arm}_eef_quat"])
        site = hand * Rotation.from_euler("z", -90, degrees=True)
        np.testing.assert_allclose(pose[arm, :, :3], site.as_matrix(), atol=1e-5)


def solved(path, actions):
    """Which recorded demonstrations solve the task again, from the start that their seed gives."""
    import h5py

    data = RobomimicDemonstrations(path).steps(actions=actions)
    env_args = RobomimicDemonstrations(path).index().env_args
    make_env, adapters = robosuite_parts(environment_description(env_args, "ph", actions))
    env = TransformedEnv(make_env(), Compose(*adapters.values()))
    outcomes = []
    with h5py.File(path) as file:
        seeds = [file[f"data/demo_{i}"].attrs["seed"] for i in data["episode"].unique()]
    for episode, seed in enumerate(seeds):
        env.set_seed(int(seed), static_seed=True)
        td = env.reset()
        for action in data["action"][data["episode"] == episode]:
            td = env.step(td.set("action", action))["next"]
            if td["done"]:
                break
        outcomes.append(bool(td["success"]))
    env.close()
    return outcomes


def test_demonstrations_replay_in_both_spaces(lift_demonstrations):
    found = [solved(lift_demonstrations, actions) for actions in ("absolute", "delta")]
    assert found == [[True] * 3] * 2


@pytest.mark.parametrize(
    "change",
    [{"actions": "joint"}, {"robosuite": None}, {"images": {"size": 84}}, {"robosuite": {"seed": 7}}],
)
def test_a_description_with_more_or_less_builds_nothing(change):
    described = environment_description(task_env_args("lift"), "ph")
    for name, value in change.items():
        described[name] = {**described.get(name, {}), **value} if isinstance(value, dict) else value
        if value is None:
            del described[name]
    policy = WarmPriorActor(VelocityMLP(7, 19, 4, hidden_dim=16), PastPrior(4), environment=described)
    refuses(lambda: environment_of(policy), ValueError, "environment")
