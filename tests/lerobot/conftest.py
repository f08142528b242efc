"""One tiny policy per family, built once: most of the time is the import of LeRobot."""

import importlib.util
import os

import pytest
import torch

from tests.lerobot.tiny import MAKERS

os.environ.setdefault("HF_HUB_OFFLINE", "1")

collect_ignore = ["robot"]  # a package of LeRobot's, for other processes
if not all(map(importlib.util.find_spec, ("lerobot", "transformers"))):
    collect_ignore_glob = ["test_*.py"]


@pytest.fixture(scope="session")
def built():
    policies = {}

    def build(family, **options):
        if family not in MAKERS:
            pytest.skip(f"{family} needs another release of lerobot")
        if options:
            return MAKERS[family](**options)
        if family not in policies:
            torch.manual_seed(0)
            policies[family] = MAKERS[family]()
        return policies[family]

    return build


@pytest.fixture
def policy(built):
    """``policy(family, **options)``: the family's own, or a new one where there are options."""

    def get(family, **options):
        found = built(family, **options)
        found.reset()
        return found.eval()

    return get


@pytest.fixture(scope="session")
def found():
    """The policies' classes, by LeRobot's own discovery."""
    pytest.importorskip("lerobot_policy_warmprior")
    from lerobot.policies.factory import get_policy_class
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    names = ("warm_smolvla", "warm_pi05", "warm_groot", "warm_flow")
    return {name: get_policy_class(name) for name in names}
