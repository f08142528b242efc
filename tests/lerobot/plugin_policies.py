"""Small policies of the plugin, with their observations and batches."""

from functools import partial
from importlib.util import find_spec

import pytest
import torch

from tests.lerobot.tiny import (
    STATE,
    features,
    make_groot,
    make_pi,
    make_smolvla,
    tiny_gemma,
    tiny_groot,
    tiny_smolvlm,
)
from tests.toy_env import stirred

NEEDS_PLUGIN = pytest.mark.skipif(
    find_spec("lerobot_policy_warmprior") is None, reason="needs lerobot_policy_warmprior"
)
VLA = ["warm_smolvla", "warm_pi05", "warm_groot"]


def warm(found, name, **options):
    kind = found[name]
    config = kind.config_class
    make = {"warm_smolvla": make_smolvla, "warm_groot": make_groot}.get(name, partial(make_pi, "pi05"))
    return make(kind, config, **options)


def small(name):
    if name == "warm_groot":
        return tiny_groot()
    if name == "warm_smolvla":
        from lerobot.policies.smolvla import smolvlm_with_expert

        return tiny_smolvlm(smolvlm_with_expert)
    from lerobot.policies.pi05 import modeling_pi05

    return tiny_gemma(modeling_pi05)


def flow_policy(found, images=None, **options):
    from lerobot.configs.types import FeatureType, PolicyFeature

    inputs = {
        "observation.state": PolicyFeature(type=FeatureType.STATE, shape=(3,)),
        "observation.environment_state": PolicyFeature(type=FeatureType.ENV, shape=(2,)),
    }
    if images is not None:
        inputs["observation.images.top"] = PolicyFeature(type=FeatureType.VISUAL, shape=images)
        options = {"encoder": "small", "image_size": 16, "crop_size": 12} | options
    outputs = {"action": PolicyFeature(type=FeatureType.ACTION, shape=(2,))}
    chosen = {"hidden_dim": 24, "num_layers": 1, "nfe": 1, "n_action_steps": 4, "device": "cpu"}
    kind, features = found["warm_flow"], {"input_features": inputs, "output_features": outputs}
    torch.manual_seed(0)
    return kind(kind.config_class(**features, **chosen | options))


STATS = {
    "observation.state": {"min": [-2.0] * STATE, "max": [4.0] * (STATE - 2) + [-1.99999, -2.0]},
    "action": {"min": [-3.0, -3.0], "max": [7.0, -3.0]},
}
"""The last dimension of both never changes, and the state's last but one by its rounding noise."""


def saved_flow_policy(found, folder, image=None):
    """A policy with two actions and its processors, saved as a training run saves them."""
    from lerobot_policy_warmprior.processor_warm_flow import make_warm_flow_pre_post_processors

    kind, named = found["warm_flow"], features(image)
    named["output_features"]["action"].shape = (2,)
    small = {"hidden_dim": 32, "num_layers": 1, "num_heads": 2, "encoder": "small", "nfe": 2}
    small |= {"n_action_steps": 5, "prior_chunk": 8}  # fewer are executed than remembered
    config = kind.config_class(precondition=False, image_size=32, crop_size=28, **small, **named)
    torch.manual_seed(0)
    policy = kind(config)
    stirred(policy.actor.network, by=0.05)
    policy.update()
    stirred(policy.actor.network, by=0.5)
    policy.save_pretrained(folder)
    stats = {name: {end: torch.tensor(v) for end, v in of.items()} for name, of in STATS.items()}
    pipelines = make_warm_flow_pre_post_processors(config, stats)
    for pipeline in pipelines:
        pipeline.save_pretrained(folder)
    return policy, *pipelines


def one_observation():
    return {"observation.state": torch.randn(2, 3), "observation.environment_state": torch.randn(2, 2)}


def flow_batch(length, size=3):
    generator = torch.Generator().manual_seed(0)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    return {
        "observation.state": normal(size, 2, 3),
        "observation.environment_state": normal(size, 2, 2),
        "action": normal(size, length, 2),
        "action_is_pad": torch.zeros(size, length, dtype=torch.bool),
    }


def dataset_policy(found, root, episodes=None, place=None, streamed=False, **options):
    """As lerobot-train makes it, which names the dataset's metadata alone; and that dataset."""
    from lerobot.datasets import LeRobotDataset, StreamingLeRobotDataset
    from lerobot.policies.factory import make_policy

    config = found["warm_flow"].config_class(hidden_dim=24, num_layers=1, device="cpu", **options)
    config.pretrained_path = place
    kind = StreamingLeRobotDataset if streamed else LeRobotDataset
    dataset = kind("local/tiny", root=root, episodes=episodes)
    return make_policy(config, ds_meta=dataset.meta), dataset
