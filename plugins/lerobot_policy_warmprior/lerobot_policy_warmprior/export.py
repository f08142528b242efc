"""Export of a saved policy to LeRobot, for ``lerobot-eval``.

python -m lerobot_policy_warmprior.export POLICY_FOLDER LEROBOT_FOLDER
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import cast

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from torch import Tensor

from lerobot_policy_warmprior.configuration_warm_flow import WarmFlowConfig
from lerobot_policy_warmprior.modeling_warm_flow import WarmFlowPolicy
from lerobot_policy_warmprior.processor_warm_flow import make_warm_flow_pre_post_processors
from warmprior import PreconditionedNetwork, VelocityNetwork, keys
from warmprior.envs import TASKS
from warmprior.envs.description import environment_name
from warmprior.io.script import read_command_line, run_script
from warmprior.saving.policies import load_policy

_FEATURES = {"observation.environment_state": FeatureType.ENV, "observation.state": FeatureType.STATE}


def export_policy(folder: str | Path, out: str | Path) -> Path:
    """Write a saved policy, its normaliser included, as LeRobot's ``warm_flow``; ``out`` must not exist.

    Its observations are named as in converted demonstrations (``python -m warmprior convert``): the state of
    the objects is ``observation.environment_state``, that of the robot ``observation.state``. In an unknown
    environment the whole vector is ``observation.state``.

    Raises:
        FileExistsError: if ``out`` exists.
        ValueError: if the policy has images, absolute actions, no normaliser, another sampler than Euler's in
            uniform steps from the source, a network that sees the last actions, or a learned prior.
    """
    out = Path(out)
    if out.exists():
        raise FileExistsError(f"{out} exists: choose another folder")
    actor = load_policy(folder)
    described = actor.environment or {}
    sees_history = actor.sees_history
    sees_images = cast(VelocityNetwork, actor.network).encodes
    if sees_history or sees_images or "actions" in described:
        raise ValueError(
            f"{folder}: policies with images, absolute actions or observed last actions need transforms that "
            "LeRobot does not have: export a policy with states and pose deltas"
        )
    if actor.normalizer is None or actor.sampling.clip != 1.0:
        raise ValueError(
            f"{folder}: the policy needs a normaliser, and the bound clip=1.0 on its actions (it has "
            f"{actor.sampling.clip}), because warm_flow has both"
        )
    usual = {"solver": "euler", "grid": "uniform", "max_nfe": None, "temperature": None}
    usual |= {"guidance": None, "start": None}
    own = {**vars(actor.sampling), "guidance": actor.ode.guidance, "start": actor.start}
    if others := {name: own[name] for name, value in usual.items() if own[name] != value}:
        raise ValueError(
            f"{folder}: warm_flow integrates by Euler's method in uniform steps, without guidance, from a "
            f"draw of the source, and has no max_nfe, but the policy has {others}: change it first, with "
            "actor.replace, and save it"
        )
    prior, network, normalizer = actor.prior, cast(VelocityNetwork, actor.network), actor.normalizer
    assert normalizer is not None
    spec = next((t for t in TASKS.values() if t.env_name == environment_name(actor)), None)
    objects = 0 if spec is None else spec.object_dim
    widths = [objects, network.observation_dim - objects]

    def bounds(key: str, part: slice) -> dict[str, Tensor]:
        loc, scale = normalizer.loc(key)[part], normalizer.scale(key)[part]
        return {"min": loc - scale, "max": loc + scale}

    inputs, stats, first = {}, {"action": bounds(keys.ACTION, slice(None))}, 0
    for (name, kind), width in zip(_FEATURES.items(), widths, strict=True):
        if width:
            inputs[name] = PolicyFeature(type=kind, shape=(width,))
            stats[name] = bounds(keys.OBSERVATION, slice(first, first + width))
        first += width
    options = {k: v for k, v in prior.config().items() if k not in ("name", "chunk_length")}
    config = WarmFlowConfig(
        input_features=inputs,
        output_features={"action": PolicyFeature(type=FeatureType.ACTION, shape=(network.action_dim,))},
        n_obs_steps=network.observation_steps,
        n_action_steps=prior.chunk_length,
        prior=",".join([prior.name, *(f"{k}={json.dumps(v)}" for k, v in options.items())]),
        nfe=actor.sampling.evaluations(),
        network=json.dumps(network.config()),
        precondition=isinstance(network, PreconditionedNetwork),
        recording="" if actor.recording is None else json.dumps(asdict(actor.recording)),
        device="cpu",
        push_to_hub=False,
    )
    policy = WarmFlowPolicy(config)
    with torch.no_grad():
        cast(VelocityNetwork, policy.actor.network).load_state_dict(network.state_dict())
    policy.save_pretrained(out)  # type: ignore[operator]  # LeRobot hides its type
    for pipeline in make_warm_flow_pre_post_processors(config, stats):
        pipeline.save_pretrained(out)
    return out


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, and return the exit code."""
    parser = argparse.ArgumentParser(prog="lerobot_policy_warmprior.export", description=__doc__)
    parser.add_argument("folder", type=Path, help="folder of the saved policy")
    parser.add_argument("out", type=Path, help="folder to write, which must not exist")
    args = read_command_line(lambda: parser.parse_args(argv))
    print(export_policy(args.folder, args.out))
    return 0


if __name__ == "__main__":
    sys.exit(run_script(main, "lerobot_policy_warmprior.export"))
