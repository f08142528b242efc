import math
import shutil
import sys
from functools import partial
from types import ModuleType

import pytest
import torch
from tensordict import NonTensorStack, TensorDict
from torchrl.envs import RenameTransform, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from lab.demonstrations.data_options import DataOptions
from lab.demonstrations.loading import load_task, longest_of, read_like, title_of
from tests.data.synthetic import write_robomimic_file
from tests.errors import raises, refuses
from tests.rl.test_images import CameraEnv
from tests.toy_env import CountingEnv
from warmprior import GaussianPrior, RestingJoints, RestingTrend, keys
from warmprior.data import demonstrations_of, in_memory, open_demonstrations
from warmprior.envs import NavigationEnv
from warmprior.history import cold_history
from warmprior.tasks import Play, Task
from warmprior.training import NetworkOptions, TrainingConfig
from warmprior.training.train import new_policy
from warmprior.transforms import AbsoluteActions


def steps(n=40, **changed):
    g = torch.Generator().manual_seed(0)
    data = {
        "observation": 5 + torch.randn(n, 3, generator=g),
        "action": 100 * torch.rand(n, 2, generator=g),
        "episode": torch.arange(n) // 10,
        "reward": torch.zeros(n),
    }
    return TensorDict({k: v for k, v in (data | changed).items() if v is not None}, [n])


def own(data, make_env=None, name="own", joints=None, **played):
    return Task(demonstrations_of(data, name), joints=joints, play=Play(make_env, **played))


def test_a_task_of_ones_own_is_in_the_units_of_its_demonstrations():
    raw = steps()
    task = own(raw, CountingEnv, measures={"reward": "sum"})
    for key in ("observation", "action"):  # every dimension spans [-1, 1]
        low, high = raw[key].amin(0), raw[key].amax(0)
        expected = 2 * (raw[key] - low) / (high - low) - 1
        torch.testing.assert_close(task.data[key], expected, atol=1e-5, rtol=0)
    assert set(task.data.keys()) == {"observation", "action", "episode"}
    assert torch.allclose(task.normalizer.denormalize(task.data)["action"], raw["action"])
    assert task.facts == {"demonstrations": 4, "steps": 40} and task.clip == 1.0
    assert (title_of(task), longest_of(task), task.images) == ("own human", 10, {})
    assert raw["action"].max() > 50  # the data themselves stay as they were
    # What policies are trained on is what identifies it.
    again, other = (own(steps(action=a), CountingEnv) for a in (raw["action"], raw["action"] ** 2))
    assert task.identity == again.identity != other.identity
    # In other units they are equal once normalised, and yet others.
    scaled = own(steps(action=2 * raw["action"]), CountingEnv)
    torch.testing.assert_close(scaled.data["action"], task.data["action"])
    assert scaled.identity != task.identity
    single = [own(steps(1, episode=torch.tensor([0]).as_strided([1], [n]))) for n in (0, 1)]
    assert single[0].identity == single[1].identity  # TorchRL's buffers of one step may be expanded numbers


@pytest.mark.parametrize(("value", "fact"), [(float("nan"), "NaN"), (2e9, "1e+09"), (-2e9, "1e+09")])
@pytest.mark.parametrize("normalised", [False, True])
@pytest.mark.parametrize("key", ["observation", "action"])
def test_steps_that_no_policy_can_learn_from_are_named(key, normalised, value, fact):
    raw = steps()
    raw[key][7, 1] = value
    with raises(ValueError, key, fact):
        Task(demonstrations_of(raw, "own", normalised=normalised))


def test_images_in_memory_are_resized_once(monkeypatch):
    raw, seen = steps(), list[int]()
    image = torch.zeros(len(raw), 3, 20, 30, dtype=torch.uint8)
    raw["observation"] = TensorDict({"state": raw["observation"], "wrist": image}, [len(raw)])
    resized = in_memory.resized
    monkeypatch.setattr(in_memory, "resized", lambda x, *a: seen.append(len(x)) or resized(x, *a))
    task = Task(demonstrations_of(raw, "own"))
    assert sum(seen) == len(raw) and task.data["observation", "wrist"].shape[-2:] == (84, 84)


