"""Absolute targets in the plugin: observations that hold them, joints, and the source that suits them."""

import json

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.data.lerobot_parts import edit_table, numbers, write_lerobot
from tests.errors import raises
from tests.lerobot.plugin_policies import (
    NEEDS_PLUGIN,
    dataset_policy,
    flow_policy,
)
from tests.toy_env import stirred
from warmprior import (
    Normalizer,
    PastPrior,
    RestingJoints,
    VelocityMLP,
)
from warmprior.__main__ import main
from warmprior.saving import load_policy
from warmprior.training import precondition

pytestmark = NEEDS_PLUGIN

JOINTS = ["pan", "lift", "gripper"]


def joint_dataset(root, names=JOINTS, near=True):
    """Episodes whose actions are a little above the joints that the state reads, or are other numbers."""
    state = numbers(3) | {"names": list(JOINTS)}
    features = {"observation.state": state, "action": numbers(3) | {"names": list(names)}}
    values = write_lerobot(root, (12, 12, 12), features, same=["action"] if near else [])
    (file,) = root.glob("data/*/*.parquet")
    below = values["observation.state"] - np.float32(0.01)
    edit_table(file, observation__state=lambda _: list(below))
    return values | {"observation.state": below}


def test_an_observation_that_is_its_own_target_is_refused_unless_it_is_named(found, tmp_path, caplog):
    """As by ``train``; LeRobot fills in all features only where the options name none."""
    features = {name: numbers(3) for name in ("observation.state", "action", "observation.goal")}
    write_lerobot(tmp_path / "data", (12, 12), features, same=["observation.goal"])
    words = ("'observation.goal'", "of the same step", "--policy.input_features", "(observation.state)")
    for options in ({}, {"precondition": False}):
        with raises(ValueError, *words):
            dataset_policy(found, tmp_path / "data", **options)
    policy, dataset = dataset_policy(found, tmp_path / "data", joints="observation.goal")
    named = {"input_features": policy.config.input_features}
    assert policy.config.observed == ["observation.state", "observation.goal"]
    dataset_policy(found, tmp_path / "data", **named)
    (tmp_path / "data/data").rename(tmp_path / "on the hub")
    kind = found["warm_flow"]
    for given, warned in (({}, True), (named, False)):
        caplog.clear()
        config = kind.config_class(precondition=False, hidden_dim=24, num_layers=1, device="cpu", **given)
        config.input_features, config.output_features = named["input_features"], policy.config.output_features
        kind(config, dataset_meta=dataset.meta)  # as from the factory, whose dataset fetches its steps later
        assert ("its own target" in caplog.text) is warned


def test_joint_targets_are_recognised_and_learnt_from_where_the_robot_is(found, tmp_path):
    """The trend is that of this library for the same steps; with it a policy is saved and loaded."""
    values = joint_dataset(tmp_path / "data")
    policy, _ = dataset_policy(found, tmp_path / "data", n_action_steps=4, prior="past")
    assert policy.config.joints == "observation.state"
    low, high = torch.as_tensor(values["action"]).aminmax(dim=0)  # the statistics of both
    steps = {"observation": values["observation.state"], "action": values["action"]}
    steps = {name: 2 * (torch.as_tensor(value) - low) / (high - low) - 1 for name, value in steps.items()}
    steps["episode"] = torch.arange(36) // 12
    sizes = (3, 3, 4, policy.config.n_obs_steps)
    ends = ({"observation": end, "action": end} for end in (low, high))
    rest = RestingJoints([0, 1, 2], Normalizer(*ends))
    by_hand = precondition(VelocityMLP(*sizes), TensorDict(steps, [36]), PastPrior(4), rest=rest)
    torch.testing.assert_close(policy.actor.network.trend.state_dict(), by_hand.trend.state_dict())
    stirred(policy.actor.network).train()
    policy.save_pretrained(tmp_path / "policy")
    again = found["warm_flow"].from_pretrained(tmp_path / "policy")
    assert again.config.joints == "observation.state"
    assert again.actor.recording.numbers == {"observation.state": JOINTS, "action": JOINTS}
    batch = {"observation.state": torch.randn(2, 3)}
    chunks = []
    for one in (policy, again):
        torch.manual_seed(0)
        one.reset()
        chunks.append(one.predict_action_chunk(dict(batch)))
    assert torch.equal(*chunks)


