import json

import pytest

pytest.importorskip("scipy")

from scipy import stats

import warmprior
from lab.reporting.cards import measured
from lab.reporting.report import policy_results
from tests.toy_env import mlp_actor
from warmprior import (
    LinearInterpolant,
    PastPrior,
    PreconditionedNetwork,
    StartPoint,
    VelocityMLP,
    WarmPriorActor,
)
from warmprior.saving import model_card

ACTOR = mlp_actor(PastPrior(4))
FACTS = {"task": "drift", "data": "own", "prior": "past", "options": "", "sigma": 0.5, "chunk": 4}
FACTS["iterations"] = 20


def row(seed, checkpoint, nfe, solved, **more):
    name = f"drift-own-past-seed{seed}"
    counts = {"episodes": 5, "successes": solved, "success_rate": solved / 5}
    return FACTS | {"seed": seed, "policy": name, "checkpoint": checkpoint, "nfe": nfe} | counts | more


ROWS = [
    row(seed, checkpoint, nfe, (seed + checkpoint // 10 + nfe) % 6)
    for seed in (0, 1)
    for checkpoint in (10, 20)
    for nfe in (3, 1)
]
# Not of these policies: another source, and a measure without episodes.
OTHERS = [row(0, 20, 3, 5, prior="gaussian", policy="drift-own-gaussian"), {"kappa": 1.0}]


@pytest.fixture
def run(tmp_path):
    """What a benchmark leaves, and where its policies lie."""
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "results.jsonl").write_text("".join(json.dumps(row) + "\n" for row in (*OTHERS, *ROWS)))
    facts = {"task": "drift", "data": "own", "source": "scripted", "steps": 75}
    (folder / "tasks.json").write_text(json.dumps([{"task": "lift", "data": "ph"}, facts]))
    return folder


def test_its_numbers_are_those_of_the_results(run):
    policy = run.parent / "policies" / "drift-own-past-seed0" / "policy_000020"
    card = model_card(ACTOR, **measured(policy_results(run, policy)), repository="me/drift", license="mit")
    for mine in (r for r in ROWS if (r["seed"], r["checkpoint"]) == (0, 20)):
        k = mine["successes"]
        low, high = stats.beta(1 + k, 6 - k).interval(0.95)
        assert f"| {mine['nfe']} | 5 | {k} | {100 * low:.1f}% to {100 * high:.1f}% |" in card
    assert card.count("% to ") == 2
    assert "| training | drift, data own: 20 of 20 iterations, seed 0 |" in card
    assert "scripted" in card and "published numbers" in card
    assert f"{sum(p.numel() for p in ACTOR.network.parameters()):,} parameters" in card
    front = pytest.importorskip("huggingface_hub").ModelCard(card).data.to_dict()
    assert front["license"] == "mit" and front["library_name"] == "warmprior"
    assert front["pipeline_tag"] == "robotics" and "flow-matching" in front["tags"]


def test_what_is_not_known_is_said():
    card = model_card(ACTOR, repository="me/it")
    assert "license" not in card and "Not measured" in card and "| environment | not known |" in card
    assert 'load_policy("me/it")' in card and "environment_of" not in card
    exec(card.split("```python\n")[1].splitlines()[0])  # the import
    assert warmprior.__version__ in card


class OwnPath(LinearInterpolant): ...


class OwnNetwork(VelocityMLP): ...


class OwnStart(StartPoint):
    time = noise_share = 0.5


def test_what_has_to_be_imported_is_named():
    """The card looks inside the library's own parts too, where most networks are."""
    network = PreconditionedNetwork(OwnNetwork(2, 3, 4), interpolant=OwnPath())
    card = model_card(WarmPriorActor(network, PastPrior(4), start=OwnStart()))
    assert {line for line in card.splitlines() if line.startswith("It needs")} == {
        f"It needs classes of its author: import OwnStart of {__name__} and OwnPath of {__name__} and "
        f"OwnNetwork of {__name__} first."
    }
    assert "It needs" not in model_card(ACTOR)
