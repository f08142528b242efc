"""The paper's Fig. 5: mode switching in a one-dimensional navigation toy.

python benchmarks/navigation1d.py                      # all policies, one seed, a few minutes
python benchmarks/navigation1d.py --seeds 5
python benchmarks/navigation1d.py --chunk 1            # a decision at every step
python benchmarks/navigation1d.py --preset paper       # the paper's network and training, five seeds
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from typing import Any

from lab.options.command_line import parse, script, started
from lab.options.options import Evaluation, Options, Sources, check_single
from warmprior.options.training import PAPER, NetworkOptions, TrainingConfig

JUDGED = [  # columns of the table
    *("switch_rate", "commit_rate", "collision_rate", "route_entropy", "distance", "jump_ratio"),
    *("shifted_collision_rate", "shifted_distance"),
]
STEPS = 32  # half of an episode: the longest chunk


@dataclass(frozen=True)
class NavigationOptions(Options):
    """Options of a comparison of sources on the toy; --episodes is the number of rollouts."""

    position_only: bool = False  # show policies the position without its sines and cosines, as in the paper

    @property
    def name(self) -> str:
        return f"h{'-'.join(map(str, self.sources.chunk))}"

    def check(self) -> None:
        from lab.measures.straightness import check_flows

        super().check()
        check_single(self, "chunk")
        check_flows(self.sources.methods())
        if self.evaluation.temperature != (1.0,) or self.evaluation.play_on:
            raise ValueError(
                "the toy is rolled out to its end with all noise: leave out --temperature, --play-on"
            )
        self.data.check_only()
        if self.sources.chunk[0] > STEPS:
            raise ValueError(f"--chunk must be at most {STEPS}, got {self.sources.chunk[0]}")


SOURCES = Sources(("gaussian", "regression", "history", "past", "preview"), (4,), (0.1, 0.5))
PLAYED = Evaluation(episodes=256, nfe=(9, 1))

NAVIGATION_PRESETS = {
    # All policies in a few minutes on two cores.
    "quick": NavigationOptions(
        network=NetworkOptions("mlp,hidden_dim=128", observation_steps=1),
        training=TrainingConfig(
            iterations=3_000,
            batch_size=256,
            learning_rate=2e-3,
            warmup_ratio=0.0,
            save_every=3_000,
            weighting="velocity",
            # The paper's Algorithm 1 withholds no history; PreviewPrior says why small sigma needs it.
            cold_probability=0.1,
        ),
        sources=SOURCES,
        evaluation=PLAYED,
    ),
    # Fig. 5: four layers of 1,024 units that see the position. The paper gives only iterations and batch
    # size; the rest of the recipe is that of its robot tasks.
    "paper": NavigationOptions(
        position_only=True,
        network=NetworkOptions("plain_mlp,hidden_dim=1024", precondition=False, observation_steps=1),
        training=replace(PAPER, iterations=50_000, batch_size=256, checkpoints=1),
        sources=SOURCES,
        evaluation=replace(PLAYED, seeds=5),
    ),
}


@script("navigation1d.py", together=True)
def main(argv: list[str] | None) -> None:
    """Train the policies, roll them out and measure their flows."""
    options = parse(NAVIGATION_PRESETS, argv, "navigation1d", __doc__, adapt=lambda base, typed: base)
    import pandas as pd
    import torch

    from lab.measures.navigation import judge_navigation, play_navigation
    from lab.measures.straightness import straightness
    from lab.reporting.plots import plot_flow_paths, plot_navigation
    from lab.reporting.report import labelled, table, unlike, write_report
    from lab.reporting.rows import RESULTS, write_rows
    from lab.running.comparison import train_all
    from lab.running.policies import policies_of, trained_actors
    from warmprior.diagnostics import SharedObservations, executed_actions, flow_paths

    with started(options, "navigation1d") as out:
        style = "position" if options.position_only else "toy"
        policies = policies_of(options, ("navigation", style), only=True)
        train_all(options, policies)
        make_env = policies[0].task().make_env
        played: dict[str, Any] = {"rollouts": options.evaluation.episodes, "make_env": make_env}
        judged = [
            {**p.facts, "nfe": nfe, **judge_navigation(p.load(), p.training.seed, nfe=nfe, **played)}
            for p in policies
            for nfe in p.method.nfes(options.evaluation.nfe)
        ]
        rows = write_rows(out / RESULTS, judged)
        observations = SharedObservations(policies[0].task().data, options.sources.chunk[0])
        flows = []
        for seed in options.seeds:  # the source samples belong to the seed
            policies_of_seed = [policy for policy in policies if policy.training.seed == seed]
            actors = trained_actors(policies_of_seed, options.run.device)
            flows += straightness(actors, observations, draws=4, seed=seed)
        curvatures = write_rows(out / "curvature.jsonl", flows)
        notes = unlike(options, NAVIGATION_PRESETS["paper"])
        if not options.position_only:
            notes.append("Unlike in the paper, policies also see sines and cosines of the position.")
        text = table(labelled(rows), ["method", "nfe"], JUDGED, notes)
        flow = labelled(curvatures[curvatures["mean"] == "training"])
        text += "\n" + table(flow, ["method"], ["kappa_executed", "relative_executed"])
        # Before the pictures, so that an error in drawing loses no results.
        write_report(out, text, text, pd.concat([rows, curvatures]))

        # Executed actions and flow paths of the first seed's policies.
        seed, chunk = options.training.seed, options.sources.chunk[0]
        panels, paths = {}, {}
        shown = labelled(rows).set_index(["policy", "nfe"])
        for policy in (policy for policy in policies if policy.training.seed == seed):
            method, actor = policy.method, policy.load()
            nfe = max(method.nfes(options.evaluation.nfe))
            row = shown.loc[policy.name, nfe]
            captions = [f"collides {row.collision_rate:.0%}"]
            if pd.notna(row.switch_rate):
                captions[0] = f"switches sides at {row.switch_rate:.1%} of boundaries, {captions[0]}"
            if method.remembers:
                captions.append(f"with its history shifted: collides {row.shifted_collision_rate:.0%}")
            rollout = play_navigation(actor, seed, nfe=nfe, make_env=make_env)
            panels[row.method] = (executed_actions(rollout)[0].squeeze(-1), captions)
            if method.is_flow:
                # One window of a demonstration, above the first obstacle, from many source samples.
                window = observations.windows(actor.prior, see_history=method.parts.sees_history)
                index = int((window["observation"][:60, 0, 0] + 0.45).abs().argmin())
                batch = window[index : index + 1].expand(48).contiguous()
                generator = torch.Generator().manual_seed(seed)
                paths[row.method] = flow_paths(actor, batch, generator=generator)[..., 0, 0]
        network, iterations = options.network.network, options.training.iterations
        what = f"H = {chunk}, {network}, {iterations} iterations, seed {seed}"
        title = f"One-dimensional navigation: {what}"
        plot_navigation(panels, out / "navigation1d.png", chunk_length=chunk, title=title)
        title = f"Paths of the flow above the first obstacle, after a demonstrated history: {what}"
        plot_flow_paths(paths, out / "flow_paths.png", title=title)


if __name__ == "__main__":
    sys.exit(main())