@pytest.mark.parametrize("precondition", [False, True])
def test_no_action_leaves_the_range_of_the_demonstrations(precondition):
    """One dimension never moves, and one is so far from zero that it counts as constant."""
    moving = torch.rand(40, 1, generator=torch.Generator().manual_seed(0))
    raw = steps(action=torch.cat((moving, torch.full((40, 1), 0.7), 400_000 + 6 * moving), 1))
    task = own(raw, CountingEnv)
    network = NetworkOptions("mlp,hidden_dim=8", precondition=precondition)
    policy = new_policy(task, GaussianPrior(4), network, TrainingConfig(iterations=1))
    observation = torch.randn(64, 2, 3, generator=torch.Generator().manual_seed(1))
    data = TensorDict({"observation": observation, "history": cold_history([64], 4, 4, 3)}, [64])
    for parameter in policy.network.parameters():
        torch.nn.init.normal_(parameter, std=3.0)  # an untrained network, which predicts anything
    chunk = policy(data)["vla_action", "chunk"]
    actions = task.normalizer.denormalize(TensorDict({"action": chunk}, [64, 4]))["action"]
    low, high = (
        end + torch.tensor([0.0, 0.0, 0.1]) * sign
        for end, sign in ((raw["action"].amin(0), -1), (raw["action"].amax(0), 1))
    )
    assert (actions >= low - 1e-6).all() and (actions <= high + 1e-6).all()
    assert actions[..., 2].amax() - actions[..., 2].amin() > 5  # the whole range is reached


def test_a_function_of_ones_own_is_found_by_its_place(monkeypatch):
    place = ModuleType("a_users_module")
    place.task = lambda options: own(steps()[: options.count("ph")], CountingEnv)
    place.number = lambda options: 3
    monkeypatch.setitem(sys.modules, "a_users_module", place)
    options = DataOptions(demonstrations=(20,))
    assert load_task(options, "a_users_module:task").facts["steps"] == 20
    for name, facts in (
        ("a_users_module:number", ["int", "Task"]),
        ("a_users_module:nothing", ["a_users_module:nothing"]),
        ("no_such_module:task", ["no_such_module"]),
        ("nothing", ["task", "'nothing'"]),
    ):
        with raises(ValueError, *facts):
            load_task(options, name)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    pytest.importorskip("robosuite")
    path = tmp_path_factory.mktemp("data") / "lift.hdf5"
    write_robomimic_file(path, lengths=(30, 20), task="lift")
    return path


def in_both_spaces(path):
    return [Task(open_demonstrations(path), actions=a) for a in ("delta", "absolute")]


def test_absolute_actions_have_the_units_of_deltas(path):
    delta, absolute = in_both_spaces(path)
    assert "actions" not in delta.facts and title_of(delta) == "lift ph (file data)"
    assert absolute.identity != delta.identity and absolute.data["action"].shape == (50, 10)
    assert title_of(absolute) == "lift ph (file data), absolute actions"
    assert isinstance(absolute.adapters["actions"], AbsoluteActions) and not delta.adapters
    # What is executed spans what was recorded.
    units = [0.05] * 3 + [0.5] * 6
    assert absolute.normalizer.scale("action")[:9].tolist() == pytest.approx(units)
    assert absolute.data["action"][:, 9].abs().max() <= 1
    options = NetworkOptions("mlp,hidden_dim=16")
    made = [new_policy(t, GaussianPrior(8), options, TrainingConfig()) for t in (delta, absolute)]
    trends = [actor.network.trend for actor in made]
    assert trends[0] is None and isinstance(trends[1], RestingTrend)


def joint_steps(n=400):
    """Two joints that follow their targets, the second in other units, and a gripper's command."""
    g = torch.Generator().manual_seed(0)
    joints = torch.randn(n, 2, generator=g).cumsum(0) * torch.tensor([0.1, 30.0])
    moves = torch.randn(n, 2, generator=g) * torch.tensor([0.1, 30.0])
    command = torch.rand(n, 1, generator=g).round()
    seen = torch.cat([torch.randn(n, 1, generator=g), joints.flip(-1)], -1)
    return seen, torch.cat([joints + moves, command], -1), moves


def arm(seen, action, joints=None):
    return own(steps(len(action), observation=seen, action=action), joints=joints)


def test_joint_targets_are_learnt_from_where_the_joints_are():
    seen, action, moves = joint_steps()
    plain = arm(seen, action)
    task = arm(seen, action, [2, 1, -1])
    assert task.identity != plain.identity == arm(seen, action).identity
    rest = task.normalizer.denormalize(TensorDict({"action": task.rest(task.data["observation"])}, [400]))
    torch.testing.assert_close(rest["action"][:, :2], seen[:, [2, 1]], rtol=1e-4, atol=1e-4)
    options = NetworkOptions("mlp,hidden_dim=16", observation_steps=1)
    with_trend, without = (
        new_policy(t, GaussianPrior(1), options, TrainingConfig()).network for t in (task, plain)
    )
    # At t = 0 the remainder is that of the moves, where it was that of the targets.
    start, units = torch.zeros(1), task.normalizer.scale("action")
    found, before = (network.remainder(start)[0, 0] * units for network in (with_trend, without))
    torch.testing.assert_close(found[:2], moves.std(0), rtol=0.1, atol=0)
    torch.testing.assert_close(before[:2], action[:, :2].std(0), rtol=0.1, atol=0)
    assert found[2] == pytest.approx(float(before[2]), rel=0.05)


