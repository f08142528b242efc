import importlib
import json
from itertools import groupby

import prior_space_rl as benchmark
import pytest
import robomimic
import torch

from lab.options.command_line import parse
from lab.running.agents import environment, frozen_policies
from tests.benchmarks.script_parts import command_line, is_png, options, refused, stored, written
from tests.envs.test_gymnasium import registered_dial
from tests.errors import raises, refuses
from tests.toy_env import mlp_actor
from warmprior import GaussianPrior, VelocityMLP, WarmPriorActor
from warmprior.envs.description import registered_description
from warmprior.rl import has_anchor

TINY = {"iterations": 20, "rl__updates": 1, "episodes": 4, "num_envs": 4, "logger": "none", "workers": 1}
TINY |= {"centre": "mean", "delta": 0.5, "rl__hidden_dim": 16}
SHORT = {"rl__environment_steps": 500, "rl__warmup_steps": 200, "rl__evaluate_every": 300}
BOTH = ("dsrl-na", "dsrl-sac")


def unit(out, **extra):
    return command_line(**{"preset": "unit", "out": out} | TINY | SHORT | extra)


def read(words):
    return parse(benchmark.AGENT_PRESETS, words.split(), "rl", None, adapt=benchmark.adapt)


def agents(rows):
    found = groupby(rows, lambda row: (row["seed"], row["algorithm"], row["prior"]))
    return {key: list(points) for key, points in found}


def rates(points, kind):
    return [point["success_rate"] for point in points if point["evaluation"] == kind]


