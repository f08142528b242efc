"""The paper's Fig. 7: reinforcement learning in the source space of a frozen policy.

python benchmarks/prior_space_rl.py --preset unit            # the navigation toy, about six minutes
python benchmarks/prior_space_rl.py                          # lift from a weak policy, half an hour
python benchmarks/prior_space_rl.py --preset paper --run runs/square-ph-paper
python benchmarks/prior_space_rl.py --resume                 # after an interruption

There is a frozen policy per source and seed, from the finished run --run or trained first.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from navigation1d import NAVIGATION_PRESETS

from lab.demonstrations.data_options import DataOptions
from lab.options.agents import TOY, AgentOptions, AgentsOptions
from lab.options.command_line import parse, script, started
from lab.options.options import Evaluation, Sources, with_parts
from lab.options.presets import PRESETS, study
from warmprior.checks import given
from warmprior.io.files import read_json
from warmprior.io.workers import torch_threads

if TYPE_CHECKING:
    import pandas as pd

    from lab.options.agents import Arm
    from warmprior import WarmPriorActor
    from warmprior.rl import PriorSpaceTraining

TOY_PRESET = NAVIGATION_PRESETS["quick"]
AGENT_PRESETS: dict[str, AgentsOptions] = {
    # Lift from a weak policy, WP-Past against the Gaussian source, two seeds: half an hour.
    "quick": AgentsOptions(
        network=PRESETS["quick"].network,
        training=PRESETS["quick"].training,
        sources=Sources(prior=("gaussian", "past")),
        evaluation=Evaluation(seeds=2, episodes=40, nfe=(1,)),
        rl=AgentOptions(
            environment_steps=24_000,
            warmup_steps=3_000,
            updates=4,
            noise_critic_steps=2,
            learning_rate=1e-3,
            gamma=0.97,
            hidden_dim=128,
            # At 1, the entropy bonus of 56 coordinates exceeds the reward of a decision's 8 control steps, so
            # the agent would be rewarded for not solving the task until alpha has fallen.
            alpha_init=0.05,
            evaluate_every=6_000,
        ),
    ),
    # The navigation toy with a goal, three seeds: agents around the mean and around zero, in two boxes.
    "unit": AgentsOptions(
        data=DataOptions(task=(TOY,)),
        network=TOY_PRESET.network,
        training=replace(TOY_PRESET.training, iterations=800, save_every=800, cold_probability=0.0),
        sources=Sources(prior=("past",)),
        centre=("mean", "zero"),
        delta=(0.5, 1.5),
        evaluation=Evaluation(seeds=3, episodes=128, nfe=(2,)),
        rl=AgentOptions(
            environment_steps=12_000,
            warmup_steps=3_000,
            updates=12,
            noise_critic_steps=4,
            learning_rate=1e-3,
            tau=0.05,
            gamma=1.0,
            hidden_dim=128,
            num_layers=2,
            # Failure ends the episode, so entropy in the targets would reward survival whatever the task.
            backup_entropy=False,
            alpha_init=0.02,
            reward_offset=0.0,
            evaluate_every=6_000,
        ),
        num_envs=32,
    ),
    # Fig. 7's four agents with DSRL's hyper-parameters per task, three seeds: needs a GPU. As in DSRL,
    # success does not end the episode. The paper trains these policies for 3,000 epochs; here they have
    # Table 3's length.
    "paper": study(
        AgentsOptions,
        PRESETS["paper"],
        algorithm=("dsrl-na", "dsrl-sac"),
        warm_algorithm=("dsrl-na",),
        evaluation=Evaluation(seeds=3, episodes=200, nfe=(1,), play_on=True),
        rl=AgentOptions(environment_steps=1_000_000, evaluate_every=50_000),
    ),
}

# Changes of a preset for a task.
BY_TASK: dict[tuple[str, str], dict[str, Any]] = {
    # Weak policies, which solve 30 to 80% of the episodes.
    ("quick", "lift"): {"data": {"demonstrations": (5,), "horizon": 90}, "training": {"iterations": 300}},
    ("quick", "can"): {"training": {"iterations": 500}},
    ("paper", "lift"): {"rl": {"updates": 30}, "data": {"horizon": 300}},
    ("paper", "can"): {"data": {"horizon": 300}},
    ("paper", "square"): {"rl": {"gamma": 0.999, "warmup_steps": 32_000}, "data": {"horizon": 400}},
    ("paper", "transport"): {"rl": {"hidden_dim": 128, "warmup_steps": 640_000}, "data": {"horizon": 800}},
}


def adapt(preset: AgentsOptions, typed: AgentsOptions) -> AgentsOptions:
    """Return the preset with the hyper-parameters of the task."""
    name, tasks, run = typed.preset, typed.data.task, typed.policies
    if name == "unit":
        return preset
    if run is not None and (run / "tasks.json").exists():
        tasks = tasks or (read_json(run / "tasks.json")[0]["task"],)
    elif name == "quick" and typed.data.dataset is None:
        tasks = tasks or ("lift",)
    if name == "paper" and not tasks:
        raise ValueError("--preset paper has hyper-parameters per task: add the --task")
    changed = with_parts(preset, **BY_TASK.get((name, next(iter(tasks), "")), {}))
    return with_parts(changed, data={"task": tasks})


def learn(
    options: AgentsOptions, actor: WarmPriorActor, arm: Arm, seed: int, out: Path
) -> PriorSpaceTraining:
    """Train an agent, or continue it where it was interrupted."""
    from lab.running.agents import encoding, environment
    from lab.running.policies import slug
    from warmprior.rl import PriorSpaceTraining

    actor, name = arm.policy(actor), f"{arm}, seed {seed}"
    parts = given(horizon=options.data.horizon) | options.evaluation.environment
    rounds = None
    if options.collectors is not None:
        from lab.running.ray_collection import ray_rounds

        rounds = partial(ray_rounds, collectors=options.collectors, address=options.run.ray_address)
    encoders = encoding(actor)  # a policy of images reads the same features as the agent
    training = PriorSpaceTraining(
        actor.replace(observation_key=encoders[0].out_keys[0]) if encoders else actor,
        partial(environment, actor, options.is_toy, options.num_envs, parts),
        options.agent(arm, seed),
        out / slug(name.replace(" ", "-")),
        evaluation_seed=options.evaluation.starts(seed).start,
        description=name,
        collect=rounds,
        compile=options.run.compile,
    )
    with torch_threads(None):  # TorchRL resets the number of threads when workers end
        training.run()
    return training


@script("prior_space_rl.py")
def main(argv: list[str] | None) -> None:
    """Train an agent per algorithm, source and seed, and compare their success."""
    options = parse(AGENT_PRESETS, argv, "rl", __doc__, adapt=adapt)
    from lab.reporting.plots import plot_success
    from lab.reporting.report import labelled, setting_title, table, write_report
    from lab.reporting.rows import AGENT, RESULTS, read_rows, write_rows
    from lab.running.agents import frozen_policies
    from warmprior.rl.agent import delta_of

    with started(options, "rl") as out:
        task, frozen = frozen_policies(options)
        path = out / RESULTS
        rows, failures = read_rows(path, AGENT) if path.exists() else [], []
        arms = [arm for method in frozen for arm in options.arms(method)]
        for seed, arm in product(options.seeds, sorted(arms, key=lambda arm: arm.algorithm)):
            actor = frozen[arm.method][seed]
            facts: dict[str, Any] = {
                "task": task["task"],
                "data": task["data"],
                **{space: task[space] for space in ("actions", "obs") if space in task},
                "algorithm": arm.algorithm,
                **arm.method.facts,
                "centre": arm.centre if arm.method.has_anchor else "",
                "delta": delta_of(options.agent(arm, seed), arm.policy(actor)),
                "nfe": options.evaluation.nfe[0],
                "seed": seed,
            }
            try:
                training = learn(options, actor, arm, seed, out)
            except FloatingPointError as error:  # the other agents are still trained
                failures.append(f"{arm}, seed {seed}: {error}")
                continue
            rows = [row for row in rows if not facts.items() <= row.items()]
            rows += [{**facts, **point} for point in training.curve]
            write_rows(path, rows)
        if not rows:
            raise FloatingPointError("; ".join(failures))
        labelled_rows = labelled(write_rows(path, rows))
        if labelled_rows.groupby("method")["delta"].nunique().max() > 1:
            labelled_rows["method"] += ", delta " + labelled_rows.delta.map("{:g}".format)
        title = f"{setting_title(task)}, NFE {options.evaluation.nfe[0]}"
        draw(labelled_rows, out / "curves.png", title, options.rl.warmup_steps)
        agents = ["algorithm", "method", "evaluation"]
        last = labelled_rows.groupby([*agents, "seed"], sort=False).tail(1)
        greedy = last[last.evaluation == "greedy"].assign(algorithm=last.algorithm.str.upper())
        plot_success(greedy, out / "success.png", f"{title}: greedy agents", group="algorithm")
        last = last.assign(seeds=last.groupby(agents)["seed"].transform("nunique"))
        text = table(last, agents, ["seeds", "delta", "environment_steps", "success_rate"])
        write_report(out, text, text, labelled_rows, failures)


def draw(rows: pd.DataFrame, path: Path, title: str, warmup_steps: int) -> None:
    """Draw success of greedy agents against control steps (Fig. 7), the frozen policy at 0.

    Seeds are averaged evaluation by evaluation. Their numbers of control steps differ slightly, because an
    evaluation waits for the end of a decision; the mean is drawn.
    """
    from lab.reporting.plots import plot_lines

    shown = rows.assign(panel="greedy agent", method=rows.algorithm.str.upper() + ", " + rows.method)
    number = shown.groupby(["method", "seed"]).cumcount()
    same = shown.groupby(["method", number])
    shown["environment_steps"] = same["environment_steps"].transform("mean")
    # Evaluations that some seeds lack are left out.
    shown = shown[same["seed"].transform("size") == shown.groupby("method")["seed"].transform("nunique")]
    lines = {"success_rate": f"success rate (learning starts at {warmup_steps:,} steps)"}
    plot_lines(shown, path, title, "environment_steps", lines, "panel", "linear")


if __name__ == "__main__":
    sys.exit(main())