def test_joints_may_hang_below_their_targets():
    """And one of them hardly moves."""
    seen, action, _ = joint_steps()
    for columns, *facts in (
        *(([1, 2, -1], "action", "number"), ([0, 1, -1], "action 0", "number 0")),
        *(([2, 1], 3), ([2, 3, -1], "-1 to 2"), ([-1, -1, -1], -1), ([2, 1.5, -1], 1)),
    ):
        with raises(ValueError, *facts):
            arm(seen, action, columns)
    action[:, :2] = seen[:, [2, 1]] + torch.tensor([0.5, 10.0])
    seen = torch.cat([seen, torch.rand(400, 1)], -1)
    action = torch.cat([action, torch.full((400, 1), 0.3)], -1)
    task = arm(seen, action, [2, 1, -1, 3])
    assert isinstance(task.rest, RestingJoints)
    for factor in (0.5, 57.3):  # other units
        other = action * torch.tensor([factor, factor, 1.0, 1.0])
        with raises(ValueError, "units"):
            arm(seen, other, [2, 1, -1, -1])


def test_other_observations_are_another_task(path):
    keys = ["object", "robot0_eef_pos"]
    tasks = [Task(open_demonstrations(path), observations=k) for k in (None, keys, keys[::-1])]
    assert len({task.identity for task in tasks}) == 3


def test_joint_targets_beside_images():
    seen, action, _ = joint_steps(60)
    images = torch.zeros(60, 3, 16, 16, dtype=torch.uint8)
    observation = TensorDict({"state": seen, "front": images}, [60])
    task = arm(observation, action, [2, 1, -1])
    options = NetworkOptions("mlp,hidden_dim=16", observation_steps=1, encoder="small", crop_size=12)
    network = new_policy(task, GaussianPrior(1), options, TrainingConfig()).network
    data = task.data[:5]["observation"].unsqueeze(1)
    source, target = network.trend(network.encode(data))
    expected = network.trend(data["state"])
    torch.testing.assert_close(target, expected[1])
    assert source.abs().max() < 0.2 < target.abs().max()


def test_data_that_cannot_be_are_named():
    for name, changed, error, *facts in (
        ("own", {"episode": None}, KeyError, "own", "['episode']"),
        ("own", {"action": torch.zeros(40)}, ValueError, "own", "'action'", "(40,)"),
        ("own", {"action": torch.zeros(40, 1) + 1j}, ValueError, "own", "'action'", "complex64"),
        ("own", {"episode": NonTensorStack(*map(str, range(40)))}, ValueError, "own", "'episode'", "text"),
        ("own", {"observation": torch.full((40, 3), math.nan)}, ValueError, "observation"),
        ("../own", {}, ValueError, "'../own'"),
    ):
        with raises(error, *facts):
            own(steps(**changed), CountingEnv, name=name)
    for image in (torch.zeros(40, 32, 48, 3, dtype=torch.uint8), torch.zeros(40, 3, 32, 48)):
        with raises(ValueError, "own", "'front'", tuple(image.shape), image.dtype, "[N, 3, h, w]"):
            own(steps(observation=TensorDict({"front": image, "state": torch.rand(40, 2)}, [40])))
    fitting = {"observation": torch.randn(40, 9), "action": torch.rand(40, 1)}
    own(steps(**fitting), NavigationEnv).check_environment()
    for changed in ({"observation": torch.randn(40, 5)}, {"action": torch.rand(40, 3)}):
        task = own(steps(**fitting | changed), NavigationEnv)
        with raises(ValueError, "own human", f"'{next(iter(changed))}'"):
            task.check_environment()


def test_an_environment_with_transforms_of_its_own_takes_random_chunks():
    task = own(
        steps(observation=torch.randn(40, 9), action=torch.rand(40, 1)),
        lambda: TransformedEnv(NavigationEnv(), StepCounter()),
    )
    env = task.env(GaussianPrior(4))
    renamed = TransformedEnv(task.env(GaussianPrior(4)), RenameTransform([], [], [keys.CHUNK], ["plan"]))
    for each, key in ((env, keys.CHUNK), (renamed, "plan")):
        check_env_specs(each)
        rollout = each.rollout(2)
        assert rollout[key].shape == (2, 4, 1)
        assert rollout["next", "step_count"].flatten().tolist() == [4, 8]