@pytest.mark.parametrize(("near", "prior"), [(True, "gaussian"), (False, "past,correlation=0.5")])
def test_the_default_source_is_that_of_train(found, tmp_path, near, prior, capsys, caplog):
    """The data decide, after LeRobot asked which steps to load."""
    root = tmp_path / "data"
    joint_dataset(root, near=near)
    loaded = found["warm_flow"].config_class(n_action_steps=4).action_delta_indices
    caplog.set_level("INFO")
    policy, _ = dataset_policy(found, root, n_action_steps=4)
    assert caplog.messages[-1].endswith(f"{prior} (--policy.prior)")
    assert policy.config.action_delta_indices == loaded == list(range(-4, 4))
    words = f"train lerobot:{root} --out {tmp_path} --chunk 4 --iterations 1 --held-out 0"
    words += " --network mlp,hidden_dim=8"
    assert main(words.split()) == 0
    trained = load_policy(capsys.readouterr().out.splitlines()[-1])
    assert policy.actor.prior.config() == trained.prior.config()
    policy.save_pretrained(tmp_path / "policy")
    assert json.loads((tmp_path / "policy/config.json").read_text())["prior"] == prior


def test_a_saved_source_stays_where_the_options_name_none(found, tmp_path):
    policy, usual = flow_policy(found, prior="preview"), flow_policy(found).config
    policy.save_pretrained(tmp_path)
    usual.prior = None
    again = found["warm_flow"].from_pretrained(tmp_path, config=usual)
    assert again.actor.prior.config() == policy.actor.prior.config()


def test_joint_targets_need_joints_in_the_units_that_they_were_fitted_in(found, tmp_path, caplog):
    """RestingJoints maps between minimum and maximum; other units would give other resting actions."""
    from lerobot.configs.types import NormalizationMode

    joint_dataset(tmp_path / "data")
    modes = {**found["warm_flow"].config_class().normalization_mapping, "STATE": NormalizationMode.MEAN_STD}
    options = {"n_action_steps": 4, "normalization_mapping": modes}
    with caplog.at_level("WARNING"):
        policy, _ = dataset_policy(found, tmp_path / "data", **options)
    assert policy.config.joints == "" and "STATE" in caplog.text
    with raises(ValueError, "STATE", "MIN_MAX", "normalization_mapping"):
        dataset_policy(found, tmp_path / "data", joints="observation.state", **options)


@pytest.mark.parametrize(("names", "near"), [(["x", "y", "z"], True), (JOINTS, False)])
def test_other_actions_are_no_joint_targets(found, tmp_path, names, near):
    joint_dataset(tmp_path / "data", names, near)
    policy, _ = dataset_policy(found, tmp_path / "data", n_action_steps=4)
    assert policy.config.joints == "" and policy.actor.network.trend is None
    asked = {"joints": "observation.state"}
    if near:  # the names are only how they are recognised
        policy, _ = dataset_policy(found, tmp_path / "data", n_action_steps=4, **asked)
        assert policy.actor.network.trend is not None
        return
    with raises(ValueError, "observation.state", "joints="):
        dataset_policy(found, tmp_path / "data", **asked)
    with raises(ValueError, "joints", "observation.state", "'wrist'"):
        dataset_policy(found, tmp_path / "data", joints="wrist")
    with raises(ValueError, "precondition=true"):
        dataset_policy(found, tmp_path / "data", precondition=False, **asked)
