"""The simulation against closed forms and brute force, and the script on a policy that plays the toy."""

from __future__ import annotations

import json
import re

import pytest

pytest.importorskip("robosuite")

import scaling
import torch
from scaling import Played, apart, lockstep

from warmprior import PastPrior, VelocityMLP, WarmPriorActor
from warmprior.envs.description import environment_description
from warmprior.envs.simulator import task_env_args
from warmprior.training.saved import save_policy


def episode(*steps, decision=1.0):
    return Played((decision,) * len(steps), steps)


EQUAL = [episode(2.0, 2.0, 2.0)] * 12  # nine seconds each


@pytest.mark.parametrize("cores", [1, 2, 3, 4, 6, 12])
def test_equal_episodes(cores):
    rounds = 12 // cores
    assert apart(EQUAL, cores) == 9.0 * rounds
    assert lockstep(EQUAL, cores, lambda n: 1.0) == 9.0 * rounds
    assert lockstep(EQUAL, cores, float) == (3 * cores + 6.0) * rounds  # one after another


def test_episodes_of_their_own_length():
    episodes = [episode(1.0), episode(5.0), episode(1.0), episode(2.0, 2.0)]
    assert apart(episodes, 1) == 2 + 6 + 2 + 6
    # 0-2 first, 0-6 second; third 2-4, fourth 4-10
    assert apart(episodes, 2) == 10.0
    # Rows: steps 1, 1 and 5, 2, 2; of each round the longer, and a decision.
    assert lockstep(episodes, 2, lambda n: 1.0) == (1 + 5) + (1 + 2) + (1 + 2)


@pytest.mark.slow
def test_the_script(tmp_path, monkeypatch):
    monkeypatch.setattr(scaling, "TRAINED", 10)
    torch.manual_seed(0)
    prior = PastPrior(8)
    environment = environment_description(task_env_args("lift"), "ph", 2)
    network = VelocityMLP(7, 19, 8, 2, hidden_dim=16)
    save_policy(WarmPriorActor(network, prior, environment=environment), tmp_path / "policy")
    out = tmp_path / "out"
    argv = [str(tmp_path / "policy"), "--episodes", "2", "--repeats", "1", "--out", str(out)]
    assert scaling.main([*argv, "--processes", "2", "--cores", "1", "16"]) == 0
    results = json.loads((out / "scaling.json").read_text())
    assert set(results["measured"]) == {"1", "2"}
    assert results["simulated"]["1"]["apart"] == pytest.approx(1.0)
    assert set(results["decision_seconds"]) == {"1", "2", "4", "8", "16", "32"}
    one, two = (results["measured"][n] for n in "12")
    assert results["evaluation_over_lockstep"] == two["lockstep"] / two["apart"]
    assert results["training_scaling"] == one["training"] / two["training"] / 2
    assert all(len(e["decisions"]) == len(e["steps"]) for e in results["recorded"])
    assert (out / "scaling.png").stat().st_size > 10_000
    assert re.search(r"^16 +\d", (out / "table.txt").read_text(), re.M)
