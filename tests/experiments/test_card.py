"""The card of a policy, and where its numbers come from."""

from __future__ import annotations

import json
from itertools import dropwhile, takewhile

import pytest

pytest.importorskip("tyro")

import warmprior
from tests.experiments.comparison_parts import comparison, stored
from warmprior import GaussianPrior, PastPrior, VelocityMLP, WarmPriorActor
from warmprior.diagnostics import success_posterior
from warmprior.envs.description import environment_description
from warmprior.experiments import Method, model_card, policy_results


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    played = comparison(folder, 1, methods=(Method("past", 4),))
    played.run()
    return folder, played.contestants


def front_matter(card):
    return pytest.importorskip("huggingface_hub").ModelCard(card).data.to_dict()


def cells(card, heading):
    """The rows of the first table under a heading."""
    lines = card.partition(heading)[2].strip().splitlines()
    table = takewhile(lambda line: line.startswith("|"), dropwhile(lambda x: x[:1] != "|", lines))
    rows = [line.strip("|").split("|") for line in list(table)[2:]]
    return [[cell.strip() for cell in row] for row in rows]


def test_its_numbers_are_those_of_the_results(run):
    folder, (first, second) = run
    results = policy_results(folder / "out", first.path)
    card = model_card(first.policy(), results, repository="me/drift", licence="mit")
    rows = {(r["facts"]["seed"], r["facts"]["checkpoint"], r["facts"]["nfe"]): r["measures"]
            for r in stored(folder)["rows"]}  # fmt: skip
    shown = cells(card, "## Success\n")
    assert [row[0] for row in shown] == ["3", "1"]
    for nfe, episodes, solved, rate, interval, others in shown:
        mine, other = (rows[seed, 20, int(nfe)] for seed in (0, 1))
        k, n = mine["successes"], mine["episodes"]
        assert (int(solved), int(episodes)) == (k, n) and n == 5
        assert rate == f"{100 * k / n:.1f}%"
        low, high = success_posterior(k, n).interval(0.95)
        assert interval == f"{100 * low:.1f}% to {100 * high:.1f}%"
        assert others == f"{100 * other['success_rate']:.1f}% (seed 1)"
    assert "seeds 10000000 to 10000004." in card and "training seed 0" in card
    facts = dict(cells(card, "# WP-Past on drift"))
    assert facts["task"] == "drift, data own" and facts["training"] == "20 of 20 iterations, seed 0"
    count = sum(p.numel() for p in first.policy().network.parameters())
    assert f"{count:,} parameters" in facts["network"] and facts["chunk length"] == "4"
    assert facts["sigma, in units of the normaliser"] == "0.5"
    assert (
        f"trained and played with python {stored(folder)['meta']['versions']['python']}"
        in (facts["versions"])
    )
    told = front_matter(card)
    assert told["license"] == "mit" and told["library_name"] == "warmprior"
    assert told["pipeline_tag"] == "robotics" and "flow-matching" in told["tags"]
    missing = card.partition("## What is not told here")[2]
    assert "success rate" not in missing and "licence" not in missing
    # The other seed, and an earlier checkpoint, have numbers of their own.
    other = policy_results(folder / "out", second.path)
    assert other.training["seed"] == 1 and {row["seed"] for row in other.rows} == {1}
    early = policy_results(folder / "out", second.folder / "policy_000010")
    assert early.checkpoint == 10 and {row["checkpoint"] for row in early.rows} == {10}


def test_what_is_missing_is_said():
    actor = WarmPriorActor(VelocityMLP(2, 3, 4), GaussianPrior(4))
    card = model_card(actor, repository="me/it")
    assert "license" not in front_matter(card)
    missing = card.partition("## What is not told here")[2]
    for told in ("environment:", "iterations, seed", "Any success rate.", "A licence"):
        assert told in missing
    assert "Not measured" in card and 'load_policy("me/it")' in card
    assert "environment_of" not in card and warmprior.__version__ in card


def test_an_environment_is_told():
    about = environment_description({"env_name": "Lift"}, "ph", 2, "absolute")
    actor = WarmPriorActor(VelocityMLP(7, 19, 8), PastPrior(8), environment=about)
    card = model_card(actor)
    assert "| environment | Lift of robosuite, style ph, absolute actions |" in card
    assert "environment_of(actor)" in card and "# WP-Past on Lift" in card


class Own(PastPrior):
    name = "of_the_card"


def test_a_prior_of_ones_own_has_to_be_imported():
    card = model_card(WarmPriorActor(VelocityMLP(2, 3, 4), Own(4)))
    assert f"import Own of {Own.__module__} first" in card
    assert "import Own" not in model_card(WarmPriorActor(VelocityMLP(2, 3, 4), PastPrior(4)))


def test_results_of_something_else_are_refused(run, tmp_path):
    folder, (first, _) = run
    with pytest.raises(FileNotFoundError, match=r"has no results\.json"):
        policy_results(tmp_path, first.path)
    with pytest.raises(ValueError, match=r"results\.json tells nothing of a policy in elsewhere"):
        policy_results(folder / "out", tmp_path / "elsewhere" / "policy_000020")
    with pytest.raises(ValueError, match=r"none of the policies .*: name it like .*policy_000020"):
        policy_results(folder / "out", first.folder / "state")
    unplayed = json.loads((folder / "out" / "results.json").read_text())
    unplayed["rows"] = []
    (tmp_path / "results.json").write_text(json.dumps(unplayed))
    results = policy_results(tmp_path, first.path)
    assert "The policy of iteration 20 was not played." in model_card(first.policy(), results)
    (tmp_path / "results.json").write_text("[]")
    with pytest.raises(ValueError, match="is not a results file of this version"):
        policy_results(tmp_path, first.path)