def test_an_environment_with_images_fits_its_demonstrations():
    def pictured(size, action_dim):
        seen = {"state": torch.rand(40, 4), "cam": torch.zeros(40, 3, size, size, dtype=torch.uint8)}
        changed = {"observation": TensorDict(seen, [40]), "action": torch.rand(40, action_dim)}
        return own(steps(**changed), partial(CameraEnv, 7))

    pictured(10, 2).check_environment()
    # One action would be given to both dimensions of the environment's.
    for size, action_dim, named in ((12, 2, "'cam'"), (10, 1, "'action'")):
        with raises(ValueError, "own human", named):
            pictured(size, action_dim).check_environment()


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"actions": "absolute", "horizon": 9}, "actions, horizon"),
        ({"fast_rendering": True, "make_env": NavigationEnv}, "fast_rendering"),
        ({"fast_rendering": True}, "images"),
        ({"success": "solved"}, "make_env"),
        ({"actions": "pose"}, "delta, absolute"),
    ],
)
def test_an_option_that_cannot_be_applied_is_refused(path, tmp_path, options, named):
    place, actions = path, options.pop("actions", "delta")
    images = {"images": ["agentview_image"]} if "make_env" in options else {}
    if "horizon" in options:  # a robot's file
        place = shutil.copy(path, tmp_path / "robot.hdf5")
        with pytest.importorskip("h5py").File(place, "a") as file:
            del file["data"].attrs["env_args"]
    with raises(ValueError, named):
        Task(open_demonstrations(place), **images, actions=actions, play=Play(**options))


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda path: Task(path), "open_demonstrations(place)"),
        (lambda path: Task(open_demonstrations(path), observations="object"), "observations"),
        (lambda path: Task(open_demonstrations(path), images="agentview_image"), "['agentview_image']"),
        (lambda path: Play(NavigationEnv, measures=["reward"]), "measures"),
        (lambda path: open_demonstrations(path, episodes=[0]), "episodes"),
        (lambda path: Task(open_demonstrations(path, task={"env_name": "Door"})), "Door"),
    ],
)
def test_an_argument_of_another_kind_is_named(path, call, named):
    refuses(lambda: call(path), (TypeError, ValueError), named)


def test_part_of_a_file_is_its_first_demonstrations(path):
    from warmprior.data import DatasetError

    whole, part, all_ = (Task(open_demonstrations(path, demos=n)) for n in (None, 1, 2))
    assert all_.identity == whole.identity != part.identity  # other policies, of the same file
    assert part.facts["sha256"] == whole.facts["sha256"]
    assert part.facts["demonstrations"] == 1 and part.facts["steps"] == len(part.data) == 30
    mine, theirs = (t.normalizer.denormalize(t.data)["action"] for t in (part, whole))
    assert torch.allclose(mine, theirs[:30], atol=1e-6)
    refuses(lambda: Task(open_demonstrations(path, demos=3)), DatasetError, 2, "demos=3")


def test_further_demonstrations_are_read_as_a_policy_sees_them(path, tmp_path):
    other = tmp_path / "other.hdf5"
    write_robomimic_file(other, lengths=(25, 9), task="lift", seed=1)
    for task in in_both_spaces(path):
        data, called = read_like(other, task.name, task.facts)
        assert data["action"].shape == (34, task.data["action"].shape[1])
        assert called == "other.hdf5"
        raw = task.normalizer.denormalize(task.data)
        same, _ = read_like(path, task.name, task.facts)
        assert torch.allclose(same["action"], raw["action"], atol=1e-5)


def test_a_lerobot_dataset_is_the_task_of_its_file(path, tmp_path):
    pytest.importorskip("lerobot")
    from warmprior.data import convert_robomimic

    folder = convert_robomimic(path, tmp_path / "lift")
    file, theirs = (Task(open_demonstrations(p, task="lift")) for p in (path, f"lerobot:{folder}"))
    assert (file.data == theirs.data).all() and file.name == theirs.name == "lift"
    assert file.environment == theirs.environment and file.identity != theirs.identity
    chosen = {
        episodes: Task(open_demonstrations(f"lerobot:{folder}", task="lift", episodes=list(episodes)))
        for episodes in ((0,), (1,), (0, 1))
    }
    assert len({task.identity for task in chosen.values()}) == 3
    assert chosen[0, 1].identity == theirs.identity  # all of them
    first = Task(open_demonstrations(f"lerobot:{folder}", task="lift", demos=1))
    assert first.identity == chosen[0,].identity  # the same steps, however they are asked for
    (folder / "meta" / "warmprior.json").unlink()  # as from another converter
    for actions, width in (("delta", 7), ("absolute", 10)):
        named = Task(open_demonstrations(f"lerobot:{folder}", task="lift"), actions=actions)
        assert named.data["action"].shape[-1] == width
        assert named.environment["robosuite"]["env_args"]["env_name"] == "Lift"
    assert open_demonstrations(f"lerobot:{folder}", task="lift").name == "lerobot:lift"