@pytest.fixture(scope="module")
def toy(inline, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "out"
    assert benchmark.main(unit(out, seeds=2, algorithm=BOTH)) == 0
    return out


def test_the_toy_with_both_algorithms(toy, capsys):
    rows = stored(toy)
    found = agents(rows)
    assert list(found) == [(seed, algorithm, "past") for seed in (0, 1) for algorithm in BOTH]
    for points in found.values():
        kinds = [point["evaluation"] for point in points]
        assert kinds == ["base", "greedy", "greedy"]
        steps = [point["environment_steps"] for point in points]
        # All control steps, of at most 4 chunks of 8 actions beyond.
        assert steps[0] == 0 and 300 <= steps[1] < 332 and 500 <= steps[-1] < 532
        for point in points:
            facts = {"task": "navigation", "delta": 0.5, "episodes": 4, "chunk": 8, "nfe": 2}
            assert facts.items() <= point.items()
            assert point["success_rate"] == point["successes"] / 4
    for seed in (0, 1):  # both algorithms start from the same frozen policy
        assert len({tuple(rates(found[seed, algorithm, "past"], "base")) for algorithm in BOTH}) == 1
    frozen = sorted(path.name[:26] for path in (toy.parent / "policies").iterdir())
    assert frozen == [f"navigation-toy-past-seed{seed}-" for seed in (0, 1)]
    assert is_png(toy / "curves.png") and is_png(toy / "success.png")
    table = (toy / "report.md").read_text().splitlines()
    (line,) = (line for line in table if line.startswith("| dsrl-sac | WP-Past | greedy | 2 | 0.5 ± 0 |"))
    last = [rates(found[seed, "dsrl-sac", "past"], "greedy")[-1] for seed in (0, 1)]
    assert float(line.split("|")[7].split("%")[0]) == pytest.approx(100 * sum(last) / 2, abs=0.051)

    # A folder with results is left alone, unless they are to be continued: here there is nothing to do.
    assert "--resume" in refused(benchmark.main, unit(toy), capsys)
    before = written(toy.parent)
    assert benchmark.main(["--resume", "--out", str(toy)]) == 0
    assert written(toy.parent) == before and stored(toy) == rows


def test_resume_goes_on_where_it_stopped(toy, tmp_path, monkeypatch):
    expected = [row for row in stored(toy) if (row["seed"], row["algorithm"]) == (0, "dsrl-na")]
    training = importlib.import_module("warmprior.rl.training")
    evaluate, calls = training.evaluate, []

    def interrupted(*args, **options):
        calls.append(None)
        if len(calls) > 2:  # the frozen policy, and the agent after 300 steps
            raise KeyboardInterrupt
        return evaluate(*args, **options)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(training, "evaluate", interrupted)
        benchmark.main(unit(tmp_path, seeds=1))
    assert len(calls) == 3 and not (tmp_path / "results.jsonl").exists()
    refuses(lambda: read(f"--resume --out {tmp_path} --delta 0.7"), ValueError, "--delta")
    assert benchmark.main(["--resume", "--out", str(tmp_path)]) == 0
    rows = stored(tmp_path)
    assert len(rows) == len(expected) == 3 and rows[:2] == expected[:2]
    assert rows[-1]["environment_steps"] >= 500


@pytest.mark.parametrize(("prior", "length"), [("past", 8), ("preview", 16)])
def test_around_zero_the_source_is_what_the_agent_says(prior, length):
    """The control: the field is the policy's, and a_0 = Delta wherever the mean was."""
    recipe = read(f"--preset unit --prior {prior} --delta 1.5 --centre mean zero")
    (method,) = recipe.sources.methods()
    network = VelocityMLP(1, 9, length, observation_steps=1, hidden_dim=8)
    actor = WarmPriorActor(network, method.prior(), nfe=1)
    around_mean, around_zero = (arm.policy(actor) for arm in recipe.arms(method))
    assert around_mean is actor and has_anchor(actor)
    assert around_zero.network is network and not has_anchor(around_zero)
    environments = (environment(p, True, 2, {}, 0) for p in (around_mean, around_zero))
    anchors = [env.rollout(2)["prior", "anchor"] for env in environments]
    assert anchors[0].shape == anchors[1].shape == (2, 2, length, 1)
    assert anchors[0].any() and not anchors[1].any()


def test_time_limit_and_compilation_reach_the_training(tmp_path, monkeypatch):
    """The time limit is that of the policy's environment unless one is given."""
    given = []

    class Recorded:
        def __init__(self, actor, make_env, *args, **options):
            given.append((make_env.args[-1], options["compile"]))

        def run(self):
            pass

    monkeypatch.setattr("warmprior.rl.PriorSpaceTraining", Recorded)
    for words, found in (("", ({}, False)), ("--horizon 20 --compile", ({"horizon": 20}, True))):
        recipe = read(f"--task can --prior past {words}")
        (method,) = recipe.sources.methods()
        actor = WarmPriorActor(VelocityMLP(7, 23, 8, hidden_dim=8), method.prior(), nfe=1)
        benchmark.learn(recipe, actor, recipe.arms(method)[0], 0, tmp_path)
        assert given.pop() == found


def test_papers_recipes():
    """DSRL's table of hyper-parameters; its choice for Transport is SAC."""
    known = {
        "can": (0.99, 20, 24_000, 2048, 300),
        "square": (0.999, 20, 32_000, 2048, 400),
        "transport": (0.99, 20, 640_000, 128, 800),
    }
    for task, values in known.items():
        recipe = read(f"--preset paper --task {task} --download")
        arms = [arm for method in recipe.sources.methods() for arm in recipe.arms(method)]
        assert [(arm.method.name, arm.algorithm, arm.centre) for arm in arms] == [
            *(("gaussian", algorithm, "zero") for algorithm in BOTH),
            *((name, "dsrl-na", "mean") for name in ("past", "preview")),
        ]
        assert recipe.sources.chunk == (8,) and recipe.evaluation.play_on
        for arm in arms:
            config = recipe.agent(arm, 0)
            found = (config.gamma, config.updates, config.warmup_steps, config.hidden_dim)
            assert (*found, recipe.data.horizon) == values
            assert config.delta is None  # the paper's: 0.5 around a mean, 1.5 around zero
            assert config.backup_entropy  # of both baselines alike
    # Options of the command line stand above those of the task.
    recipe = read("--preset paper --task square --rl.gamma 0.9 --nfe 9")
    config = recipe.agent(recipe.arms(recipe.sources.methods()[-1])[0], 0)
    assert (config.gamma, config.nfe) == (0.9, 9)


def test_policies_of_a_finished_run(dataset, tmp_path, capsys):
    """They bring task, data and normaliser, and are those asked for; in the simulator, in workers."""
    run, out = tmp_path / "main", tmp_path / "agents"
    prior = ["gaussian", "past,sigma=0.3", "past,sigma=0.3,correlation=0.5"]
    assert robomimic.main(options(dataset, run, prior=prior, iterations=4, task=None)) == 0
    before = written(tmp_path)

    def frozen(priors):
        found = frozen_policies(read(f"--run {run} --out {out} --seeds 1 {priors}"))[1]
        sources = [actors[0].prior for actors in found.values()]
        return [(prior.name, getattr(prior, "correlation", 0.0)) for prior in sources]

    own = "past,sigma=0.3"
    assert frozen(f"--prior past,correlation=0.50,sigma=0.3 {own}") == [("past", 0.5), ("past", 0.0)]
    for priors in ("--prior past,sigma=0.5", "--prior preview"):
        with raises(FileNotFoundError, f"--prior gaussian {own}"):
            frozen(priors)
    for words, why in (("--task can", "--task"), ("--sigma 0.3 --chunk 4", "--chunk, --sigma")):
        with raises(ValueError, why):
            frozen(words)
    assert len(frozen("")) == 3  # all of its methods
    # Their training is over: --compile is of the agents', with policies of either kind.
    assert len(frozen("--compile")) == 3 and read(f"--run {run} --out {out} --compile").run.compile
    # A name in a file is not imported, whichever file says it.
    resumed = json.loads((run / "options.json").read_text())
    resumed["options"]["data"]["task"] = ["evil:task"]
    (tmp_path / "evil").mkdir()
    (tmp_path / "evil" / "options.json").write_text(json.dumps(resumed))
    (tmp_path / "evil" / "tasks.json").write_text('[{"task": "evil:task"}]')
    refuses(lambda: read(f"--run {tmp_path / 'evil'} --out {out}"), ValueError, "evil:task")
    few = {"rl__environment_steps": 60, "rl__warmup_steps": 30, "rl__evaluate_every": 60, "episodes": 1}
    few |= {"rl__hidden_dim": 16, "rl__updates": 1}
    argv = command_line(run=run, out=out, horizon=20, seeds=2, prior=own, num_envs=1, **few)
    assert benchmark.main(argv) == 0
    assert "--run has 1 seeds of past,sigma=0.3: agents [1] share policies" in capsys.readouterr().out
    first, second = agents(stored(out)).values()
    assert {row["seed"] for row in second} == {1} and first[-1]["task"] == "lift"
    assert 60 <= first[-1]["environment_steps"] < 68
    assert written(tmp_path).items() >= before.items()
    assert len(list((tmp_path / "policies").iterdir())) == 3  # nothing was trained


def test_every_agent_has_a_name_of_its_own():
    sources = "past past,sigma=0.3 past,correlation=0.5 past,sigma=0.3,correlation=0.5"
    recipe = read(f"--preset unit --prior {sources}")
    arms = [arm for method in recipe.sources.methods() for arm in recipe.arms(method)]
    assert len({str(arm) for arm in arms}) == len(arms) == 16
    assert str(arms[0]) == "dsrl-na past, delta 0.5"


@pytest.mark.slow
def test_the_toy_is_solved_in_the_benchmarks_budget(tmp_path):
    argv = command_line(preset="unit", centre="mean", delta=0.5, seeds=1, out=tmp_path / "out")
    assert benchmark.main(argv) == 0
    (points,) = agents(stored(tmp_path / "out")).values()
    assert rates(points, "base")[0] <= 0.6 and rates(points, "greedy")[-1] >= 0.9


def test_agents_of_a_gymnasium_environment_are_rewarded_by_success(monkeypatch):
    dial = registered_dial(monkeypatch)  # its own reward is 1 a step
    described = registered_description({**dial, "kwargs": {}, "observation_keys": []})
    actor = mlp_actor(GaussianPrior(2), 1, 2, 1, environment=described)
    env = environment(actor, False, 2, {}, seed=1)
    after = torch.cat([env.rollout(2, break_when_any_done=False)["next"] for _ in range(3)], 1)
    env.close()
    # A solved episode ends, so a chunk earns 1 at most.
    assert after["reward"].tolist() == after["success"].float().tolist()
    assert 0 < after["success"].sum() < after["success"].numel()
