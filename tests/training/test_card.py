"""The card of a policy, and where its numbers come from."""

from __future__ import annotations

import json
from itertools import dropwhile, takewhile

import pytest

pytest.importorskip("scipy")

import warmprior
from warmprior import GaussianPrior, PastPrior, VelocityMLP, WarmPriorActor
from warmprior.diagnostics import success_posterior
from warmprior.envs.description import environment_description
from warmprior.training import model_card, policy_results

ACTOR = WarmPriorActor(VelocityMLP(2, 3, 4), PastPrior(4))
FACTS = {
    "task": "drift",
    "data": "own",
    "prior": "past",
    "options": "",
    "sigma": 0.5,
    "chunk": 4,
    "iterations": 20,
}


def row(seed, checkpoint, nfe, solved, **more):
    name = f"drift-own-past-seed{seed}"
    counts = {"episodes": 5, "successes": solved, "success_rate": solved / 5}
    return (
        FACTS | {"seed": seed, "policy": name, "checkpoint": checkpoint, "nfe": nfe} | counts | more
    )


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
    write(folder, [*OTHERS, *ROWS])
    about = {"versions": {"torch": "9.1"}, "options": {"evaluation": {"grid": "dense-jump"}}}
    (folder / "options.json").write_text(json.dumps(about))
    facts = {"task": "drift", "data": "own", "source": "scripted", "steps": 75}
    (folder / "tasks.json").write_text(json.dumps([{"task": "lift", "data": "ph"}, facts]))
    return folder


def write(folder, rows):
    (folder / "results.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))


def at(run, seed=0, checkpoint=20):
    return run.parent / "policies" / f"drift-own-past-seed{seed}" / f"policy_{checkpoint:06d}"


def front_matter(card):
    return pytest.importorskip("huggingface_hub").ModelCard(card).data.to_dict()


def cells(card, heading):
    """The rows of the first table under a heading."""
    lines = card.partition(heading)[2].strip().splitlines()
    table = takewhile(lambda line: line.startswith("|"), dropwhile(lambda x: x[:1] != "|", lines))
    rows = [line.strip("|").split("|") for line in list(table)[2:]]
    return [[cell.strip() for cell in row] for row in rows]


def test_its_numbers_are_those_of_the_results(run):
    card = model_card(ACTOR, policy_results(run, at(run)), repository="me/drift", licence="mit")
    rows = {(r["seed"], r["checkpoint"], r["nfe"]): r for r in ROWS}
    shown = cells(card, "## Success\n")
    assert [row[0] for row in shown] == ["3", "1"]
    for nfe, episodes, solved, rate, interval, others in shown:
        mine, other = (rows[seed, 20, int(nfe)] for seed in (0, 1))
        k = mine["successes"]
        assert (int(solved), int(episodes)) == (k, 5) and rate == f"{20 * k:.1f}%"
        low, high = success_posterior(k, 5).interval(0.95)
        assert interval == f"{100 * low:.1f}% to {100 * high:.1f}%"
        assert others == f"{100 * other['success_rate']:.1f}% (seed 1)"
    assert "seeds 10000000 to 10000004." in card and "training seed 0" in card
    assert "grid `dense-jump`" in card
    facts = dict(cells(card, "# past on drift"))
    assert facts["task"] == "drift, data own" and facts["training"] == "20 of 20 iterations, seed 0"
    count = sum(p.numel() for p in ACTOR.network.parameters())
    assert f"{count:,} parameters" in facts["network"] and facts["chunk length"] == "4"
    assert facts["sigma, in units of the normaliser"] == "0.5"
    assert facts["demonstrations"] == "source `scripted`; steps `75`"
    assert "trained and played with torch 9.1" in facts["versions"]
    front = front_matter(card)
    assert front["license"] == "mit" and front["library_name"] == "warmprior"
    assert front["pipeline_tag"] == "robotics" and "flow-matching" in front["tags"]
    missing = card.partition("## What is not known")[2]
    assert "Any success rate" not in missing and "A licence" not in missing
    assert "must not be set beside published ones" in " ".join(missing.split())
    # The other seed, and an earlier checkpoint, have numbers of their own.
    other = policy_results(run, at(run, seed=1, checkpoint=10))
    assert {(row["seed"], row["checkpoint"]) for row in other.rows} == {(1, 10)}
    assert {row["seed"] for row in other.others} == {0} and len(other.rows) == 2


def test_delays_have_lines_of_their_own(run):
    write(run, [row(s, 20, 1, s + d, delay=d, guidance="none") for s in (0, 1) for d in (0, 2)])
    shown = cells(model_card(ACTOR, policy_results(run, at(run))), "## Success\n")
    assert [line[1] for line in shown] == ["0", "2"]
    assert [line[-1] for line in shown] == ["20.0% (seed 1)", "60.0% (seed 1)"]


def test_what_is_missing_is_said(run):
    actor = WarmPriorActor(VelocityMLP(2, 3, 4), GaussianPrior(4))
    card = model_card(actor, repository="me/it")
    assert "license" not in front_matter(card)
    missing = card.partition("## What is not known")[2]
    for words in ("environment:", "iterations, seed", "Any success rate.", "A licence"):
        assert words in missing
    assert "Not measured" in card and 'load_policy("me/it")' in card
    assert "environment_of" not in card and warmprior.__version__ in card
    # A run without a description of its data, and a checkpoint that was not played.
    (run / "tasks.json").unlink()
    write(run, [r for r in ROWS if r["checkpoint"] == 20])
    card = model_card(actor, policy_results(run, at(run, checkpoint=10)))
    assert "The policy of iteration 10 was not played." in card
    assert "not known" in dict(cells(card, "# past on drift"))["demonstrations"]


class Own(PastPrior):
    name = "of_the_card"


def test_an_environment_and_classes_of_ones_own_are_named():
    about = environment_description({"env_name": "Lift"}, "ph", 2, "absolute")
    actor = WarmPriorActor(VelocityMLP(7, 19, 8), PastPrior(8), environment=about)
    card = model_card(actor)
    assert "| environment | Lift of robosuite, style ph, absolute actions |" in card
    assert "environment_of(actor)" in card and "# past on Lift" in card
    assert "import Own" not in card
    card = model_card(WarmPriorActor(VelocityMLP(2, 3, 4), Own(4)))
    assert f"import Own of {Own.__module__} first" in card


def test_results_of_something_else_are_refused(run, tmp_path):
    for folder, policy, error, said in (
        (tmp_path, at(run), FileNotFoundError, r"has no results\.jsonl"),
        (
            run,
            tmp_path / "elsewhere" / "policy_000020",
            ValueError,
            "no row of a policy in elsewhere",
        ),
        (run, at(run).with_name("state"), ValueError, r"none of .*: name it like .*policy_000020"),
    ):
        with pytest.raises(error, match=said):
            policy_results(folder, policy)
    (run / "results.jsonl").write_text("{broken")
    with pytest.raises(ValueError, match=r"results\.jsonl"):
        policy_results(run, at(run))
